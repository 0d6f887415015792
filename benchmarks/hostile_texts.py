"""Texts, folders and words that lie, made from a seed: good ones in, hostile ones and the command that reads them out.
For ``benchmarks/hostile.py``."""

from __future__ import annotations

import json
import os
import random
import shutil
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hostile_files import FRAMES, Good, Make, save_picture

from tests.hard.fuzz import PART, RICH, bytes_changed, json_changed, scene_changed
from tests.hard.hostile import GOOD as SCENE
from tests.hard.hostile import MESH, OBJ, beside, mesh, picture, put
from tests.hard.test_hostile_scenes import CASES as SCENES


def studies(good: Good) -> Make:
    """Parts of studies that name modules, claim arrays or are none."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        part = folder / "part"
        shutil.copytree(good.folder / "part", part)
        head = json.loads((part / "patterns.json").read_text())
        names: list[Any] = ["a.b\x1b[2J", None, [], "x" * 9999]
        names += "os.path patterns all ..a antigravity this.that sweep".split()
        if chance.random() < 0.7:
            head["study"] = chance.choice(names)
        head = json_changed(head, chance) if chance.random() < 0.6 else head
        text = json.dumps(head)
        (part / "patterns.json").write_bytes(
            bytes_changed(text.encode(), chance) if chance.random() < 0.2 else text.encode()
        )
        file = next((part / "points").iterdir())
        which = chance.randrange(4)
        if which == 0:
            file.write_bytes(b"")
        elif which == 1:
            file.write_bytes(bytes_changed(file.read_bytes(), chance))
        elif which == 2:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
                packed.writestr("rows.npy", bytes(1 << 24))
        return ("study", "merge", str(part), "-o", str(folder / "out"))

    return make


def arguments(good: Good) -> Make:
    """Words that no argument can have."""
    odd = ["", *"0 -1 nan inf 1e99 x dots: dots:4096 hadamard:4096 random:4096 dots:1x4096 \x1b[2J".split()]

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        out, word = str(folder / "out"), chance.choice(odd)
        light = str(good.folder / "light.npy")
        run, cal = str(good.bench.run), str(good.bench.calibration)
        few = ("--projector-pixels", chance.choice(("4", "128", "4096", "0", "x")))
        sensing = ("sense", light, "--camera", "imx249", "-o", out + ".png")
        imported = ("import", str(good.folder / "a.png"), *FRAMES[:4], "--projector-pixels", "4", "-o", out)
        commands = (
            ("patterns", word, "-o", out, *few),
            ("patterns", "stripes", "-o", out, "--camera", "imx249", "--exposure", word, "--projector-pixels", "2"),
            (*sensing, chance.choice(("--scale", "--exposure", "--f-number")), word),
            (*imported, "--exposure", word),
            ("export", run, "--format", chance.choice(("png", "hdf5", word)), "--projector", word, "-o", out),
            ("reconstruct", run, "--calibration", cal, "--lambda", word, "-o", out),
            ("plan", "photograph", chance.choice("--patterns --accuracy --effects -D".split()), word),
            ("characterise", "imx249", "-o", out, chance.choice("--pixels --steps --frames".split()), "-" + word),
        )
        return chance.choice(commands)

    return make


def scenes(good: Good) -> Make:
    """Scenes that tests/hard/hostile has, which the guard refuses."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        case = chance.choice(SCENES)
        defines = [f"-D{name}={value}" for name, value in case.defines]
        (folder / "in").mkdir()
        return ("plan", str(case.write(folder / "in")), *defines)

    return make


