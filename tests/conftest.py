"""Shared by all tests: shipped scenes loaded once, and small scenes written from one template.

Everything here uses the variant ``llvm_ad_mono``. Another variant is tested in a child process, because objects of one
variant must not be used after switching.
"""

import ctypes
import gc
import itertools
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.configuration import shipped_path
from tests.kept_plans import plans_kept

pytest_plugins = ["tests.robustness"]


def pytest_configure() -> None:
    """Give each of several test processes (pytest-xdist) processors of its own, and with them its threads' number.

    Threads of Dr.Jit wait busily: two processes on the same two cores take twice the time.
    """
    worker, count = os.environ.get("PYTEST_XDIST_WORKER"), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if worker and hasattr(os, "sched_setaffinity"):
        own = sorted(os.sched_getaffinity(0))[int(worker.removeprefix("gw")) :: count]
        if own:
            os.sched_setaffinity(0, own)
    if width := os.environ.get("MITSIM_VECTOR_WIDTH"):
        set_vector_width(int(width))


def pytest_collection_finish() -> None:
    """Exempt all collected tests from the garbage collector, which would go over them again and again."""
    gc.collect()
    gc.freeze()


def set_vector_width(width: int) -> None:
    """Let Dr.Jit compile for vectors of 4, 8 or 16 floats, as it does on processors with SSE, AVX2 and AVX-512.

    ``MITSIM_VECTOR_WIDTH=4 pytest tests/unit`` tries tests so. LLVM emulates a width that this processor lacks.
    Programs that tests start keep the processor's own width: their frames differ in the last bits from those made here.
    """
    from mitsim.core.environment import load_variant

    load_variant("llvm_ad_mono")
    import drjit

    library = ctypes.CDLL(str(next(Path(drjit.__file__).parent.glob("libdrjit-core.*"))))
    processor, features, set_target, read_width = (  # exported as C++ functions
        library[name]
        for name in (
            "_Z19jit_llvm_target_cpuv",
            "_Z24jit_llvm_target_featuresv",
            "_Z19jit_llvm_set_targetPKcS0_j",
            "_Z21jit_llvm_vector_widthv",
        )
    )
    processor.restype = features.restype = ctypes.c_char_p
    set_target(ctypes.c_char_p(processor()), ctypes.c_char_p(features()), ctypes.c_uint(width))
    assert read_width() == width


SMALL_SCENE = """<scene version="3.0.0">
    <default name="albedo" value="0.5"/>
    <integrator type="{integrator}">{integrator_options}</integrator>
    <sensor type="mitsim_lensless">
        <transform name="to_world"><matrix value="{pose}"/></transform>
        <float name="pixel_pitch" value="{pitch}"/>
        <string name="mask" value="{mask}"/>
        <integer name="mask_order" value="{mask_order}"/>
        <float name="mask_feature" value="{mask_feature}"/>
        <float name="mask_distance" value="{mask_distance}"/>
        <float name="scene_distance" value="{scene_distance}"/>
        <float name="fov" value="{fov}"/>
        <film type="hdrfilm">
            <integer name="width" value="{pixels}"/> <integer name="height" value="{pixels}"/>
            <rfilter type="box"/>
            <string name="pixel_format" value="luminance"/> <string name="component_format" value="float32"/>
        </film>
        <sampler type="independent"/>
    </sensor>
    <emitter type="projector">
        <transform name="to_world">
            {projector_turn} <translate x="60"/> <matrix value="{pose}"/>
        </transform>
        <string name="fov_axis" value="x"/> <float name="fov" value="33.398488"/>
        <float name="scale" value="111000"/>
        <texture name="irradiance" type="bitmap">
            <string name="filename" value="{name}_projector.png"/> <boolean name="raw" value="true"/>
            <string name="filter_type" value="nearest"/> <string name="wrap_mode" value="clamp"/>
        </texture>
    </emitter>
    <shape type="rectangle">
        <transform name="to_world">
            <rotate z="1" angle="180"/> <scale x="64" y="64"/> <translate z="{sheet_z}"/> <matrix value="{pose}"/>
        </transform>
        <boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse">{reflectance}</bsdf>
    </shape>
    {extra}
</scene>
"""
PRINT = """<texture name="reflectance" type="bitmap">
    <string name="filename" value="{name}_reflectance.png"/> <boolean name="raw" value="true"/>
    <string name="filter_type" value="nearest"/> <string name="wrap_mode" value="clamp"/></texture>"""
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
NUMBERS = {
    "pixels": 64,
    "pitch": 0.01172,
    "mask": "separable",
    "mask_order": 9,
    "mask_feature": 0.06,
    "mask_distance": 2,
    "scene_distance": 400,
    "sheet_z": 400,
    "fov": 20,
    "integrator": "path",
    "integrator_options": '<integer name="max_depth" value="2"/>',
    "projector_turn": "",
    "pose": IDENTITY,
    "extra": "",
}


