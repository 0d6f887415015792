"""A simulated session's frames in; a folder of them, as `mitsim calibrate --frames` reads it, out.

Only what a camera's user has: digital numbers, what each file shows, and how the camera is read. Expected light, exact
factors, parallax, seeds and plan are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from mitsim.core.jsonfile import write_json
from mitsim.core.manifests import Digital
from mitsim.core.output import whole_file
from mitsim.rig.framelist import LISTS, DarkFile, FrameList, StripeFile
from mitsim.rig.order import SIDES, UNIFORM, Half
from mitsim.sensor.chain import Digital as Numbers

if TYPE_CHECKING:
    from mitsim.capture.session import Session

MOST_TIFF = 2**16 - 1
"""Largest digital number of a 16-bit TIFF; frames of larger or real numbers become NPY."""


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """Frames of a ``session`` in a ``folder`` that is held, called by the number at which they are taken."""

    session: Session
    folder: Path

    def write(self, names: tuple[str | int, ...], numbers: Numbers) -> None:
        """Write one frame.

        Parameters
        ----------
        names
            of its noise: side and number of the shot, or ``dark`` and numbers of exposure and frame; then ``exposure``
            and ``repeat``, each with its number where that is not 0.
        numbers
            (rows, columns) as read.
        """
        if names[0] == "dark":
            place = self._dark(int(names[1]), int(names[2]))
        else:
            options = dict(zip(names[2::2], names[3::2], strict=True))
            half = self._half(str(names[0]), int(names[1]))
            place = self._lit(half, int(options.get("exposure", 0)), int(options.get("repeat", 0)))
        with whole_file(self.folder / place) as part, part.open("wb") as file:
            if self._tiff:
                Image.fromarray(numbers.astype(np.uint16)).save(file, "TIFF")
            else:
                np.save(file, numbers)

    def finish(self, digital: Digital) -> None:
        """Write the list, when all frames are there; ``digital`` is of the shortest exposure."""
        recipe, exposures = self.session.recipe, range(len(self.session.recipe.exposure_ladder))
        listed = FrameList(
            camera=self.session.bench.identity(),
            n=self.session.bench.n,
            signed_capture=recipe.signed_capture,
            repeats=recipe.repeats,
            exposure_ladder=recipe.exposure_ladder,
            ladder_merge=recipe.ladder_merge,
            digital=digital,
            centre=self.session.centre,
            board_reflectance=recipe.board_reflectance,
            frames=tuple(
                StripeFile(
                    file=self._lit(half, exposure, repeat),
                    side=half[0],
                    index=half[1],
                    sign=half[2],
                    exposure=exposure,
                    repeat=repeat,
                )
                for half in self.session.order
                for exposure in exposures
                for repeat in range(recipe.repeats)
            ),
            dark=tuple(
                DarkFile(file=self._dark(exposure, number), exposure=exposure)
                for exposure in exposures
                for number in range(recipe.dark_frames)
            ),
        )
        write_json(self.folder / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))

    @cached_property
    def _tiff(self) -> bool:
        largest = self.session.bench.sensor.largest_dn
        return largest is not None and largest <= MOST_TIFF

    @cached_property
    def _numbers(self) -> dict[Half, int]:
        """At which number each is taken, of those with one exposure and no repeats."""
        return {half: number for number, half in enumerate(self.session.order)}

    def _half(self, side: str, index: int) -> Half:
        """What shot number ``index`` of a ``side`` shows."""
        (own,) = (known for known in SIDES if known == side)
        if self.session.pairs:
            return own, index // 2, -1 if index % 2 else 1
        return (own, index - 1, 1) if index else (own, 0, UNIFORM)

    def _lit(self, half: Half, exposure: int, repeat: int) -> str:
        recipe = self.session.recipe
        number = (self._numbers[half] * len(recipe.exposure_ladder) + exposure) * recipe.repeats + repeat
        return f"frame_{number:05d}{self._ending}"

    def _dark(self, exposure: int, number: int) -> str:
        return f"dark_{exposure * self.session.recipe.dark_frames + number:05d}{self._ending}"

    @property
    def _ending(self) -> str:
        return ".tif" if self._tiff else ".npy"