def changed_scenes(good: Good) -> Make:
    """Scenes with values, objects and bytes changed; with bitmaps and meshes of other kinds, in other places and under
    odd names; includes that come back; odd values of parameters."""
    odd = ["a\nb.png", " ", *"\x1b[2J.png -o.png ../a.png /etc/passwd a\\b.png é.png %s.png $albedo".split()]

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        place = folder / "scene"
        place.mkdir()
        beside(place)
        (place / "part.xml").write_text(PART, encoding="utf-8")
        which, text = chance.randrange(5), RICH
        if which in (0, 1):
            text = scene_changed(RICH, chance)
        elif which == 2:
            path = save_picture(place, chance)
            if chance.random() < 0.3:
                misplace(path, chance)
            text = picture(chance.choice(odd) if chance.random() < 0.2 else path.name)
        elif which == 3:
            name, content = chance.choice((("m.ply", MESH), ("m.obj", OBJ)))
            (place / name).write_bytes(bytes_changed(content.encode(), chance))
            text = mesh(name, name[2:])
        else:
            last = chance.choice(("part.xml", "0.xml", "scene.xml", "./0.xml", "no.xml", "..", "/dev/zero"))
            links = chance.choice((1, 2, 40))
            for number in range(links):
                following = f"{number + 1}.xml" if number + 1 < links else last
                include = f'<include filename="{following}"/>'
                (place / f"{number}.xml").write_text(f'<scene version="3.0.0">{include}</scene>')
            text = put('<include filename="0.xml"/>')
        data = text.encode()
        (place / "scene.xml").write_bytes(bytes_changed(data, chance) if chance.random() < 0.2 else data)
        scene, out = str(place / "scene.xml"), str(folder / "out")
        words = ("albedo=", "albedo=nan", "albedo=2", "nope=1", "=1", "albedo=$x", "albedo=0.5\n", "albedo=<a/>")
        define = ("-D", chance.choice(words)) if chance.random() < 0.2 else ()
        verbs = (("plan", scene), ("capture", scene, "-o", out), ("calibrate", scene, "-o", out))
        more = (("render", scene, "-o", out + ".exr"), ("transport", scene, "-o", out + ".h5"))
        command = chance.choice(verbs + more)
        uniform = ("--patterns", "uniform") if command[0] in ("plan", "capture") else ()
        return (*command, *uniform, *define)

    return make


NUMBERS = [
    *"0 -0.0 -1 1e300 -1e300 1e-300 5e-324 1e400 nan -inf 0x7fffffffffffffff 1_000 true [] [[1]] {} 2020-01-01".split(),
    *('"1"', '"nan"', '"\\u0000"', '"\\u202e\\u001b[2J"', "{a = 1}", '""', "'''x'''", "9223372036854775808", "1" * 400),
    *('"' + "x" * 60_000 + '"', "[" + "1, " * 20_000 + "]", "[" * 900 + "]" * 900),
]
"""Values that a field of a TOML file may be given."""


def toml_changed(text: str, chance: random.Random) -> bytes:
    """The good file ``text`` with a value of any kind, keys twice, left out, of other names, or other bytes."""
    lines = text.splitlines()
    keys = [number for number, line in enumerate(lines) if " = " in line and not line.startswith("#")]
    for _ in range(chance.choice((1, 1, 2))):
        number = chance.choice(keys)
        name = lines[number].partition(" = ")[0]
        value = f"{name} = {chance.choice(NUMBERS)}"
        broken = ["", f"{name} = 1\n{name} = 1", f'"{name}\\n" = 1', f"{name}.a.b = 1", f"[{name}]\na = 1", "= 1"]
        broken += [
            f"[[{name}]]",
            f"{name} = 1\n" + "a." * 150 + "b = 1",
            f"ключ = 1\n{lines[number]}",
            f"{lines[number]}\r",
        ]
        lines[number] = value if chance.random() < 0.4 else chance.choice(broken)
    data = "\n".join(lines).encode()
    which = chance.randrange(12)
    if which == 0:
        return b"\xef\xbb\xbf" + data
    if which == 1:
        return data.decode().encode(chance.choice(("utf-16", "utf-32", "latin-1")), "replace")
    return bytes_changed(data, chance) if which == 2 else data


