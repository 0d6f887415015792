"""Mutations of good files from a seed, and what is done with each; run as a program, it works in a process of its own.

``python -m tests.hard.fuzz KIND FIRST COUNT SECONDS`` prints each seed before its file is touched, so that the parent
knows which one a crash belongs to, and at the end how many were taken and refused.
"""

from __future__ import annotations

import json
import random
import re
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame, write_frame
from mitsim.core.runs import load_run
from mitsim.scene.check import PLUGINS, check_file
from tests.hard.hostile import GOOD, MESH, OBJ, beside, file

LONGEST = 5.0
_ROOM = 6 << 30
RICH = GOOD.replace("<!--here-->", (Path(__file__).parent / "hostile" / "more.xml").read_text(encoding="utf-8"))
PART = '<scene version="3.0.0"><shape type="sphere"><ref id="own"/></shape><bsdf type="diffuse" id="own"/></scene>'
_TEXTS = (
    "|0|-0|1|-1|2|1e9|-1e9|1e-9|1e38|1e39|-1e308|1e-45|nan|inf|-inf|0x10|1,2|1 2 3|1,2,3,4|0 0 0|true|false|"
    "$size|$|$$|\\$|..|/dev/zero|projector.png|mesh.ply|part.xml|scene.xml|diffuse|twosided|mask|sphere|bitmap|"
    "path|volpath|null|two|paper|group|squares|reflectance|radius|to_world|filename|long|"
    "é|&#10;|999999999|-999999999|400:1|400:1,500:2|instance|shapegroup|merge|normalmap|hair|conductor|envmap|"
    "directional|rawconstant|blackbody|mesh_attribute|principledthin|pplastic|measured"
)
_VALUES = tuple("x" * 3000 if text == "long" else text for text in _TEXTS.split("|"))
_WORDS = tuple(
    f"<{word}" for word in ("shape", "bsdf", "texture", "ref", "float", "scene", "path", "include", "!--", "![CDATA[")
)


def bytes_changed(content: bytes, chance: random.Random) -> bytes:
    """Some bytes flipped, cut out, doubled or put in."""
    data = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 4, 16))):
        at, length = chance.randrange(len(data) + 1), chance.choice((1, 1, 2, 8, 64))
        kind = chance.randrange(4)
        if kind == 0:
            data[at : at + 1] = bytes([chance.choice((0, 1, 34, 60, 127, 128, 255, chance.randrange(256)))])
        elif kind == 1:
            del data[at : at + length]
        elif kind == 2:
            data[at:at] = data[at : at + length] * chance.choice((1, 2, 100))
        else:
            data[at:at] = chance.choice(_WORDS).encode()
    return bytes(data)


def scene_changed(content: str, chance: random.Random) -> str:
    """Well-formed for the most part: values exchanged, elements taken away, doubled or moved."""
    lines = content.split("\n")
    for _ in range(chance.choice((1, 1, 2, 3))):
        at = chance.randrange(2, len(lines) - 2)
        quotes = [i for i, letter in enumerate(lines[at]) if letter == '"']
        kind = chance.randrange(7)
        all = [*re.finditer(r'<(\w+) type="(\w+)"', lines[at])]
        if kind < 4 and len(quotes) >= 2:
            first = chance.randrange(0, len(quotes) - 1, 2)
            lines[at] = lines[at][: quotes[first] + 1] + chance.choice(_VALUES) + lines[at][quotes[first + 1] :]
        elif kind == 4:
            lines[at] = ""
        elif kind == 5 and all:
            found = chance.choice(all)
            lines[at] = lines[at][: found.start(2)] + chance.choice(PLUGINS[found[1]]) + lines[at][found.end(2) :]
        else:
            lines.insert(chance.randrange(2, len(lines) - 2), lines[at])
    return "\n".join(lines)


def json_changed(value: object, chance: random.Random) -> object:
    """One item somewhere exchanged for another."""
    odd = (None, True, -1, 0, 1.5, 1e300, -1e308, 10**30, "", "x", "../a", [], {}, [[]], {"a": 1}, float("nan"), "a\nb")
    if isinstance(value, dict) and value and chance.random() < 0.9:
        key = chance.choice(sorted(value))
        if chance.random() < 0.1:
            return {name: item for name, item in value.items() if name != key}
        return {**value, key: json_changed(value[key], chance)}
    if isinstance(value, list) and value and chance.random() < 0.9:
        at = chance.randrange(len(value))
        return [*value[:at], json_changed(value[at], chance), *value[at + 1 :]]
    return chance.choice(odd)


