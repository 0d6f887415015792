"""Scenes that an estimator cannot render are refused by it, with the place and the remedy; all others are not."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.planner.planner import known_losses

pytestmark = pytest.mark.usefixtures("variant")
Write = Callable[..., Path]
MEDIUM = '<medium name="{name}" type="homogeneous"><float name="sigma_t" value="0.05"/></medium>'
FOG = f"""<shape type="cube" id="fog"><transform name="to_world"><scale value="30"/><translate z="300"/></transform>
    <bsdf type="null"/>{MEDIUM.format(name="interior")}</shape>"""
AIR = f"""<shape type="sphere"><float name="radius" value="5"/><point name="center" x="0" y="0" z="300"/>
    <bsdf type="dielectric"/>{MEDIUM.format(name="exterior")}</shape>"""
SHARED = '<medium id="mist" type="homogeneous"/>'
BEHIND = '<transform name="to_world"><translate z="-50"/></transform></shape>'
CARD = """<shape type="rectangle"><transform name="to_world"><scale x="25" y="25"/><translate z="350"/></transform>
    <bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf></shape>"""
PANE = '<shape type="disk"><bsdf type="thindielectric"/></shape>'
VOLPATH = {"integrator": "volpath"}


def message(action: Callable[[], object]) -> str:
    with pytest.raises(MitsimError) as caught:
        action()
    return str(caught.value)


@pytest.mark.parametrize(
    ("extra", "name", "tag"),
    [
        (FOG, "interior", "<shape type='cube' id='fog'>"),
        (AIR, "exterior", "<shape type='sphere'>"),
        (SHARED + '<shape type="disk"><ref name="interior" id="mist"/>' + BEHIND, "interior", "<shape type='disk'>"),
    ],
)
def test_media_are_for_the_reference_alone(small_scene: Write, extra: str, name: str, tag: str) -> None:
    """Loading for work refuses, and so does the factored estimator of a bench that was opened to render."""
    path = small_scene(extra=extra, **VOLPATH)
    bench = open_bench(path, for_render=True)
    for action in (lambda: open_bench(path), lambda: bench.render("factored"), lambda: bench.plan("uniform")):
        reported = message(action)
        line = path.read_text().split(tag.split(" id")[0].replace("'", '"'))[0].count("\n") + 1
        start = f"{path}:{line}: {name}: got a medium in {tag}; only the reference"
        assert reported.startswith(start) and "\n" not in reported
    assert bench.loaded.unfit.reference is None
    if extra == FOG:
        assert bench.render("reference", spp=4).mean.any()


@pytest.mark.parametrize("written", ["", '<string name="filter_type" value="bilinear"/>'])
def test_a_projector_whose_pixels_run_into_each_other_is_for_the_reference(small_scene: Write, written: str) -> None:
    """Bilinear is Mitsuba's default. (Seen failing: frames 1.7 % brighter than the reference's, without a word.)"""
    path = small_scene(mask="open")
    text, nearest = path.read_text(), '<string name="filter_type" value="nearest"/>'
    path.write_text(text.replace(nearest, written, 1))
    bench = open_bench(path, for_render=True)
    for action in (lambda: open_bench(path), lambda: bench.render("factored"), lambda: bench.plan("uniform")):
        reported = message(action)
        assert "filter_type: got 'bilinear'" in reported and nearest in reported and "blur_pixels" in reported
    assert bench.render("reference", spp=4).mean.any()


@pytest.mark.parametrize("integrator", ["path", "direct"])
@pytest.mark.parametrize(("extra", "cause"), [(FOG, "homogeneous"), (CARD, "mask"), (PANE, "thindielectric")])
def test_integrators_that_lose_light_are_refused(small_scene: Write, integrator: str, extra: str, cause: str) -> None:
    """`path` sees no light through a hole (-17.8 % of a wall behind a card that is not there) and no medium."""
    options = {"integrator": integrator, "integrator_options": ""}
    path = small_scene(extra=extra, **options)
    reported = message(lambda: open_bench(path, for_render=True).render("reference", spp=4))
    line = path.read_text().split(extra)[0].count("\n") + 1
    assert f"{path}:3: integrator: got '{integrator}' in <integrator type='{integrator}'>" in reported
    assert f"it loses light at small.xml:{line} ({cause}); use volpath" in reported


BALL = """<shape type="sphere"><float name="radius" value="5"/><point name="center" x="0" y="0" z="300"/>
    <bsdf type="{}"/></shape>"""
BULB = '<emitter type="point"><point name="position" x="0" y="200" z="0"/></emitter>'


@pytest.mark.parametrize("glass", ["dielectric", "mitsim_glass"])
def test_light_that_mirrors_bring_is_told_as_lost(small_scene: Write, glass: str) -> None:
    """The reference loses the pinhole's, the factored estimator that of small lamps; with file and line, exit 1."""
    path = small_scene(extra=BALL.format(glass))
    unfit = open_bench(path).loaded.unfit
    lines = path.read_text().splitlines()
    line = next(number for number, text in enumerate(lines, 1) if "sphere" in text)
    assert unfit.caustics is not None and unfit.lamps is None
    assert f"small.xml:{line} ({glass})" in unfit.caustics
    assert "'projector'" in unfit.caustics and f"{path}:" in unfit.caustics
    if glass != "dielectric":
        return
    assert open_bench(path).render("reference", spp=4).warnings == (unfit.caustics,)
    lit = small_scene("lit", extra=BALL.format("conductor") + BULB)
    lamps = open_bench(lit).loaded.unfit.lamps
    assert lamps is not None and "'point'" in lamps and "(conductor)" in lamps
    plain = open_bench(small_scene("plain", extra=BALL.format("diffuse") + BULB))
    assert plain.loaded.unfit.caustics is None and plain.loaded.unfit.lamps is None
    assert not plain.render("reference", spp=4).warnings