def json_text_changed(text: str, chance: random.Random) -> bytes:
    """A good JSON ``text`` with other items, or as no program should write it: cut, nested, with keys twice, of another
    encoding, numbers of any size and texts for numbers."""
    which = chance.randrange(10)
    if which == 0:
        return text[: chance.randrange(len(text))].encode()
    if which == 1:
        odd = (b"[" * 100_000, b'{"a":' * 100_000, b"[]" * 9, b"", b"null", b'"x"', b"NaN", b"[" + text.encode() + b"]")
        return chance.choice(odd)
    if which == 2:
        return text.encode(chance.choice(("utf-8-sig", "utf-16", "utf-32")))
    if which == 3:
        after = chance.choice(('": 1, "kind": ', '" : -', '": "', '": \ud800', '": Infinity + '))
        return text.replace('": ', after, 1).encode(errors="surrogatepass")
    value = json.loads(text)
    if which in (4, 5):
        return json.dumps(_as_texts(value, chance)).encode()
    for _ in range(chance.choice((1, 1, 2, 3))):
        value = json_changed(value, chance)
    return json.dumps(value).encode()


def _as_texts(value: Any, chance: random.Random) -> Any:
    """Some numbers as texts, whole ones as real ones, lists as objects."""
    if isinstance(value, dict):
        return {name: _as_texts(item, chance) for name, item in value.items()}
    if isinstance(value, list):
        items = [_as_texts(item, chance) for item in value]
        return dict(enumerate(items)) if chance.random() < 0.02 else items
    if isinstance(value, (int, float)) and not isinstance(value, bool) and chance.random() < 0.1:
        return chance.choice((str(value), float(value), bool(value), [value], value * 2**70))
    return value


def devices(good: Good) -> Make:
    """Cameras, projectors and recipes of sessions with numbers that no device has, and drawn masks of any file."""
    texts = {name: (good.folder / f"{name}.toml").read_text("utf-8") for name in ("camera", "projector", "recipe")}
    mask = (
        "\n[mask]\nkind = {!r}\nfeature_mm = 0.06\nfeatures = 101\nopen_part = 0.5\nseed = 3\nfile = 'a.png'\n"
        "edge_blur_um = 1.0\nopaque_transmission = 0.1\nrotation_deg = 1.0\ntilt_row_mrad = 1.0\n"
    )

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        which = chance.choice(("camera", "camera", "mask", "projector", "recipe"))
        text = texts["camera" if which == "mask" else which]
        if which == "mask":
            text += mask.format(chance.choice(("random", "mura", "drawing", "psf", "separable", "flatcam", "open")))
        path = folder / "device.toml"
        path.write_bytes(toml_changed(text, chance))
        out, scene = str(folder / "out"), _scene(folder)
        if which == "recipe":
            return ("calibrate", str(folder / "no.xml"), "--recipe", str(path), "-o", out)
        option = "--projector" if which == "projector" else "--camera"
        plan = ("plan", scene, "--patterns", "uniform", option, str(path))
        if which != "camera":
            return plan
        light, camera = str(good.folder / "light.npy"), ("--camera", str(path))
        commands = (
            plan,
            ("sense", light, *camera, "-o", out + chance.choice((".npy", ".png", ".exr"))),
            ("characterise", str(path), "-o", out, "--pixels", "32", "--steps", "20", "--frames", "2"),
            ("import", str(good.folder / "a.png"), *camera, *FRAMES[2:], "-o", out),
            ("patterns", "stripes", *camera, "--exposure", "0.1", "--projector-pixels", "2", "-o", out),
        )
        return chance.choice(commands)

    return make