class Fuzz:
    """One folder with good files; each kind of work takes a seed and raises nothing but MitsimError of one line."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        beside(folder)
        file("part.xml", PART)(folder)
        self.scene = folder / "scene.xml"
        rng = np.random.default_rng(2)
        pixels = {"DN": rng.integers(0, 4095, (16, 16), dtype=np.uint32), "e": rng.random((16, 16), dtype=np.float32)}
        write_frame(folder / "a.exr", pixels, {"run": "x", "index": 3})
        self.frame = (folder / "a.exr").read_bytes()
        captures = [{"file": f"{i}{j}.exr", "row": i, "column": j, "sign": 0} for i in range(2) for j in range(2)]
        self.manifest = {
            "kind": "capture",
            "status": "complete",
            "camera": {"name": "bench"},
            "digital": {"exposure_s": 0.02, "black_level_dn": 40, "gain_dn_per_e": 0.1, "dark_current_e_per_s": 1},
            "patterns": {"P_L": [[1, 0], [0, 1]], "P_R": [[1, 0], [0, 1]], "captures": captures},
            "checksums": {"b.exr": "0"},
        }

    def xml(self, seed: int) -> None:
        """Scene files through the check alone."""
        chance = random.Random(seed)
        content = scene_changed(RICH, chance)
        self.scene.write_bytes(content.encode() if seed % 2 else bytes_changed(content.encode(), chance))
        check_file(self.scene, {})

    def load(self, seed: int) -> None:
        """Scene files that pass the check, loaded by Mitsuba and looked at by rays."""
        from mitsim.scene.load import load_scene

        self.scene.write_text(scene_changed(RICH, random.Random(seed)), encoding="utf-8")
        check_file(self.scene, {})
        load_scene(self.scene, needs_projector=False)

    def mesh(self, seed: int) -> None:
        """Mesh files that pass the check, loaded by Mitsuba."""
        from mitsim.scene.load import load_scene

        chance = random.Random(seed)
        name, content = (("m.ply", MESH), ("m.obj", OBJ))[seed % 2]
        file(name, bytes_changed(content.encode(), chance))(self.folder)
        kind = name[2:]
        shape = f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'
        self.scene.write_text(GOOD.replace("<!--here-->", shape))
        check_file(self.scene, {})
        load_scene(self.scene, needs_projector=False)

    def image(self, seed: int) -> None:
        """Pictures that pass the check, loaded by Mitsuba."""
        from mitsim.scene.load import load_scene

        chance = random.Random(seed)
        good = self.frame if seed % 2 else (self.folder / "projector.png").read_bytes()
        file("p.exr" if seed % 2 else "p.png", bytes_changed(good, chance))(self.folder)
        light = f'<emitter type="envmap"><string name="filename" value="p.{"exr" if seed % 2 else "png"}"/></emitter>'
        self.scene.write_text(GOOD.replace("<!--here-->", light))
        check_file(self.scene, {})
        load_scene(self.scene, needs_projector=False)

    def json(self, seed: int) -> None:
        """Manifests: other items in good JSON, or other bytes."""
        chance = random.Random(seed)
        manifest = self.manifest
        for _ in range(chance.choice((1, 2, 3))):
            manifest = json_changed(manifest, chance)  # type: ignore[assignment]
        content = json.dumps(manifest).encode()
        (self.folder / "manifest.json").write_bytes(content if seed % 2 else bytes_changed(content, chance))
        load_run(self.folder)

    def exr(self, seed: int) -> None:
        """Frames with other bytes, mostly in the header."""
        chance = random.Random(seed)
        data = self.frame
        header = 700
        changed = bytes_changed(data[:header], chance) + data[header:] if seed % 4 else bytes_changed(data, chance)
        (self.folder / "b.exr").write_bytes(changed)
        read_frame(self.folder / "b.exr")


def run(
    work: Callable[[int], None], first: int, count: int, seconds: float, tell: Callable[[int], object]
) -> tuple[int, int]:
    """Count what was taken and what was refused, until the count or the ``seconds`` of processor time are reached."""
    taken = refused = 0
    end = time.process_time() + seconds
    for seed in range(first, first + count):
        tell(seed)
        started = time.process_time()
        if started > end:
            break
        try:
            work(seed)
            taken += 1
        except MitsimError as error:
            message = str(error)
            assert message.replace("\n", " ").isprintable() and len(message) <= 1500, message
            refused += 1
        spent = time.process_time() - started
        assert spent < LONGEST, f"seed {seed} took {spent:.1f} s"
    return taken, refused


def _hangs(signal_number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"over {LONGEST * 4} s")


def main() -> None:
    """Work in this process, with a bound on memory and an alarm for what hangs."""
    kind, first, count, seconds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    if kind in ("load", "mesh", "image"):
        from mitsim.core.environment import load_variant
        from mitsim.transport import plugins

        mi = load_variant("llvm_ad_mono")
        mi.set_log_level(mi.LogLevel.Error)
        plugins.register()
    else:
        resource.setrlimit(resource.RLIMIT_AS, (_ROOM, resource.RLIM_INFINITY))
    signal.signal(signal.SIGPROF, _hangs)

    def reported(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    def tell(seed: int) -> None:
        signal.setitimer(signal.ITIMER_PROF, LONGEST * 4)
        reported(f"seed {seed}")

    with tempfile.TemporaryDirectory() as folder:
        taken, refused = run(getattr(Fuzz(Path(folder)), kind), first, count, seconds, tell)
    reported(f"{kind}: {taken} taken, {refused} refused")


if __name__ == "__main__":
    main()
