"""Input that cannot be used (issue 2, item 10): exit 2, one line that names place and value, and nothing written."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

Refused = Callable[..., str]
NEW = ("-o", "new")


def mentions(line: str, *fragments: str) -> None:
    """Every fragment stands in the line."""
    for fragment in fragments:
        assert fragment in line, (fragment, line)


# ---- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "verb",
    [
        ("plan",),
        ("capture", *NEW, "--patterns", "dots:4"),
        ("calibrate", *NEW),
        ("render", "-o", "new.exr"),
        ("render", "-o", "new.exr", "--estimator", "factored"),
        ("study", "accuracy", *NEW),
        ("demo", *NEW),
    ],
    ids=lambda verb: verb[0],
)
def test_every_verb_refuses_a_scene_it_cannot_load(refused: Refused, tmp_path: Path, verb: tuple[str, ...]) -> None:
    mentions(refused(*verb, "nowhere.xml"), "nowhere.xml", "no such scene file")
    mentions(refused(*verb, "nowhere"), "nowhere", "shipped", "photograph", "resolution_target")
    (tmp_path / "broken.xml").write_text('<scene version="3.0.0">\n<bsdf>\n</scene>')
    mentions(refused(*verb, "broken.xml"), "broken.xml:3", "not well-formed")


def test_a_folder_without_scene(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    mentions(refused("plan", "empty"), "empty/scene.xml")


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('"mask_distance" value="2"', '"mask_distanse" value="2"', ["mask_distanse"]),
        ('"mask_distance" value="2"', '"mask_distance" value="nan"', ["mask_distance", "nan"]),
        ('"mask_distance" value="2"', '"mask_distance" value="-2"', ["mask_distance", "-2"]),
        ('"max_depth" value="2"', '"max_depht" value="2"', ["max_depht"]),
        ('"pixel_pitch" value="0.01172"', '"pixel_pitch" value="0.012"', ["pitch", "11.72", "12 um"]),
        ("_projector.png", "_nothing.png", ["_nothing.png"]),
        ('type="projector"', 'type="projektor"', ["projektor"]),
    ],
)
def test_a_scene_with_a_bad_parameter(
    refused: Refused, small_scene: Callable[..., Path], old: str, new: str, fragments: list[str]
) -> None:
    path = small_scene()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    mentions(refused("capture", path, *NEW, "--patterns", "dots:4"), *fragments)


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('"fov" value="33.398488"', '"fov" value="nan"', ["fov: got nan", "finite"]),
        ('<translate x="60"/>', '<translate x="inf"/>', ["to_world: got nan", "finite"]),
        ('<scale x="64" y="64"/>', '<scale x="nan" y="64"/>', ["to_world: got nan"]),
        ('value="1 0 0 0 0 1', 'value="1 0 0 nan 0 1', ["to_world: got nan", "got nan"]),
        ('"scale" value="111000"', '"scale" value="-1"', ["scale: got -1", "at least 0"]),
        ('value="$albedo"', 'value="nan"', ["reflectance: got nan"]),
        ('value="$albedo"', 'value="400:0.5, 700:-0.5"', ["reflectance: got -0.5", "at least 0"]),
        ('value="$albedo"', 'value="1.5"', ["reflectance: got 1.5", "more than 1"]),
        ("</scene>", '<path value="/tmp"/></scene>', ["<path value='/tmp'>", "native code"]),
        ("</scene>", '<include filename="small.xml"/></scene>', ["<include filename='small.xml'>", "itself"]),
        ("</scene>", '<include filename="nowhere.xml"/></scene>', ["<include filename='nowhere.xml'>", "no such file"]),
    ],
)
def test_a_scene_that_mitsuba_would_take_without_a_word(
    refused: Refused, small_scene: Callable[..., Path], old: str, new: str, fragments: list[str]
) -> None:
    path = small_scene()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    for verb in (("capture", "--patterns", "uniform", *NEW), ("render", "-o", "new.exr")):
        mentions(refused(*verb, path), str(path), *fragments)


@pytest.mark.parametrize("value", ["nan", "-1", "2", "inf"])
def test_a_define_that_no_material_can_have(refused: Refused, small_scene: Callable[..., Path], value: str) -> None:
    line = refused("capture", small_scene(), *NEW, "--patterns", "uniform", "-D", f"albedo={value}")
    mentions(line, "reflectance: got", value, "$albedo")


def test_included_files_are_looked_at_too(
    refused: Refused, call: Callable[..., Any], small_scene: Callable[..., Path]
) -> None:
    path = small_scene()
    path.write_text(path.read_text().replace("</scene>", '<include filename="part.xml"/></scene>'))
    part = path.parent / "part.xml"
    shape = '<scene version="3.0.0"><shape type="sphere">{}</shape></scene>'
    behind = '<point name="center" value="0, 0, -9"/><float name="radius" value="{}"/>'
    part.write_text(shape.format(behind.format(1)))
    assert call("plan", path, "--accuracy", "0.3").code in (0, 1)
    part.write_text(shape.format(behind.format("inf")))
    mentions(refused("plan", path), "part.xml", "radius: got inf")


def test_native_code_beside_a_scene(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    (path.parent / "plugins").mkdir()
    (path.parent / "plugins" / "mine.so").write_bytes(b"\x7fELF")
    mentions(refused("plan", path), str(path), "plugins/mine.so", "native code")


def test_a_scene_without_projector(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    text = path.read_text()
    end = text.index("</emitter>") + len("</emitter>")
    path.write_text(text[: text.index("<emitter")] + '<emitter type="constant"/>' + text[end:])
    mentions(refused("capture", path, *NEW, "--patterns", "dots:4"), str(path), '0 emitters of type "projector"')


def test_a_scene_that_sends_no_light_back(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    render = "render", "--estimator", "factored", "-o", "new.exr"
    for verb in (("capture", "--patterns", "dots:4", *NEW), ("plan",), render):
        mentions(refused(*verb, path, "-D", "albedo=0"), "no light")


@pytest.mark.parametrize(
    ("define", "fragments"),
    [
        ("albdo=0.5", ["albdo", "albedo"]),
        ("albedo", ["'albedo'", "NAME=VALUE"]),
        ("=3", ["'=3'", "NAME=VALUE"]),
        ("albedo=half", ["half"]),
    ],
)
def test_a_bad_define(refused: Refused, small_scene: Callable[..., Path], define: str, fragments: list[str]) -> None:
    path = small_scene()
    for verb in (("plan",), ("capture", *NEW, "--patterns", "dots:4"), ("render", "-o", "new.exr")):
        mentions(refused(*verb, path, "-D", define), *fragments)


# ---- values of options -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--patterns", "dots:17"], ["dots:17", "17", "16"]),
        (["--patterns", "dots:0"], ["dots:0", "1 to 16"]),
        (["--patterns", "dots"], ["'dots'", "dots:K"]),
        (["--patterns", "dots:x"], ["'x'", "whole number"]),
        (["--patterns", "dots:-1"], ["-1"]),
        (["--patterns", "uniform:2"], ["uniform:2"]),
        (["--patterns", "stripes:2"], ["stripes:2", "hadamard:K"]),
        (["--patterns", ""], ["''"]),
        (["--patterns", "hadamard:7"], ["order 7", "use 4 or 8"]),
        (["--exposure", "-1"], ["exposure -1", "to 1e+06"]),
        (["--exposure", "0"], ["exposure 0", "to 1e+06"]),
        (["--exposure", "nan"], ["nan"]),
        (["--exposure", "inf"], ["inf"]),
        (["--exposure", "1e300"], ["1e+300"]),
        (["--exposure", "long"], ["'long'", "auto"]),
        (["--exposure-fraction", "0"], ["fraction 0", "to 1"]),
        (["--exposure-fraction", "1.5"], ["1.5", "to 1"]),
        (["--exposure-fraction", "nan"], ["nan"]),
        (["--accuracy", "0"], ["--accuracy 0", "1e-06"]),
        (["--accuracy", "-0.1"], ["--accuracy -0.1"]),
        (["--accuracy", "nan"], ["--accuracy nan"]),
        (["--accuracy", "2"], ["--accuracy 2", "0.3"]),
        (["--accuracy", "fine"], ["'fine'"]),
        (["--seed", "-1"], ["-1", "seed"]),
        (["--seed", "1.5"], ["'1.5'"]),
        (["--seed", str(2**64)], [str(2**64)]),
        (["--variant", "llvm_ad_grey"], ["llvm_ad_grey", "llvm_ad_mono"]),
        (["--variant", "scalar_rgb"], ["scalar_rgb", "llvm_ad_mono"]),
        (["--resumee"], ["--resumee"]),
        (["--max-seconds", "1e-4"], ["dots:4: would take about", "allowed are 0.0001 s", "--max-seconds"]),
        (["--max-seconds", "nan"], ["--max-seconds nan", "above 0"]),
        (["--max-memory", "0.1"], ["dots:4: would take about", "of memory", "102 MiB"]),
        (["--max-memory", "0"], ["--max-memory 0", "above 0"]),
    ],
    ids=lambda value: " ".join(value) if value and value[0].startswith("--") else None,
)
def test_capture_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    patterns = () if "--patterns" in options else ("--patterns", "dots:4")
    mentions(refused("capture", *lab.rig, *NEW, *patterns, *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--accuracy", "0"], ["--accuracy 0"]),
        (["--accuracy", "nan"], ["--accuracy nan"]),
        (["--seed", "-1"], ["-1"]),
        (["--recipe", "nowhere.toml"], ["nowhere.toml"]),
        (["--max-seconds", "0.001"], ["calibration: would take about", "allowed are 0.001 s"]),
        (["--max-memory", "0.1"], ["calibration: would take about", "of memory"]),
        (["--variant", "llvm_ad_grey"], ["llvm_ad_grey"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else None,
)
def test_calibrate_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("calibrate", *lab.rig, *NEW, *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--spp", "0"], ["--spp 0", "at least 4"]),
        (["--spp", "-64"], ["--spp -64"]),
        (["--spp", "many"], ["'many'"]),
        (["--estimator", "fast"], ["'fast'", "reference or factored"]),
        (["--estimator", "factored", "--accuracy", "0"], ["--accuracy 0"]),
        (
            ["--spp", "100000", "--max-seconds", "0.1"],
            ["100000 samples a pixel: would take about", "allowed are 0.1 s"],
        ),
        (["--estimator", "factored", "--max-memory", "0.1"], ["would take about", "of memory"]),
        (["--seed", "-1"], ["-1"]),
        (["--variant", "llvm_ad_grey"], ["llvm_ad_grey"]),
    ],
    ids=" ".join,
)
def test_render_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("render", lab.scene, "-o", "new.exr", *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--lambda", "-1"], ["--lambda -1", "at least 0"]),
        (["--lambda", "nan"], ["--lambda nan"]),
        (["--lambda", "inf"], ["--lambda inf"]),
        (["--lambda", "small"], ["'small'", "auto"]),
        (["--method", "wiener"], ["'wiener'", "tikhonov or tv"]),
        (["--method", "tv", "--lambda", "-1"], ["--lambda -1"]),
        (["--variant", "llvm_ad_grey"], ["llvm_ad_grey", "llvm_ad_mono"]),
    ],
    ids=" ".join,
)
def test_reconstruct_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("reconstruct", lab.run, "--calibration", lab.calibration, *options), *fragments)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["study", "weather", "photograph", *NEW], ["'weather'", "accuracy"]),
        (["plan", "photograph", "--accuracy", "0"], ["--accuracy 0"]),
        (["plan", "photograph", "--patterns", "dots:129"], ["dots:129", "128"]),
        (["plan", "photograph", "--seed", "-1"], ["-1"]),
        (["doctor", "--variant", "llvm_ad_grey"], ["llvm_ad_grey", "llvm_ad_mono"]),
        (["develop"], ["develop"]),
        (["capture", "photograph"], ["--output"]),
        (["reconstruct"], ["RUN"]),
        (["plan"], ["SCENE"]),
    ],
    ids=lambda value: " ".join(value[:4]),
)
def test_others_refuse(refused: Refused, arguments: list[str], fragments: list[str]) -> None:
    mentions(refused(*arguments), *fragments)


def test_a_study_refuses_patterns_that_do_not_fit(refused: Refused, lab: Any) -> None:
    mentions(refused("study", "accuracy", lab.scene, *NEW, "--patterns", "dots:17"), "dots:17", "16")


def test_a_demo_refuses_a_projector_too_small_for_its_families(refused: Refused, lab: Any) -> None:
    mentions(refused("demo", *NEW, lab.write_scene("tiny", n=4)), "dots:", "4")


# ---- camera, projector and recipe files ------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--camera", "--projector"])
@pytest.mark.parametrize("verb", ["plan", "capture", "calibrate"])
def test_a_missing_toml(refused: Refused, lab: Any, verb: str, option: str) -> None:
    rest = {"plan": (), "capture": (*NEW, "--patterns", "dots:4"), "calibrate": NEW}[verb]
    mentions(refused(verb, lab.scene, *rest, option, "nowhere.toml"), "nowhere.toml", "No such file")


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ("read_noise_e = 6.7", "read_noize_e = 6.7", ["read_no"]),
        ("read_noise_e = 6.7", "read_noise_e = nan", ["read_noise_e", "nan"]),
        ("read_noise_e = 6.7", "read_noise_e = -6.7", ["read_noise_e", "-6.7"]),
        ("full_well_e = 32360.0", "full_well_e = nan", ["full_well_e", "nan"]),
        ("full_well_e = 32360.0", "full_well_e = inf", ["full well"]),
        ("binning = 2", "binning = 0", ["binning", "0"]),
        ("binning = 2", "binning = 1", ["5.86 um", "11.72 um"]),
        ("gain_dn_per_e = 0.125", "gain_dn_per_e = 0", ["gain_dn_per_e", "0"]),
        ("bits = 12", "bits = 5", ["black_level_dn"]),
        ("bits = 12", "bits = 12.5", ["bits", "12.5"]),
        ("quantum_efficiency = 0.75", "quantum_efficiency = 1.2", ["quantum_efficiency", "1.2"]),
        ("quantum_efficiency = 0.75", "quantum_efficiency = '75 %'", ["quantum_efficiency", "75 %"]),
        ("bits = 12", "bits = ", ["not valid TOML", "line 11"]),
        ("bits = 12", "bits = 12\nbits = 10", ["not valid TOML", "line 12"]),
    ],
)
def test_a_camera_file_with_a_mistake(
    refused: Refused, lab: Any, tmp_path: Path, old: str, new: str, fragments: list[str]
) -> None:
    text = lab.camera.read_text()
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new))
    for verb in (("capture", "--patterns", "dots:4"), ("calibrate",)):
        mentions(refused(*verb, *lab.rig, *NEW, "--camera", "mine.toml"), "mine.toml", *fragments)


@pytest.mark.parametrize("value", ["nan", "-562.0", "0", "inf", "'green'"])
def test_a_projector_file_with_a_mistake(refused: Refused, lab: Any, tmp_path: Path, value: str) -> None:
    (tmp_path / "mine.toml").write_text(f'name = "mine"\neffective_wavelength_nm = {value}\n')
    for verb in (("capture", "--patterns", "dots:4"), ("calibrate",)):
        line = refused(*verb, lab.scene, *NEW, "--projector", "mine.toml")
        mentions(line, "mine.toml", "effective_wavelength_nm", value)


def test_a_projector_file_without_its_wavelength(refused: Refused, lab: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\neffective_wavelenght_nm = 562\n')
    mentions(refused("plan", lab.scene, "--projector", "mine.toml"), "effective_wavelength_nm", "mine.toml")


@pytest.mark.parametrize(
    "line", ["exposure_fraction = 0", "exposure_fraction = nan", "board_reflectance = 1.5", "signed_capture = 'half'"]
)
def test_a_recipe_with_a_mistake(refused: Refused, lab: Any, tmp_path: Path, line: str) -> None:
    recipe = {"board_reflectance": "0.99", "exposure_fraction": "0.8", "signed_capture": "'pair'", "source": "'me'"}
    name, value = line.split(" = ")
    (tmp_path / "mine.toml").write_text("".join(f"{k} = {v}\n" for k, v in {**recipe, name: value}.items()))
    mentions(refused("calibrate", *lab.rig, *NEW, "--recipe", "mine.toml"), "mine.toml", name, value)


def test_binary_files_where_text_is_expected(refused: Refused, lab: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"\x80\xff\x00name")
    mentions(refused("plan", lab.scene, "--camera", "mine.toml"), "mine.toml")
    (tmp_path / "scene.xml").write_bytes(b"\x80\xff\x00<scene/>")
    mentions(refused("plan", "scene.xml"), "scene.xml")


# ---- outputs ---------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["capture", "calibrate", "reconstruct", "render", "study", "demo"])
def to(request: pytest.FixtureRequest, lab: Any) -> Callable[[str], tuple[object, ...]]:
    """Arguments of each verb that writes, with the output given."""
    verb = {
        "capture": ("capture", *lab.rig, "--patterns", "dots:4"),
        "calibrate": ("calibrate", *lab.rig),
        "reconstruct": ("reconstruct", lab.run, "--calibration", lab.calibration),
        "render": ("render", lab.scene, "--spp", "4"),
        "study": ("study", "accuracy", lab.scene),
        "demo": ("demo", lab.scene),
    }[request.param]
    return lambda output: (*verb, "-o", output)


def test_an_output_below_a_file(refused: Refused, tmp_path: Path, to: Callable[[str], tuple[object, ...]]) -> None:
    (tmp_path / "file").write_text("mine")
    mentions(refused(*to("file/new.exr")), "file/new")


def test_an_output_where_nothing_can_be_written(refused: Refused, to: Callable[[str], tuple[object, ...]]) -> None:
    # Tests may run as root, whom permission bits do not stop; in /proc nobody can make files.
    mentions(refused(*to("/proc/new.exr")), "/proc/new")
    mentions(refused(*to("nowhere/new.exr")), "nowhere/new")


def test_an_output_of_the_other_kind(refused: Refused, tmp_path: Path, to: Callable[[str], tuple[object, ...]]) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.exr").mkdir()
    mentions(refused(*to("folder.exr" if "render" in to("") else "file")), "is a f")


def test_a_frame_that_is_no_exr(refused: Refused, lab: Any) -> None:
    mentions(refused("render", lab.scene, "-o", lab.scene), str(lab.scene), ".exr")


def test_a_name_that_no_file_can_have(refused: Refused, to: Callable[[str], tuple[object, ...]]) -> None:
    mentions(refused(*to("n" * 300 + ".exr")), "nnn", "name too long")


@pytest.mark.parametrize("verb", ["capture", "calibrate", "demo", "reconstruct"])
def test_a_folder_that_holds_something(refused: Refused, lab: Any, tmp_path: Path, verb: str) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("keep me")
    arguments = {
        "capture": ("capture", *lab.rig, "--patterns", "dots:4"),
        "calibrate": ("calibrate", *lab.rig),
        "demo": ("demo", lab.scene),
        "reconstruct": ("reconstruct", lab.run, "--calibration", lab.calibration),
    }[verb]
    mentions(refused(*arguments, "-o", "mine"), "mine", "holds files")


# ---- what no check foresees ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "fragment"),
    [
        (MemoryError(), "out of memory"),
        (OSError(errno.ENOSPC, "No space left on device"), "output: No space left on device"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a" * 9), "aaaaaaaaa: File name too long"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else None,
)
def test_faults_of_the_machine_are_one_line(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, error: Exception, fragment: str
) -> None:
    monkeypatch.setattr("mitsim.core.environment.doctor", Mock(side_effect=error))
    mentions(refused("doctor"), fragment)


def test_a_fault_of_ours_is_not_dressed_up(call: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mitsim.core.environment.doctor", Mock(side_effect=OSError(errno.EINVAL, "Invalid argument")))
    with pytest.raises(OSError, match="Invalid argument"):
        call("doctor")