def masks(good: Good) -> Make:
    """Masks of camera files that are planned with: drawings, point spread functions and flaws of any size."""
    camera = (good.folder / "camera.toml").read_text(encoding="utf-8")

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        from PIL import Image

        kind = chance.choice(("drawing", "drawing", "psf", "random", "mura", "flatcam", "separable"))
        fields = {"kind": f'"{kind}"', "feature_mm": chance.choice(("0.06", "1e-6", "1e3", "0.01"))}
        if kind in ("drawing", "psf"):
            fields["file"] = '"m.png"'
            sides = chance.choice(((1, 1), (4095, 1), (1, 4096), (4097, 2), (3000, 2999), (300, 20), (8192, 8192)))
            Image.new(chance.choice(("1", "L", "I;16")), sides, chance.choice((0, 1, 255))).save(folder / "m.png")
            if kind == "psf":
                fields |= {"psf_distance_mm": chance.choice(("400.0", "1e-3", "1e10")), "aperture_mm2": "4.0"}
        elif kind in ("random", "mura"):
            fields["features"] = chance.choice(("1", "3", "101", "4093", "4096"))
        if kind != "psf":
            for name, values in (
                ("edge_blur_um", ("1000.0", "1e-9")),
                ("rotation_deg", ("45.0", "180.0", "-90.0", "1e-12")),
                ("tilt_row_mrad", ("300.0", "-300.0")),
            ):
                if chance.random() < 0.2:
                    fields[name] = chance.choice(values)
        table = "".join(f"{name} = {value}\n" for name, value in fields.items())
        (folder / "camera.toml").write_text(f"{camera}\n[mask]\n{table}", encoding="utf-8")
        request = ("--patterns", "uniform", "--accuracy", "0.1", "--camera", str(folder / "camera.toml"), "--quiet")
        return ("plan", _scene(folder), *request)

    return make


def _scene(folder: Path) -> str:
    """A good scene in a folder of its own."""
    (folder / "scene").mkdir()
    beside(folder / "scene")
    (folder / "scene" / "scene.xml").write_text(SCENE, encoding="utf-8")
    return str(folder / "scene" / "scene.xml")


def sessions(good: Good) -> Make:
    """Frames of a real calibration session whose list lies, or whose files are others."""
    listed = (good.folder / "session" / "session.json").read_text(encoding="utf-8")
    fields = json.loads(listed)
    digital = "\n".join(f"{name} = {value}" for name, value in fields["digital"].items())
    toml = f'camera = "bench 3"\nn = {fields["n"]}\nsigned_capture = "pair"\nrepeats = 1\n[digital]\n{digital}\n'

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        frames = folder / "frames"
        shutil.copytree(good.folder / "session", frames)
        which = chance.randrange(4)
        path = chance.choice(sorted(frames.glob("*.png")))
        if which == 0:
            (frames / "session.json").unlink()
            (frames / "session.toml").write_bytes(toml_changed(toml, chance))
        elif which == 1:
            (frames / "session.json").write_bytes(json_text_changed(listed, chance))
        elif which == 2:
            whole = {"side": "horizontal", "index": 0, "sign": 1}
            odd: dict[str, Any] = chance.choice(({"file": "../a.png"}, {"file": "a\nb.png"}, {"index": 2**63}, {}))
            entries = [{"file": each.name, **whole, **odd} for each in sorted(frames.glob("*.png"))]
            dark = chance.choice(([], [{"file": path.name}], [{"file": path.name, "exposure": 1}]))
            (frames / "session.json").write_text(json.dumps({**fields, "frames": entries, "dark": dark}))
        else:
            misplace(path, chance)
        return ("calibrate", "--frames", str(frames), "-o", str(folder / "out"))

    return make