DIFFUSE, METAL = '<bsdf type="diffuse"/>', '<bsdf type="conductor"/>'
BITMAP = '<texture type="checkerboard" name="{}"/>'


def plate(bsdf: str) -> str:
    return f'<shape type="rectangle"><transform name="to_world"><translate z="300"/></transform>{bsdf}</shape>'


@pytest.mark.parametrize(
    "bsdf",
    [
        *(f'<bsdf type="twosided">{METAL}</bsdf>', f'<bsdf type="twosided">{DIFFUSE}{METAL}</bsdf>'),
        f'<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{DIFFUSE}<bsdf type="dielectric"/></bsdf>',
        f'<bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="twosided">{METAL}</bsdf></bsdf>',
        f'<bsdf type="bumpmap">{BITMAP.format("bump")}{METAL}</bsdf>',
        *(f'<bsdf type="normalmap">{BITMAP.format("normalmap")}{METAL}</bsdf>', '<bsdf type="plastic"/>'),
    ],
)
def test_mirrors_inside_of_other_materials_are_mirrors(small_scene: Write, bsdf: str) -> None:
    """By name in the file as by the flags of the loaded surface; nothing where no shape has the material."""
    loaded = open_bench(small_scene(extra=plate(bsdf), integrator="volpath")).loaded
    assert loaded.mirrors and loaded.unfit.caustics is not None
    unused = open_bench(small_scene("unused", extra=bsdf.replace("<bsdf", '<bsdf id="spare"', 1))).loaded
    assert not unused.mirrors and unused.unfit.caustics is None and unused.unfit.reference is None


def test_glass_in_an_instance_is_told_as_lost(small_scene: Write) -> None:
    """It is no pane and brings no specular chain there, and an instance does not show its materials."""
    group = '<shape type="shapegroup" id="group">{}</shape>'
    move = '<transform name="to_world"><translate z="20"/></transform>'
    placed = f'<shape type="instance"><ref id="group"/>{move}</shape>'
    path = small_scene(extra=group.format(BALL.format("dielectric")) + placed)
    loaded = open_bench(path).loaded
    assert loaded.mirrors and loaded.unfit.instances is not None and "'dielectric'" in loaded.unfit.instances
    reported = list(known_losses(loaded, {}))
    assert reported == [loaded.unfit.instances] and not list(known_losses(loaded, {"mirrors": False}))
    matt = open_bench(small_scene("matt", extra=group.format(BALL.format("diffuse")) + placed)).loaded
    assert matt.unfit.instances is None and not matt.mirrors and matt.glossy


FLAT = '<texture type="bitmap" name="{}"><string name="filename" value="flat.png"/></texture>'
BUMPS = {"normalmap": FLAT.format("normalmap"), "bumpmap": FLAT.format("arbitrary").replace("flat", "small_projector")}
HOLE = '<bsdf type="mask"><float name="opacity" value="0.3"/>{}</bsdf>'
MATT = '<bsdf type="diffuse"/>'
BLEND = f'<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{HOLE.format(MATT)}{MATT}</bsdf>'


