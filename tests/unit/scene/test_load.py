"""Scene files that cannot be used are refused: one line, the file's name, the place and the reason."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene.load import load_scene, why_dark

pytestmark = pytest.mark.usefixtures("variant")
Write = Callable[..., Path]
SHEET = '<scale x="64" y="64"/> <translate z="400"/>'


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (SHEET, "x = -64 to 64, y = -64 to 64, z = 400 to 400 mm of the camera"),
        ('<scale x="0.064" y="0.064"/> <translate z="0.4"/>', "z = 0.4 to 0.4 mm of the camera"),
        ('<scale x="64" y="64"/> <translate x="900" z="-400"/>', "x = 836 to 964, y = -64 to 64, z = -400 to -400"),
    ],
)
def test_the_places_of_scene_and_window_are_named(small_scene: Write, place: str, words: str) -> None:
    path = small_scene()
    text = path.read_text()
    assert SHEET in text
    path.write_text(text.replace(SHEET, place))
    found = why_dark(load_scene(path))
    assert words in found and "the projector lights x = -60 to 60, y = -60 to 60 mm at z = 400 mm" in found


def test_a_scene_of_no_surfaces(small_scene: Write) -> None:
    path = small_scene()
    text = path.read_text()
    path.write_text(text.replace(text[text.index("<shape") : text.index("</shape>") + 8], ""))
    assert "no surfaces" in why_dark(load_scene(path))


# -------- load


def refusal(path: Path, defines: dict[str, str] | None = None, **options: bool) -> str:
    with pytest.raises(MitsimError) as caught:
        load_scene(path, defines, **options)
    message = str(caught.value)
    assert "\n" not in message and "\x1b" not in message and "Traceback" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize(
    ("shape", "given"),
    [
        ('<shape type="sphere"><point name="to_world" x="5" y="5" z="300"/></shape>', "to_world: got a vector"),
        ('<shape type="sphere"><float name="center" value="3"/></shape>', "center: got a float"),
        ('<shape type="cylinder"><string name="p1" value="1 2 3"/></shape>', "p1: got a string"),
        ('<shape type="sphere"><vector name="radius" value="1, 2, 3"/></shape>', "radius: got a vector"),
    ],
)
def test_places_and_sizes_of_another_kind(small_scene: Write, shape: str, given: str) -> None:
    """(Planted: no kind asked for; a point's ``matrix`` is six of its coordinates.)"""
    message = refusal(small_scene(extra=shape))
    assert given in message and "it is given by a <" in message


def test_a_good_scene_loads(small_scene: Write) -> None:
    loaded = load_scene(small_scene(mask="flatcam", mask_distance=3))
    assert loaded.pixels.n == 16 and loaded.lamps == () and not loaded.mirrors
    geometry = loaded.camera.geometry
    assert (geometry.pixels, geometry.mask, geometry.mask_distance) == (64, "flatcam", 3)
    assert geometry.pixel_pitch == pytest.approx(0.01172)


MATT = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>'

BALL = f'<shape type="sphere"><point name="center" x="0" y="0" z="500"/><float name="radius" value="99"/>{MATT}</shape>'


def plate(turned: str, bsdf: str = MATT, shape: str = "rectangle") -> str:
    place = f'<scale x="20" y="20"/><rotate y="1" angle="{turned}"/><translate z="390"/>'
    return f'<shape type="{shape}"><transform name="to_world">{place}</transform>{bsdf}</shape>'


@pytest.mark.parametrize(
    ("extra", "one_way"),
    [
        *(("", True), (plate("180") + plate("180", shape="disk"), True), (plate("180.01"), False)),
        *((plate("0"), False), (plate("180", f'<bsdf type="twosided">{MATT}</bsdf>'), False)),
        (plate("180", f'<bsdf type="mask"><float name="opacity" value="0.5"/>{MATT}</bsdf>'), False),
        (BALL, False),
    ],
)
def test_flat_surfaces_that_face_one_way_see_none_of_each_other(small_scene: Write, extra: str, one_way: bool) -> None:
    """Before the sheet: nothing, plates that face as it does, one turned a little, one that faces it, and what reflects
    or passes light on both sides, or is curved. (Planted: both sides counted as one; any angle below a degree.)"""
    assert load_scene(small_scene(extra=extra)).one_way is one_way


def test_shapes_are_known_by_their_lines(small_scene: Write) -> None:
    """Named and unnamed ones in the order of the file; groups by their instances; none where one tag gave several."""
    kinds = ("sphere", "disk", 'rectangle" id="last', "cube", 'sphere" id="first')
    extra = "\n".join(f'<shape type="{kind}"/>' for kind in kinds)
    group = '\n<shape type="shapegroup" id="group"><shape type="disk"/></shape>\n'
    instance = '<shape type="instance"><ref id="group"/></shape>'
    path = small_scene(extra=extra + group + instance)
    loaded, lines = load_scene(path), path.read_text(encoding="utf-8").splitlines()
    assert len(loaded.shapes) == len(kinds) + 2
    for tag, shape in zip(loaded.shapes, loaded.scene.shapes(), strict=True):
        kind = tag.attributes["type"]
        assert kind == shape.class_name().lower() and f'type="{kind}"' in lines[tag.line - 1]
    merged = '<shape type="merge"><shape type="sphere"/><shape type="disk"/></shape>'
    assert load_scene(small_scene(extra=merged)).shapes == ()


@pytest.mark.parametrize(
    ("bsdf", "mirrors"),
    [
        *(('<bsdf type="conductor"/>', True), ('<bsdf type="dielectric"/>', True), ('<bsdf type="diffuse"/>', False)),
        *(('<bsdf type="thindielectric"/>', True), ('<bsdf type="plastic"/>', True)),  # whose coating is a mirror
        ('<bsdf type="roughconductor"><float name="alpha" value="0.05"/></bsdf>', False),
        ('<bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>', False),
    ],
)
def test_mirrors_are_seen(small_scene: Write, bsdf: str, mirrors: bool) -> None:
    sphere = f'<shape type="sphere"><float name="radius" value="5"/>{bsdf}</shape>'
    assert load_scene(small_scene(extra=sphere, integrator="volpath")).mirrors == mirrors


@pytest.mark.parametrize(
    ("text", "line"),
    [
        *(('<scene version="3.0.0">\n<bsdf>\n</scene>', 3), ("", 1)),
        *(('<scene version="3.0.0">\n<a b=1/></scene>', 2), ('<scene version="3.0.0">\n\n\n&nope;</scene>', 4)),
    ],
)
def test_malformed_xml_names_its_line(tmp_path: Path, text: str, line: int) -> None:
    path = tmp_path / "bad.xml"
    path.write_text(text)
    assert f"{path}:{line}: not well-formed" in refusal(path)


def test_a_missing_scene(tmp_path: Path) -> None:
    assert "no such scene file" in refusal(tmp_path / "missing.xml")
    assert "no such scene file" in refusal(tmp_path)


def told(path: Path, defines: dict[str, str] | None = None) -> list[str]:
    with pytest.raises(MitsimError) as caught:
        load_scene(path, defines or {})
    return str(caught.value).split("\n")


def test_all_unknown_defines_are_told_at_once(small_scene: Write) -> None:
    """(Planted: the first alone.)"""
    head, *lines = told(small_scene(), {"albdo": "1", "albedo": "1", "nothing": "2"})
    assert "2 parameters are unknown; it knows albedo" in head
    assert [line.split(":")[0].strip() for line in lines] == ["parameter albdo=1", "parameter nothing=2"]


def test_all_mistakes_of_a_camera_are_told_at_once(small_scene: Write) -> None:
    """(Planted: the first alone.)"""
    path = replaced(small_scene(), '"mask_distance" value="2"', '"mask_distance" value="-2"')
    head, *lines = told(replaced(path, 'value="separable"', 'value="seperable"'))
    assert head.endswith("the camera has 2 mistakes:")
    assert sorted(line.split(": ")[1] for line in lines) == ["mask", "mask_distance"]


def replaced(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('"mask_distance"', '"mask_distanse"', ["mask_distanse", ":4: "]),
        ('value="separable"', 'value="seperable"', [":7: mask: got 'seperable'", "flatcam"]),
        ('"mask_distance" value="2"', '"mask_distance" value="nan"', ["mask_distance: got nan", "finite"]),
        ('"mask_distance" value="2"', '"mask_distance" value="-2"', ["mask_distance: got -2"]),
        ('"mask_distance" value="2"', '"mask_distance" value="two"', [":10: ", "'mask_distance'", "not parse", "two"]),
        ('"mask_distance" value="2"', '"mask_distance" value="500"', [":10: mask_distance: got 500", "400.0 mm"]),
        ('"mask_order" value="9"', '"mask_order" value="17"', ["mask_order: got 17"]),
        ('"fov" value="20"', '"fov" value="180"', ["fov: got 180"]),
        ('"max_depth"', '"max_dept"', ["max_dept", ":3: "]),
        ('rfilter type="box"', 'rfilter type="gaussian"', ["rfilter type='box'"]),
        ("small_projector.png", "nope.png", ["nope.png"]),
        ('"mitsim_lensless"', '"mitsim_lenless"', [":4: type: got 'mitsim_lenless'", "mean mitsim_lensless"]),
    ],
)
def test_a_bad_parameter_is_named(small_scene: Write, old: str, new: str, fragments: list[str]) -> None:
    message = refusal(replaced(small_scene(), old, new))
    for fragment in fragments:
        assert fragment in message