def manifests(good: Good) -> Make:
    """RUN and CAL folders with a manifest of other types, versions and encodings, and files of patterns."""
    shown = (good.folder / "shown" / "patterns.json").read_text(encoding="utf-8")

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        shutil.copytree(good.bench.run, folder / "run")
        shutil.copytree(good.bench.calibration, folder / "cal")
        run, cal, out = str(folder / "run"), str(folder / "cal"), str(folder / "out")
        path = folder / chance.choice(("run", "run", "cal")) / "manifest.json"
        text = path.read_text(encoding="utf-8")
        which = chance.random()
        if which < 0.4:  # any file of the folder
            other = chance.choice(sorted(path.parent.iterdir()))
            misplace(other, chance) if which < 0.1 else other.write_bytes(bytes_changed(other.read_bytes(), chance))
        elif which < 0.5:
            odd = chance.choice(("99.0.0", "0.0.1", "x", 4, None, "\x1b[2J"))
            value = json.loads(text)
            kind = chance.choice((odd, value["kind"]))
            path.write_text(json.dumps({**value, "versions": {"mitsim": odd}, "layout": odd, "kind": kind}))
        else:
            path.write_bytes(json_text_changed(text, chance))
        formats = (("hdf5", ".h5"), ("mat", ".mat"), ("torch", ".pt"))
        kind, ending = chance.choice(formats)
        listed, png = folder / "patterns.json", str(good.folder / "a.png")
        listed.write_bytes(json_text_changed(shown, chance))
        of_file = ("--patterns", str(listed), *FRAMES[4:6], "--projector-pixels", "14")
        commands = (
            ("reconstruct", run, "--calibration", cal, "-o", out, "--lambda", "0.1"),
            ("export", run, "--format", kind, "--calibration", cal, "-o", out + ending),
            ("export", run, "--format", "png", "--projector", "mp_cl1", "-o", out),
            ("import", png, *FRAMES[:2], *of_file, "-o", out),
            ("import", png, *FRAMES[:6], "--calibration", cal, "-o", out),
        )
        return chance.choice(commands)

    return make


def misplace(path: Path, chance: random.Random) -> None:
    """Something else where the file or folder ``path`` was: nothing, an empty file, a folder, a pipe, a device, a link
    to itself, to its folder or to nothing; or the same with times of other days, or no permissions."""
    kept = path.read_bytes() if path.is_file() else b""
    which = chance.randrange(10)
    if which == 8:
        os.utime(path, chance.choice(((0, 0), (-1e9, -1e9), (4e9, 4e9))))
        return
    if which == 9:
        path.chmod(0)
        return
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    if which == 1:
        path.write_bytes(b"")
    elif which == 2:
        path.mkdir()
    elif which == 3:
        os.mkfifo(path)
    elif which == 4:
        path.symlink_to(chance.choice(("/dev/zero", "/dev/tty", "/proc/self/mem", "/etc/passwd", "/")))
    elif which == 5:
        path.symlink_to(path.name)
    elif which == 6:
        path.symlink_to(chance.choice((".", "..", "no such file", "x" * 255)))
    elif which == 7:
        last = path.with_name("kept" + path.suffix)
        last.write_bytes(kept)
        path.symlink_to(last)