@pytest.fixture
def flat(small_scene: Write) -> None:
    """A picture of a surface without bumps, beside the scene."""
    import mitsuba as mi

    mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(small_scene().parent / "flat.png"))


@pytest.mark.usefixtures("flat")
@pytest.mark.parametrize("bumps", BUMPS)
@pytest.mark.parametrize(
    ("inner", "at_fault"),
    [
        *((HOLE.format(MATT), "mask"), (HOLE.format(HOLE.format(MATT)), "mask"), (BLEND, "mask")),
        *(('<bsdf type="null"/>', "null"), ('<bsdf type="thindielectric"/>', "thindielectric")),
    ],
    ids=["mask", "two masks", "blend", "null", "pane"],
)
def test_what_light_passes_is_not_hidden_under_bumps(small_scene: Write, bumps: str, inner: str, at_fault: str) -> None:
    """Connections took it for opaque and lost 6.6 % of a frame; the same turned round, which is as thin, is rendered.

    (Planted: only the outermost material looked at.)
    """
    wrapped = f'<shape type="disk"><bsdf type="{bumps}">{BUMPS[bumps]}{inner}</bsdf>{BEHIND}'
    named = f'<bsdf type="{bumps}" id="bumpy">{BUMPS[bumps]}{inner}</bsdf><shape type="disk"><ref id="bumpy"/>{BEHIND}'
    for extra in (wrapped, named):
        path = small_scene(extra=extra, **VOLPATH)
        assert f"bsdf: got '{at_fault}' in " in message(lambda: open_bench(path, "llvm_ad_mono"))  # noqa: B023
        for_render = open_bench(path, "llvm_ad_mono", for_render=True)
        assert "outermost" in message(lambda: for_render.render("reference", 4))  # noqa: B023
    turned = HOLE.format(f'<bsdf type="{bumps}">{BUMPS[bumps]}{MATT}</bsdf>')
    open_bench(small_scene(extra=f'<shape type="disk">{turned}{BEHIND}', **VOLPATH), "llvm_ad_mono")


AREA = '<emitter type="area"><spectrum name="radiance" value="1"/></emitter>'
NO_SAMPLES = '<integer name="bsdf_samples" value="0"/>'
UNDRAWN = '<float name="sampling_weight" value="0"/></'
THIN = '<shape type="disk"><bsdf type="principledthin"><float name="spec_trans" value="0.5"/></bsdf></shape>'


@pytest.mark.parametrize(
    ("numbers", "line"),
    [
        ({"extra": AREA}, "emitter: got 'area' in <emitter type='area'>; it is the light of a shape"),
        ({"integrator_options": '<boolean name="hide_emitters" value="true"/>'}, "hide_emitters: got true"),
        ({"integrator_options": '<float name="timeout" value="2"/>'}, "timeout: got 2"),
        ({"integrator": "direct", "integrator_options": NO_SAMPLES}, "bsdf_samples: got 0"),
        ({"extra": AREA.replace("area", "constant").replace("</", UNDRAWN, 1)}, "sampling_weight: got 0"),
        ({"extra": THIN}, "spec_trans: got a transmission"),
    ],
    ids=["area", "hide", "timeout", "bsdf", "weight", "thin"],
)
def test_what_one_estimator_alone_would_obey_is_refused(small_scene: Write, numbers: dict[str, str], line: str) -> None:
    """Lamps were in one estimator's frames and not in the other's, with status 0."""
    assert line in message(lambda: open_bench(small_scene(**numbers), "llvm_ad_mono"))


@pytest.mark.usefixtures("flat")
@pytest.mark.parametrize("inner", [*BUMPS, "mitsim_grating", "roughconductor"])
def test_what_differs_along_the_surface_is_not_turned_by_a_bump_map(small_scene: Write, inner: str) -> None:
    """Mitsuba takes the axes of a bump map from another frame: mirrors under two maps lost all their light."""
    own = BUMPS.get(inner, "") + (MATT if inner in BUMPS else "")
    own += '<float name="alpha_u" value="0.2"/>' if inner == "roughconductor" else ""
    bumpy = f'<bsdf type="bumpmap">{BUMPS["bumpmap"]}<bsdf type="{inner}">{own}</bsdf></bsdf>'
    extra = f'<shape type="disk">{bumpy}</shape>'
    assert f"bsdf: got '{inner}' in " in message(lambda: open_bench(small_scene(extra=extra), "llvm_ad_mono"))