def test_a_lamp_that_is_no_area_is_refused_in_a_shape(small_scene: Write) -> None:
    """Mitsuba takes it for a lamp of the scene, wherever it stands. (Planted: taken; loading then failed without a word
    of where, as fuzzing found.)"""
    lamp = '<emitter type="point"><rgb name="intensity" value="2"/></emitter>'
    path = small_scene()
    text = path.read_text()
    end = text.rindex("</shape>")
    path.write_text(text[:end] + lamp + text[end:])
    reported = refusal(path)
    assert "type: got 'point'" in reported and "a shape holds area or mitsim_projector only" in reported


def test_a_scene_without_our_sensor(tmp_path: Path) -> None:
    path = tmp_path / "none.xml"
    path.write_text('<scene version="3.0.0"/>')
    assert '0 sensors of type "mitsim_lensless"' in refusal(path)
    path.write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    assert '0 sensors of type "mitsim_lensless"' in refusal(path)


def test_a_scene_without_projector_is_for_render_only(small_scene: Write) -> None:
    path = small_scene()
    text = path.read_text()
    start, end = text.index("<emitter"), text.index("</emitter>") + len("</emitter>")
    path.write_text(text[:start] + '<emitter type="constant"/>' + text[end:])
    assert "needs one emitter of type projector, the file has none" in refusal(path)
    loaded = load_scene(path, needs_projector=False)
    assert loaded.grid is None and loaded.projector is None and len(loaded.lamps) == 1
    with pytest.raises(MitsimError, match="needs one emitter of type projector, the file has none"):
        _ = loaded.pixels


def test_a_film_states_rows_and_columns_and_a_region_of_interest(small_scene: Write) -> None:
    """Width 48, height 64, of which 40 columns from 5 and 30 rows from 20 are seen; beyond the film it is refused."""
    numbers = {"crop_offset_x": 5, "crop_offset_y": 20, "crop_width": 40, "crop_height": 30}
    crop = "".join(f'<integer name="{name}" value="{value}"/>' for name, value in numbers.items())
    path = replaced(small_scene(), '"width" value="64"', '"width" value="48"')
    geometry = load_scene(path).camera.geometry
    assert geometry.shape == geometry.frame_shape == (64, 48) and geometry.roi is None
    geometry = load_scene(replaced(path, '<rfilter type="box"/>', f'<rfilter type="box"/>{crop}')).camera.geometry
    assert geometry.shape == (64, 48) and geometry.frame_shape == (30, 40) and geometry.roi == (20, 5, 30, 40)
    refusal(replaced(path, '"crop_width" value="40"', '"crop_width" value="44"'))
