"""Verbs of a bench of scene, camera and projector: plan, light, capture, calibrate and render.

The objects below this floor are data; here they have their verbs, each of which calls the room that does the work.
"""

from __future__ import annotations

import hashlib
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.bench.apparatus import Apparatus, open_apparatus, reopen
from mitsim.bench.request import Planned, PredictRequest, Request, SessionRequest, Task, Working
from mitsim.core.configuration import takes
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import ArgumentError, check_arguments, is_masked

# What needs numpy, or the renderer, is imported where it is used: what opens a bench refuses a misspelt name first.
if TYPE_CHECKING:
    from typing_extensions import Self

    from mitsim.acquire.capture import Light, Rendered
    from mitsim.acquire.spectral import Coloured
    from mitsim.core.runs import Capture, MosaicCapture
    from mitsim.design.predict import Prediction
    from mitsim.devices.session import BoardShape
    from mitsim.light.plan import Plan
    from mitsim.reconstruct.factors import Factors
    from mitsim.report.lit_scene import BenchView


# ---- Opening a bench ----


@check_arguments
def open_bench(
    scene: Path | str,
    variant: str = DEFAULT_VARIANT,
    camera: Path | str | None = None,
    projector: Path | str | None = None,
    allow_outside_files: bool = False,
    for_render: bool = False,
    **parameters: object,
) -> Bench:
    """Load a scene with its camera and projector, and select the Mitsuba variant of the process.

    Parameters
    ----------
    scene
        Name of a shipped scene, or path of a scene XML or of its folder (``./name`` for a folder that has the name of a
        shipped scene).
    variant
        Variant of Mitsuba.
    camera, projector
        Name of a shipped device, or path of its TOML file; None: IMX249 and MP-CL1. The pitch of a camera that is
        named, and its rows and columns where its file states them, count in place of the scene's, which a warning says.
    allow_outside_files
        True to let the scene read files outside its folder.
    for_render
        True if only light matters: the camera's electronics need not fit, and the scene needs no projector.
    **parameters
        Values of the scene's ``<default>`` parameters, text or numbers.

    Raises
    ------
    MitsimError
        for anything wrong with the files, a scene whose pixels are not the IMX249's where no camera is named, or a
        mask of the scene's where the camera file has one.
    """
    opened = open_apparatus(scene, variant, camera, projector, allow_outside_files, for_render, **parameters)
    if opened.loaded.sensor_note:
        warnings.warn(opened.loaded.sensor_note, stacklevel=3)  # of who called: check_arguments stands between
    return Bench(**vars(opened))


# ---- The bench and its verbs ----

_LISTED = """view plan predict light transport capture capture_lines capture_mosaic choose_colour calibrate
calibrate_lines calibrate_mosaic calibrate_depths write_session render with_board in_variant in_bands family
geometry sensor projector n variant"""
"""Names that ``dir(bench)`` lists."""