def write_png(path: Path, values: np.ndarray) -> None:
    from skimage.io import imsave

    imsave(path, np.asarray(values, dtype=np.uint8), check_contrast=False)


def write_small_scene(
    folder: Path,
    name: str = "small",
    n: int = 16,
    reflectance: np.ndarray | None = None,
    canvas: np.ndarray | None = None,
    **numbers: object,
) -> Path:
    """A photograph-like scene with an n x n projector (60 mm to the side, lens-shifted) and a 64 x 64 sensor.

    ``reflectance``: 8-bit print on the 128 mm sheet, row 0 on top, column 0 left; a grey of ``albedo`` without it.
    ``canvas``: 8-bit texels of the projector, (n, 2 n) with the window in its right half; white window without it.
    """
    folder.mkdir(exist_ok=True)
    if canvas is None:
        canvas = np.zeros((n, 2 * n))
        canvas[:, n:] = 255
    write_png(folder / f"{name}_projector.png", canvas)
    surface = '<spectrum name="reflectance" value="$albedo"/>'
    if reflectance is not None:
        write_png(folder / f"{name}_reflectance.png", reflectance)
        surface = PRINT.format(name=name)
    text = SMALL_SCENE.format(**{**NUMBERS, **numbers}, name=name, reflectance=surface)
    path = folder / f"{name}.xml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def small_scene(tmp_path: Path) -> Callable[..., Path]:
    """Writes a small scene: ``small_scene(n=16, mask="open", ...)`` gives its path."""

    def write(name: str = "small", **numbers: object) -> Path:
        return write_small_scene(tmp_path / "scenes", name, **numbers)

    return write


@pytest.fixture(scope="session")
def shared_scene(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The same, for fixtures that live longer than one test; give each its own name."""
    folder = tmp_path_factory.mktemp("scenes")
    return lambda name, **numbers: write_small_scene(folder, name, **numbers)


@pytest.fixture(scope="session")
def variant() -> str:
    """``llvm_ad_mono`` selected and the plugin registered, for tests that use Mitsuba themselves."""
    from mitsim.core.environment import load_variant
    from mitsim.transport import plugins

    mi = load_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    plugins.register()
    return "llvm_ad_mono"


@pytest.fixture
def set_threads(variant: str) -> Iterator[Callable[[int], None]]:
    """Sets the threads of Dr.Jit's pool; as many as before at the end."""
    import drjit as dr

    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@pytest.fixture(scope="module")
def shipped_bench(variant: str) -> Callable[..., object]:
    """Benches of the shipped scenes, each opened once a module: ``shipped_bench("photograph", mask="flatcam")``.

    No longer: kernels of Dr.Jit hold the surfaces of every scene that is open, so one that stays open makes those of
    all later tests larger, and others than in a process that never had it: they would be compiled anew.
    """
    from mitsim.api.bench import open_bench

    @cache
    def load(name: str, **defines: str) -> object:
        return open_bench(shipped_path("scenes", name, "scene.xml"), variant, **defines)

    return load


@pytest.fixture(scope="module")
def kept_plans(variant: str) -> Iterator[None]:
    """For modules of which no test is about planning: see :mod:`tests.kept_plans`."""
    with plans_kept():
        yield


@pytest.fixture(scope="module")
def trees() -> Iterator[None]:
    """Keep the syntax trees of sources for one module, and collect no garbage meanwhile.

    They take hundreds of megabytes and have no cycles. The collector takes longer to go over them than the parser does
    to make them.
    """
    from tests.test_architecture import parsed

    gc.disable()
    yield
    parsed.cache_clear()
    gc.enable()


@pytest.fixture
def soon_dark(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pilot calls a scene dark after a million rays in place of 67, for tests of what it then says.

    That it sends as many where few meet a small target is held by ``physics/test_small_targets.py``."""
    monkeypatch.setattr("mitsim.planner.pilot._MOST_RAYS", 2**20)


@pytest.fixture
def other_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock says another number of compiled kernels each time, as where Dr.Jit's cache is empty at first.

    For tests that compare what is said of the same work done twice: of a full cache it is the same by chance."""
    from mitsim.core.job import Clock

    numbers = itertools.count(1)
    monkeypatch.setattr(Clock, "kernels", lambda _: {"number": next(numbers), "seconds": 0.5})


@pytest.fixture(scope="module")
def draft_figures() -> Iterator[None]:
    """Figures are written small and without making room for their labels, which takes most of the time of a page."""
    from matplotlib.figure import Figure

    write = Figure.savefig

    def drafted(figure: Figure, file: object, **options: object) -> None:
        figure.set_layout_engine("none")
        write(figure, file, **{**options, "dpi": 20})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", drafted)
        yield
