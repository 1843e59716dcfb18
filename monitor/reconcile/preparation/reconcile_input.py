"""Input of ``reconcile``: a recording with usable axes and a smoothed temperature."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.errors import NotReady
from monitor.noise.model import NoiseModel

MIN_SAMPLES: Final = 4096
"""Smallest number of valid samples of an axis."""
MIN_VALID_FRACTION: Final = 0.5
MIN_TEMPERATURE_VALUES: Final = 20
"""Smallest number of different temperatures for a comparison of temperature coefficients.

With fewer values, the rounding of the temperature makes the fitted coefficients too small.
"""
TEMPERATURE_SMOOTHING_FRACTION: Final = 0.001
"""Length of the moving average of the noisy temperature, as a fraction of the recording.
"""


@dataclass(frozen=True, slots=True)
class RecordedAxes:
    """Recorded samples of several axes, with the sample rate and the temperature."""

    values: Mapping[str, Floats]  # axis -> [n] SI; NaN = missing
    rate_hz: float
    temperature_c: Floats | None = None  # [n] °C; NaN = missing
    is_temperature_coarse: bool = False  # True if the sizes of temperature effects cannot be compared with a model

    @property
    def sample_count(self) -> int:
        """Number of samples of each axis."""
        return next(iter(self.values.values())).size


def select_axes_and_smooth_temperature(
    recording: RecordedAxes, model: NoiseModel | None
) -> tuple[RecordedAxes, tuple[str, ...]]:
    """Select the axes that can be compared with a noise model, and smooth the temperature.

    Parameters
    ----------
    recording : RecordedAxes
        Recording with all axes.
    model : NoiseModel or None
        Noise model that must contain the axis. If None, no axis is excluded because of the model.

    Returns
    -------
    recording : RecordedAxes
        Recording with the selected axes and the smoothed temperature.
    notes : tuple of str
        Reason for each excluded axis.

    Raises
    ------
    NotReady
        If the recording has too few samples or no usable axis.
    """
    if recording.sample_count < MIN_SAMPLES:
        raise NotReady(
            f"the recording has {recording.sample_count} samples; at least {MIN_SAMPLES} are needed "
            f"({MIN_SAMPLES / recording.rate_hz:.0f} s at {recording.rate_hz:g} Hz)"
        )
    notes, kept = [], {}
    for name, y in recording.values.items():
        valid = y[np.isfinite(y)]
        if valid.size < MIN_SAMPLES or valid.size < MIN_VALID_FRACTION * y.size:
            notes.append(f"{name}: only {valid.size} of {y.size} samples are valid; left out")
        elif np.ptp(valid) == 0.0:
            notes.append(f"{name}: all samples have the same value; left out")
        elif model is not None and not model.effects.get(name):
            notes.append(f"{name}: the model does not contain this axis; left out")
        else:
            kept[name] = y
    if not kept:
        raise NotReady("no axis to compare: " + "; ".join(notes))
    temperature_c, is_coarse = recording.temperature_c, False
    if temperature_c is not None and np.isfinite(temperature_c).any():
        is_coarse = np.unique(temperature_c[np.isfinite(temperature_c)]).size < MIN_TEMPERATURE_VALUES
        temperature_c = _smooth_temperature(temperature_c)
    else:
        temperature_c = None
    return RecordedAxes(kept, recording.rate_hz, temperature_c, is_coarse), tuple(notes)


def _smooth_temperature(temperature_c: Floats) -> Floats:
    known = np.flatnonzero(np.isfinite(temperature_c))
    whole = np.interp(np.arange(temperature_c.size), known, temperature_c[known])
    half = int(0.5 * TEMPERATURE_SMOOTHING_FRACTION * whole.size)
    if half < 1:
        return whole
    sums = np.concatenate([[0.0], np.cumsum(np.pad(whole - whole[0], half, mode="edge"))])
    return np.asarray((sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1) + whole[0])