class Bench(Apparatus):
    """Apparatus that is ready to plan, capture and calibrate.

    Its attributes are those of :class:`mitsim.bench.apparatus.Apparatus`.
    """

    def __repr__(self) -> str:
        path, (rows, columns) = self.loaded.path, self.geometry.frame_shape
        devices = f"{self.sensor.name} with {rows} x {columns} pixels, {self.projector.name}"
        return f"Bench({path.parent.name}/{path.name}: {devices})"

    def __dir__(self) -> list[str]:
        """Return the names that a user needs; the other attributes serve the package."""
        return sorted(_LISTED.split())

    def _repr_html_(self) -> str:
        import numpy as np

        from mitsim.core.images import card, normalise

        geometry, mask = self.geometry, self.geometry.build_mask()
        (rows, columns), pitch = geometry.frame_shape, geometry.pixel_pitch * 1e3
        facts = {
            "scene": f"{self.loaded.path}, in {self.variant}",
            "camera": f"{self.sensor.name}, {rows} x {columns} pixels of {pitch:.4g} um",
            "mask": f"{geometry.mask_words}, {geometry.mask_distance:g} mm before the sensor",
            "projector": f"{self.projector.name}, {self.n} x {self.n} pixels, set to {geometry.scene_distance:g} mm",
        }
        places = (np.arange(128) - 63.5) / 128 * min(mask.extent_mm, 64 * mask.feature_mm)
        picture = {
            "the 64 x 64 features in the middle of the mask": normalise(mask.transmission(places[:, None], places))
        }
        return card(str(self), picture, ("Drawing to scale: bench.view()",), facts)

    # ---- The plan, and light of the scene ----

    @takes(Request, without="patterns")
    def plan(self, patterns: str = "dots:7", **request: Any) -> Plan:
        """Plan a simulation by a short look at the scene, with reasons and cost.

        Parameters
        ----------
        patterns
            Name of a family, or own patterns (:func:`mitsim.devices.patterns.parse_patterns`).

        Raises
        ------
        MitsimError
            for a request that cannot be served, or when no light of the projector reaches the camera.
        """
        from mitsim.acquire.spectral import plan_request

        return plan_request(self, Request(patterns=patterns, **request))

    @takes(Working, Request, without="patterns resume")
    def light(self, patterns: Plan | str = "dots:7", **request: Any) -> Light:
        """Trace the light of the scene by projector pixel, once, so that any family can be exposed in it.

        Parameters
        ----------
        patterns
            Family whose frames are to have the accuracy, or a plan of this bench.
        """
        from mitsim.acquire.capture import check_plan, request_of, trace_request
        from mitsim.acquire.spectral import SpectralBench, plan_request
        from mitsim.light.cost_model import first_shadow

        job, asked = Task.taken(None, request).job, request_of(patterns, request)
        if isinstance(patterns, str):
            with job.planning(patterns, first_shadow(self, asked.effects)):
                patterns = plan_request(self, asked)
        else:
            check_plan(patterns, SpectralBench(self), asked)
        return trace_request(self, patterns, job, asked.seed)

    transport = light

    @takes(Working, PredictRequest, without="patterns resume")
    def predict(self, patterns: str = "dots:7", **request: Any) -> Prediction:
        """Predict the PSNR of an image, and its errors by cause, without forming frames or solving them.

        Parameters
        ----------
        patterns
            Name of a family.

        Raises
        ------
        MitsimError
            for a request that cannot be served, and a mask without factors.
        """
        from mitsim.design.predict import predict

        job = Task.taken(None, request).job
        return predict(self, PredictRequest(patterns=patterns, **request), job)

    # ---- Captures ----

    @takes(Working, Request)
    def capture(self, plan: Plan | str = "dots:7", output: Path | str | None = None, **request: Any) -> Capture:
        """Take one noisy frame for each shot of a pattern family.

        Parameters
        ----------
        plan
            Plan of this bench, or name of a family.
        output
            Folder that the frames are written to as they are made; None keeps them in memory.

        Raises
        ------
        MitsimError
            for a request that cannot be served, an output that cannot be written or holds something else, or more
            memory, disk or time than the job's limits allow.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.acquire.capture import capture, request_of
            from mitsim.acquire.spectral import SpectralBench
        return capture(SpectralBench(self), request_of(plan, request), task, plan).runs[0]

    # ---- Spectral lines and colour filters ----

    @takes(Working, Request, without="patterns")
    def capture_lines(
        self, patterns: Plan | str = "dots:7", output: Path | str | None = None, **request: Any
    ) -> dict[str, Capture]:
        """Take a capture for each spectral line of the projector, by the line's name, as ``638nm``.

        All lines are traced on the same paths. Each capture has the accuracy that is asked for. Needs a spectral
        variant.

        Parameters
        ----------
        patterns
            Name of the family, or a plan of all lines.
        output
            Folder of a run's folder for each line, and colour.json; None keeps the runs in memory.

        Raises
        ------
        MitsimError
            as :meth:`capture`; for another variant, a projector of more than four lines, and lamps where the camera's
            efficiency is not known.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.acquire.capture import capture_lines, request_of
        return capture_lines(self, request_of(patterns, request), task, patterns)

    @takes(Request, without="patterns")
    def choose_colour(self, patterns: str = "dots:7", **request: Any) -> Coloured:
        """Choose mono light if it leaves at most half of the accuracy as error of colours, else all lines.

        The result has the ``plan``, the ``bench`` in the variant that it needs, which is set, and True for ``mono``.

        Parameters
        ----------
        patterns
            Name of the family.

        Raises
        ------
        MitsimError
            as :meth:`capture_lines`, and for a bench in a spectral variant.
        """
        from mitsim.acquire.spectral import choose_colour

        return choose_colour(self, Request(patterns=patterns, **request))

    @check_arguments
    def in_variant(self, variant: str) -> Bench:
        """Load the bench into a ``variant``, which is then the current one.

        Objects of the earlier variant must not be used with it.
        """
        return reopen(self, variant)

    @takes(Working, SessionRequest)
    def calibrate_lines(self, output: Path | str | None = None, **request: Any) -> dict[str, Factors]:
        """Estimate the camera's factors at each spectral line of the projector, by the line's name.

        Parameters
        ----------
        output
            Folder of a calibration's folder for each line, and colour.json; None keeps the factors in memory.

        Raises
        ------
        MitsimError
            as :meth:`calibrate`, for a variant that is not spectral, and a projector of more than four lines.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.calibrate.calibrate import calibrate_lines
        return calibrate_lines(self, SessionRequest(**request), task)

    @takes(Working, Request, without="patterns")
    def capture_mosaic(
        self, patterns: Plan | str = "dots:7", output: Path | str | None = None, **request: Any
    ) -> MosaicCapture:
        """Take frames of all lines at once by a camera under a mosaic of colour filters: one frame for each shot.

        Needs a spectral variant, and a camera whose file has a ``mosaic``.

        Parameters
        ----------
        patterns
            Name of the family, or a plan of this bench.
        output
            RUN folder, which also holds the lines' truths and colour.json; None keeps all in memory.

        Raises
        ------
        MitsimError
            as :meth:`capture_lines`, for a camera without a mosaic, lines that its curves do not hold, a sensor of an
            odd number of pixels, and a projector with speckle, which is not simulated behind filters.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.acquire.capture import capture_mosaic, request_of
        return capture_mosaic(self, request_of(patterns, request), task, patterns)

    @takes(Working, SessionRequest)
    def calibrate_mosaic(self, output: Path | str | None = None, **request: Any) -> dict[str, Factors]:
        """Estimate the factors of a camera under colour filters by spectral line of the projector.

        Each line has a session of its own, by the shipped recipe with four shots of each pattern if none is given. Each
        pixel's number is divided by the stated transmission of its filter, so that the factors are those of pixels
        without filters, one electron a photon.

        Parameters
        ----------
        output
            As for :meth:`calibrate_lines`.

        Raises
        ------
        MitsimError
            as :meth:`calibrate_lines` and :meth:`capture_mosaic`, and for a filter that passes nothing of a line.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.calibrate.calibrate import calibrate_lines
        return calibrate_lines(self, SessionRequest(**request), task, mosaic=True)

    # ---- Calibration sessions ----

    @takes(Working, SessionRequest)
    def calibrate(self, output: Path | str | None = None, **request: Any) -> Factors:
        """Estimate the camera's two factors from a rendered Hadamard session on a white board.

        Parameters
        ----------
        output
            CAL folder to write, with its unfinished parts meanwhile; None keeps the factors in memory.

        Raises
        ------
        MitsimError
            as :meth:`capture`.
        """
        with Task.taken(output, request).importing() as task:
            from mitsim.calibrate.calibrate import calibrate
        return calibrate(self, SessionRequest(**request), task)

    @takes(Working, SessionRequest)
    def calibrate_depths(self, output: Path | str | None = None, **request: Any) -> dict[float, Factors]:
        """Estimate the camera's two factors at each of a recipe's depths, by depth [mm].

        Parameters
        ----------
        output
            Folder of a CAL folder for each depth, named by its millimetres; None keeps the factors in memory.
        """
        from mitsim.calibrate.calibrate import calibrate_depths

        task = Task.taken(output, request)
        return calibrate_depths(self, SessionRequest(**request), task)

    @takes(Working, SessionRequest, without="resume")
    def write_session(self, frames: Path | str, output: Path | str | None = None, **request: Any) -> Factors:
        """Calibrate as :meth:`calibrate` does, and write the session's frames.

        The frames are written as a user of a real camera has them, so that :func:`mitsim.calibrate_frames` makes the
        same factors of them.

        Parameters
        ----------
        frames
            New or empty folder for the frames.
        output
            As for :meth:`calibrate`.
        """
        from mitsim.calibrate.calibrate import calibrate

        task = Task.taken(output, request)
        return calibrate(self, SessionRequest(**request), task, frames)

    # ---- The bench to look at, renderings, and the same devices before a board ----

    def view(self) -> BenchView:
        """Draw the bench to scale, with its distances and the camera's view, before any light is simulated.

        The drawing shows itself in a notebook, and is saved as a picture or as a page on which it can be turned.
        """
        from mitsim.report.lit_scene import view

        return view(self)

    @takes(Working, Planned, without="resume patterns seconds")
    def render(
        self, estimator: Literal["reference", "factored"] = "reference", spp: int | None = None, **request: Any
    ) -> Rendered:
        """Estimate the expected irradiance under the scene's own light.

        Parameters
        ----------
        estimator
            ``reference``: the scene's own integrator, path by path; ``factored``: the estimator of captures.
        spp
            Samples a pixel of the reference; None: the ``sample_count`` of the scene's sampler, or 64 without.

        Raises
        ------
        MitsimError
            for another estimator, an integrator that cannot render this sensor, or work beyond the job's limits.
        """
        from mitsim.acquire.capture import render

        job = Task.taken(None, request).job
        return render(self, estimator, spp, Request(**request), job)

    @check_arguments
    def with_board(self, reflectance: float, shape: BoardShape | None = None, depth: float | None = None) -> Self:
        """Place the devices before a diffuse board.

        Parameters
        ----------
        reflectance
            Reflectance of the board.
        shape
            Size, bow and tilt of the board; None: flat, and larger than the view.
        depth
            Distance of the board's middle [mm]; None: on the aligned plane.
        """
        from mitsim.bench.layout import before_board

        return before_board(self, reflectance, shape, depth)


# ---- A picture or a mesh of the user's -------------------------------------------------------------------------------

_LIT_MM = 120.0
"""Side of what the projector lights of a sheet 400 mm away, as all flat scenes have it: 128 pixels of 0.9375 mm."""


@check_arguments
def flat_scene(picture: Any, size_mm: float = _LIT_MM, distance_mm: float = 400.0, **parameters: Any) -> Bench:
    """Open the scene ``photograph`` with your own picture on its sheet.

    Parameters
    ----------
    picture
        PNG, TIFF, NPY, OpenEXR or JPEG file, or an array (rows, columns) or (rows, columns, 3). Its numbers are
        reflectances, 0 to 1, of whole numbers the part of their type's largest; of colours the mean is taken. It is as
        high to wide as its pixels are; what is left of the sheet is black.
    size_mm
        Side of the sheet, and longer side of the picture [mm]. At 400 mm the projector lights 120 mm: there an array
        of 128 x 128 numbers has one for each of its pixels.
    distance_mm
        Distance from the camera to the sheet [mm]. The bench stays aligned to 400 mm, and so does its calibration.
    **parameters
        ``camera``, ``projector``, ``variant`` and parameters of the scene, as for :func:`mitsim.open_bench`.

    Returns
    -------
    Bench
        Its truth is the picture where the projector lights it.

    Raises
    ------
    MitsimError
        for a picture that cannot be read or whose numbers are no reflectances, and as :func:`mitsim.open_bench`.
    """
    path = picture if isinstance(picture, str | Path) else _write_array(picture)
    return open_bench("photograph", picture=path, sheet_mm=size_mm, sheet_z=distance_mm, **parameters)


@check_arguments
def shelf_scene(
    mesh: Path | str, size_mm: float = 60.0, reflectance: float = 0.7, turn_deg: float = 0.0, **parameters: Any
) -> Bench:
    """Open the scene ``shelf`` with your own object.

    Parameters
    ----------
    mesh
        PLY file of triangles, or OBJ file, with the y axis up. The object is centred on the shelf.
    size_mm
        Longest side of the object [mm].
    reflectance
        Reflectance of the object's matt surface, on either side, 0 to 1.
    turn_deg
        Rotation about the upright axis [degrees].
    **parameters
        ``camera``, ``projector``, ``variant`` and parameters of the scene, as for :func:`mitsim.open_bench`.

    Raises
    ------
    MitsimError
        for a mesh that cannot be read, has no faces, or normals that face into it, and as :func:`mitsim.open_bench`.
    """
    stated: dict[str, Any] = {"object_mm": size_mm, "object_albedo": reflectance, "object_turn": turn_deg}
    return open_bench("shelf", object=mesh, **stated, **parameters)


_ALLOWED = "give a file, or an array of real numbers 0 to 1 or of unsigned ones, (rows, columns) or (rows, columns, 3)"


def _write_array(picture: object) -> Path:
    """Write an array to a file that is named by its content, so that another process finds it."""
    import numpy as np

    from mitsim.core.images import write_numbers

    try:
        values = np.asarray(picture)
    except ValueError as error:
        raise ArgumentError("picture", f"{error}; {_ALLOWED}") from None
    if (
        is_masked(picture)
        or values.dtype.kind not in "buf"
        or values.ndim not in (2, 3)
        or values.shape[2:] not in ((), (1,), (3,))
    ):
        raise ArgumentError(
            "picture",
            f"got {'masked ' * is_masked(picture)}numbers of type {values.dtype} and shape {values.shape}; {_ALLOWED}",
        )
    most = float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0
    values = values.astype(np.float64) / most
    values = values.mean(axis=2) if values.ndim == 3 else values
    digest = hashlib.sha256(f"{values.shape}".encode() + values.tobytes()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / "mitsim-pictures"
    folder.mkdir(exist_ok=True)
    path = folder / f"{digest}.npy"
    if not path.is_file():
        write_numbers(path, values)
    return path
