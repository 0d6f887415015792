"""An image and how far to trust it, as figures, sentences and pictures, and as a folder of files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError, checked
from mitsim.core.exr import write_frame
from mitsim.core.files import output_folder, plain, read_json, whole_file, write_json
from mitsim.core.images import card, png, scaled, span
from mitsim.reconstruct.cost import ImageCost
from mitsim.reconstruct.depth import Depth
from mitsim.reconstruct.depth_map import DepthMap
from mitsim.reconstruct.misfit import Misfit
from mitsim.reconstruct.request import IMAGE_FILE
from mitsim.reconstruct.solution import Status
from mitsim.reconstruct.uncertainty import NO_UNCERTAINTY, Uncertainty

UNCERTAINTY_FILE, DEPTH_FILE = "uncertainty.exr", "depth.exr"
RESULT_FILE = "result.json"


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image and how far to trust it.

    Attributes
    ----------
    image
        (n, n') reflectance, 1 = the calibration's board, neither clipped nor normalised.
    lam
        lambda that was used, in the unit of (Phi_L Phi_R)^2; for ``tv`` the weight of the total variation.
    rank
        of the whole model, the product of ``rank_sides``.
    condition
        the larger of ``condition_sides``; that of the whole model is their product, ``condition_whole``.
    rank_sides, condition_sides
        of scene rows and of scene columns.
    residual
        ||Y - model|| / ||Y|| over all frames.
    rounding
        what rounding may have changed, ||error|| / ||image||; None for ``tv`` and with a depth for each pixel.
    misfit
        what of the measurements fits no image; None where there are no more data than unknowns.
    uncertainties
        standard uncertainty of the image by source; None for ``tv`` and with a depth for each pixel, which are not
        linear in the frames.
    status
        whether it can be trusted, what is wrong and what to do; misfit and flags of the capture and of the calibration
        count.
    seconds
        by stage.
    inputs
        fingerprints of shots and factors, ``lam`` as it was asked for, and the method; the focus, where one was.
    focus
        the depth whose factors were used, or a depth for each pixel; None: the calibrated one.
    predicted
        seconds by stage and memory, before it was begun; None where nobody could tell.
    objective, relative_gap
        of ``tv``: what was minimised, and how far above its minimum it may be at most, relative
        (:class:`mitsim.reconstruct.solution.Solution`); None for other methods.
    """

    image: FloatArray
    lam: float
    rank: int
    condition: float
    rank_sides: tuple[int, int]
    condition_sides: tuple[float, float]
    residual: float
    rounding: float | None
    misfit: Misfit | None
    uncertainties: Uncertainty | None
    status: Status
    seconds: dict[str, float]
    inputs: dict[str, Any]
    focus: Depth | DepthMap | None = None
    predicted: ImageCost | None = None
    objective: float | None = None
    relative_gap: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the image can be used as it is."""
        return self.status.ok

    @property
    def depths(self) -> DepthMap | None:
        """A depth for each pixel, where these were looked for and are told."""
        return self.focus if isinstance(self.focus, DepthMap) and not self.focus.doubt else None

    @property
    def condition_whole(self) -> float:
        """Condition of the whole model; inf when rank deficient."""
        return self.condition_sides[0] * self.condition_sides[1]

    @property
    def uncertainty(self) -> FloatArray | None:
        """(n, n') standard uncertainty of the image, random and systematic parts together."""
        return self.uncertainties.total if self.uncertainties else None

    @property
    def trust(self) -> tuple[str, ...]:
        """A line on the misfit, and one on the uncertainty by source, where these are known."""
        return tuple(str(known) for known in (self.misfit, self.uncertainties) if known)

    def summary(self) -> dict[str, Any]:
        """What result.json and the command line's JSON say of it."""
        return {
            "lambda": self.lam,
            "rank": self.rank,
            "rank_sides": self.rank_sides,
            "condition": self.condition,
            "condition_whole": self.condition_whole,
            "condition_sides": self.condition_sides,
            "residual": self.residual,
            "objective": self.objective,
            "relative_gap": self.relative_gap,
            "focus_mm": self.focus.mm if isinstance(self.focus, Depth) else None,
            "focus_error_mm": self.focus.error_mm if isinstance(self.focus, Depth) else None,
            "focus_range_mm": self.focus.range_mm if self.focus else None,
            "focus_alternatives": [asdict(other) for other in self.focus.alternatives] if self.focus else None,
            "depths": self.depths.summary() if self.depths else None,
            "misfit": self.misfit and self.misfit.summary(),
            **(self.uncertainties.summary() if self.uncertainties else NO_UNCERTAINTY),
            "status": str(self.status),
            "seconds": {**self.seconds, "total": sum(self.seconds.values())},
            "predicted": self.predicted and self.predicted.seconds,
            "predicted_seconds": self.predicted and sum(self.predicted.seconds.values()),
            "predicted_memory_bytes": self.predicted and self.predicted.memory_bytes,
        }

    @checked
    def save(self, folder: Path | str, overwrite: bool = False, more: Mapping[str, Any] | None = None) -> Path:
        """Write image.exr, image.png (for display), result.json, and where known uncertainty.exr and depth.exr.

        Parameters
        ----------
        folder
            new or empty, or with an earlier image of the same inputs, which is replaced.
        overwrite
            whether an earlier image of other inputs may be replaced, too.
        more
            entries of result.json beside :meth:`summary`.

        Raises
        ------
        MitsimError
            when the folder holds another image or something else, or cannot be written.
        """
        try:
            plain(more)
        except TypeError as error:
            raise ArgumentError("more", f"cannot be stored ({error})") from None
        with output_folder(folder, overwrite=may_replace(Path(folder), self.inputs, overwrite)) as place:
            return self.write(place, more)

    @checked
    def write(self, folder: Path, more: Mapping[str, Any] | None = None) -> Path:
        """The same in a ``folder`` that this process holds already (:func:`mitsim.core.files.output_folder`); ``more``
        are further entries of result.json."""
        write_frame(
            folder / IMAGE_FILE, {"reflectance": self.image.astype(np.float32)}, {"method": self.inputs["method"]}
        )
        (folder / UNCERTAINTY_FILE).unlink(missing_ok=True)
        if self.uncertainties:
            write_frame(folder / UNCERTAINTY_FILE, self.uncertainties.channels(), {"method": self.inputs["method"]})
        (folder / DEPTH_FILE).unlink(missing_ok=True)
        if self.depths:
            write_frame(folder / DEPTH_FILE, self.depths.channels(), {"method": self.inputs["method"]})
        with whole_file(folder / "image.png") as part:
            part.write_bytes(png(self.image))
        write_json(folder / RESULT_FILE, {**(more or {}), **self.summary(), "inputs": self.inputs})
        return folder

    def __repr__(self) -> str:
        rows, columns = self.image.shape
        return f"Reconstruction({rows} x {columns}: {self.status.verdict.value}, residual {self.residual:.1e})"

    def _repr_html_(self) -> str:
        facts = f"lambda {self.lam:.3g}, residual {self.residual:.1e} of the frames"
        pictures = {"reflectance 0 to 1": self.image}
        if self.uncertainty is not None:
            caption = f"standard uncertainty of each pixel\n{span(self.uncertainty, 'of reflectance')}"
            pictures[caption] = scaled(self.uncertainty)
        if self.depths:
            pictures[f"depth of each pixel\n{span(self.depths.mm, 'mm')}"] = scaled(self.depths.mm)
        return card(f"Reconstruction: {self.status.verdict.value}", pictures, (str(self.status), *self.trust, facts))


def may_replace(folder: Path, asked: Mapping[str, str | float], overwrite: bool) -> bool:
    """Whether a folder holds an image that may be replaced; False when it holds none.

    Parameters
    ----------
    folder
        that is to be written to.
    asked
        the :func:`inputs` of the new image.
    overwrite
        whether an image of other inputs may be replaced.

    Raises
    ------
    MitsimError
        when there is an image of other inputs, and ``overwrite`` is off.
    """
    if not (folder / IMAGE_FILE).is_file():
        return False
    if overwrite:
        return True
    check_same_inputs(folder, read_json(folder / RESULT_FILE) if (folder / RESULT_FILE).is_file() else {}, asked)
    return True


def check_same_inputs(folder: Path, head: object, asked: Mapping[str, str | float]) -> None:
    """MitsimError where the image in a folder is of other inputs.

    Parameters
    ----------
    folder
        that holds it.
    head
        JSON beside it, whose ``inputs`` are its own.
    asked
        inputs of the new image.
    """
    earlier = head.get("inputs") if isinstance(head, dict) else None
    earlier = earlier if isinstance(earlier, dict) else {}
    changed = [name for name in {**asked, **earlier} if earlier.get(name) != asked.get(name)]
    if changed:
        raise MitsimError(
            f"output {folder}: holds an image of other inputs ({', '.join(changed)} differ); choose another folder, or "
            "replace it with overwrite=True"
        )