def places(good: Good) -> Make:
    """Inputs and outputs in places where they cannot be, under names that nobody gives."""
    names = ["a\nb", " ", "a" * 255, "a" * 256, *"\x1b[2Ja -o --help \udcff é\u202e a/../b con %s{0} ~ *".split()]

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        shutil.copytree(good.bench.run, folder / "run")
        shutil.copytree(good.bench.calibration, folder / "cal")
        shutil.copytree(good.folder / "session", folder / "session")
        for name in ("run.h5", "run.mat", "a.png", "light.exr", "camera.toml"):
            shutil.copy(good.folder / name, folder / name)
        target = chance.choice([*folder.iterdir(), *(folder / "run").iterdir(), *(folder / "cal").iterdir()])
        if chance.random() < 0.7:
            misplace(target, chance)
        name = chance.choice(names) if chance.random() < 0.5 else "out"
        out = folder / name
        put = chance.randrange(6)
        try:
            if put == 0:
                out.mkdir(parents=True)
                (out / "kept").write_text("x")
            elif put == 1:
                out.write_text("x")
            elif put == 2:
                out.symlink_to(chance.choice((out.name, "run", "/dev/null", "/no/such")))
            elif put == 3:
                os.mkfifo(out)
        except OSError:
            pass
        at = {each: str(folder / each) for each in ("run", "cal", "session", "run.h5", "run.mat", "a.png", "light.exr")}
        to, camera = str(out), str(folder / "camera.toml")
        commands = (
            ("reconstruct", at["run"], "--calibration", at["cal"], "-o", to),
            ("export", at["run"], "--format", "hdf5", "-o", to),
            ("export", at["run"], "--format", "png", "--projector", "mp_cl1", "-o", to),
            ("export", at["run"], "--format", "mat", "--calibration", at["cal"], "-o", to + ".mat"),
            ("import", at["run.h5"], "-o", to, "--calibration-output", to + "2"),
            ("import", at["run.mat"], "--channel", "b", "--calibration-output", to),
            ("import", at["a.png"], *FRAMES, "-o", to),
            ("calibrate", "--frames", at["session"], "-o", to),
            ("sense", at["light.exr"], "--camera", camera, "-o", to + chance.choice(("", ".png"))),
            ("patterns", "dots:2", "--projector-pixels", "4", "-o", to),
            ("characterise", camera, "-o", to, "--pixels", "8", "--steps", "20", "--frames", "2"),
        )
        return chance.choice(commands)

    return make


SIMULATED = {
    "scene": "photograph", "scene_sha256": "0", "scene_files": {"a.png": "0"}, "variant": "llvm_ad_mono",
    "defines": {"sheet_z": "390", "albedo": "x"}, "patterns": "dots:4", "accuracy": 0.01, "seed": 0,
    "effects": {"diffraction": False}, "light": {"patterns": "dots:4", "seed": 0}, "projector_model": {},
    "recipe": {"board_reflectance": 0.5}, "sensor": {"bits": 12}, "versions": {"mitsim": "0"},
}  # fmt: skip
"""What the configuration of a simulated run and of its calibration states."""
SMUGGLED = (
    "\n[export]\nformat = 'hdf5'\n",
    "x\r[demo]",
    "\x00",
    "\ud800",
    "\U0001f600",
    "camera",
    "allow_outside_files",
    3,
)


def _done(good: Good, folder: Path) -> None:
    """A finished session of an image and an export in ``folder``, made once."""
    kept = good.folder / "kept"
    if not kept.exists():
        import mitsim

        kept.mkdir()
        shutil.copytree(good.bench.run, kept / "run")
        shutil.copytree(good.bench.calibration, kept / "cal")
        image = {"run": str(kept / "run"), "calibration": str(kept / "cal"), "lambda": 0.1}
        export = {"format": "hdf5", "run": str(kept / "run"), "output": "all.h5"}
        pictures = {"format": "png", "run": str(kept / "run"), "output": "pngs", "projector": "mp_cl1"}
        mitsim.run({"reconstruct": [image], "export": [export, pictures]}, kept / "out", pictures=False)
    for name in ("run", "cal", "out"):
        shutil.copytree(kept / name, folder / name)


