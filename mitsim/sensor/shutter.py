"""A ripple of the light and a camera's shutter in; the level of the light that each row of a frame sees, out.

Light whose power is 1 + c cos(2 pi f t + phi) has over the exposure of a row, from t_r to t_r + T, the mean

    1 + c sinc(f T) cos(2 pi f (t_r + T/2) + phi),   sinc(x) = sin(pi x) / (pi x),

that is 1 + c Re[A_r exp(i phi)] with ``A_r = sinc(f T) exp(2 pi i f (t_r + T/2))``. Rows of a global shutter all begin
at 0, pixel row r of a rolling one at r times its line time. A row of superpixels has the mean A of the rows that are
summed in it; where charge is summed on chip and read as one line, it begins as one. The variance follows from the
mean, by the law of photons (:mod:`mitsim.sensor.moments`). Over phases phi, all alike, the level has the mean 1, the
variance c^2 |A_r|^2 / 2, and between rows the covariance c^2 Re[A_r A_s*] / 2.
"""

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.rig.sensor import SensorModel


def ripple_response(model: SensorModel, exposure_s: float, hertz: float, rows: int) -> npt.NDArray[np.complex128]:
    """(rows,) A_r: amplitude and phase of a ripple of amplitude 1 in each row of a frame.

    MitsimError for a rolling shutter whose line time is not known.

    Parameters
    ----------
    model
        the sensor.
    exposure_s
        T, for which each row is exposed [s].
    hertz
        f, frequency of the ripple [Hz].
    rows
        of the frame, of superpixels.
    """
    summed = 1 if model.binning_on_chip else model.binning
    begins = model.known_line_time_s() * np.arange(rows * summed)
    lines = np.exp(2j * np.pi * hertz * (begins + exposure_s / 2))
    return np.asarray(np.sinc(hertz * exposure_s) * lines.reshape(rows, summed).mean(axis=1))


def ripple_level(response: npt.NDArray[np.complex128], amplitude: float, phase: float) -> FloatArray:
    """(rows, 1) level of the light in each row of one frame, 1 on average over all phases.

    Parameters
    ----------
    response
        (rows,) of the shutter to the ripple.
    amplitude, phase
        c and phi [radians]; an amplitude of at most 1, so that no level is below 0.
    """
    return np.asarray(1 + amplitude * (response * np.exp(1j * phase)).real[:, None])
