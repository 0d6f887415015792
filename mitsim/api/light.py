"""What one does with sampled light: a light in; captures of any family, and a file of it, out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.arguments import checked
from mitsim.light.light import SampledLight

if TYPE_CHECKING:
    from mitsim.core.job import Job
    from mitsim.core.runs import Capture


class Light(SampledLight):
    """Sampled light of one scene, ready to be exposed; its attributes are those of
    :class:`mitsim.light.light.SampledLight`."""

    @checked
    def expose(
        self, patterns: str = "dots:7", output: Path | str | None = None, job: Job | None = None, **request: Any
    ) -> Capture:
        """One noisy frame for each shot of a family in this light.

        Parameters
        ----------
        patterns
            the family.
        output
            folder that the frames are written to; None keeps them in memory.
        job
            clock, progress and limits.
        **request
            ``seed``, ``exposure`` or ``exposure_fraction`` other than those that the light was traced with.

        Raises
        ------
        MitsimError
            for patterns that do not fit, an output that cannot be written, or a field that would need other light.
        """
        from mitsim.acquire.capture import expose

        return expose(self, patterns, output, job, **request)

    @checked
    def save(self, path: Path | str) -> Path:
        """Write the light to the HDF5 file ``path``, which is replaced; returns it. Frames are formed of it without
        mitsim, as docs/exchange.md shows.

        MitsimError for light that was traced by class, or where the file cannot be written.
        """
        from mitsim.light.light_file import write_light

        write_light(Path(path), self)
        return Path(path)