def repeats(good: Good) -> Make:
    """Folders whose manifests and results lie, and the session file that repeats them."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        _done(good, folder)
        for name in ("run", "cal"):
            path = folder / name / "manifest.json"
            held = json.loads(path.read_text())
            held |= {"configuration": dict(SIMULATED), "opened": {"camera": None, "projector": "mp_cl1"}}
            if chance.random() < 0.5:
                part = chance.choice(("configuration", "opened", "configuration"))
                held[part] = json_changed(held[part], chance)
                if isinstance(held[part], dict) and chance.random() < 0.3:
                    odd: Any = chance.choice(SMUGGLED)
                    changed = dict(held["configuration"].get("defines") or {}) if part == "configuration" else {}
                    held[part] |= {"defines": {**changed, str(odd): odd}} if changed else {str(odd): odd}
            elif chance.random() < 0.5:
                held = json_changed(held, chance)
            path.write_text(json.dumps(held))
        result = folder / "out" / "image" / "result.json"
        held = json.loads(result.read_text())
        held["made_of"] = {"run": str(folder / "run"), "calibration": str(folder / "cal")}
        result.write_text(json.dumps(json_changed(held, chance) if chance.random() < 0.5 else held))
        source = folder / chance.choice(("run", "cal", "out/image", "out/image", "out"))
        to = ("-o", str(folder / "out" / "again.toml")) if chance.random() < 0.7 else ()
        return ("run", "--from", str(source), *to)

    return make


def resumed(good: Good) -> Make:
    """Sessions whose files were changed, cut, exchanged or lost, and then go on or are shown."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        _done(good, folder)
        out = folder / "out"
        files = [*sorted(path for path in out.rglob("*") if path.is_file()), *[out / "session.json"] * 9]
        path = chance.choice(files)
        which = chance.randrange(4)
        if which == 0:
            misplace(path, chance)
        elif which == 1:
            path.write_bytes(bytes_changed(path.read_bytes(), chance))
        elif path.suffix == ".json":
            path.write_text(json.dumps(json_changed(json.loads(path.read_text()), chance)))
        else:
            path.unlink()
        if chance.random() < 0.3:
            return ("report", str(chance.choice((out / "image", out, folder / "run"))))
        if chance.random() < 0.3:
            return ("run", str(out / "session.toml"), "-o", str(folder / "again"), "--no-pictures")
        return ("run", str(out / "session.toml"), "-o", str(out), "--resume", "--no-pictures")

    return make


def steps(good: Good) -> Make:
    """Sessions whose first steps are good, and a later one not."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        _done(good, folder)
        shutil.rmtree(folder / "out")
        image: dict[str, Any] = {"run": "run", "calibration": "cal", "lambda": 0.1}
        export: dict[str, Any] = {"format": "hdf5", "run": "run", "output": "a.h5"}
        odd: dict[str, Any] = {
            "focus": chance.choice((1e-9, 1e300, "map", "auto", 10**400, "x", -1)),
            "method": chance.choice(("tv", "markov", "none", "a.pt", "")),
            "bounds": chance.choice(([1, 0], [0, 1], [float("nan"), 1], [float("-inf"), 1e300], [1])),
            "lambda": chance.choice((0, -1, 1e200, float("inf"), 10**400, "auto", "x")),
            "iterations": chance.choice((0, 3, 1.5)),
            "depth_range": chance.choice(([1, 2], [0, 1], [1e300, 1e301])),
            "output": chance.choice(("image", "Report.HTML", "./pictures", "\x1b[2J", "a\nb", "\U0001f600", "x" * 300)),
            "run": chance.choice(("cal", "nosuch", ".", "run/manifest.json", "run\u0000")),
            "calibration": chance.choice(("run", "nosuch", "")),
            "format": chance.choice(("png", "mat", "torch", "xyz", "hdf5")),
            "projector": chance.choice(("mp_cl1", "nosuch", "run", "")),
            "chart": chance.choice(("nosuch", "colour_chart")),
        }
        name = chance.choice(sorted(odd))
        either = name in ("run", "output") and chance.random() < 0.5
        table = "export" if name in ("format", "projector") or either else "reconstruct"
        last = {**(export if table == "export" else image), "output": "last", name: odd[name]}
        if chance.random() < 0.3:
            misplace(chance.choice(sorted((folder / chance.choice(("run", "cal"))).iterdir())), chance)
        tables = {"reconstruct": [image], "export": [export], table: [image if table != "export" else export, last]}
        import tomli_w

        (folder / "session.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
        return ("run", str(folder / "session.toml"), "-o", str(folder / "out"), "--no-pictures")

    return make
