"""Digital Butterworth low-pass filter for samples."""

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.noise.effect import RunningTransform


def butterworth_sections(order: int, cutoff_hz: float, rate_hz: float) -> Floats:
    """Return the second-order sections [n, 5] of a digital Butterworth low-pass: b0, b1, b2, a1, a2, with unit gain at
    f = 0.

    In the s plane, the poles lie on a circle at angles θ from the negative real axis. Each pair gives a section of s² +
    2 cos θ s + 1, and an odd order adds one of s + 1. The bilinear transform sets s = (1 − z⁻¹)/(1 + z⁻¹) /
    tan(πf_c/f_s).

    Parameters
    ----------
    order : int
        Order of the filter.
    cutoff_hz : float
        Frequency of half power, Hz.
    rate_hz : float
        Sample rate, Hz.

    Examples
    --------
    >>> butterworth_sections(1, 25.0, 100.0).round(9).tolist()
    [[0.5, 0.5, 0.0, -0.0, 0.0]]
    """
    w = np.tan(np.pi * cutoff_hz / rate_hz)
    sections = [[w / (1.0 + w), w / (1.0 + w), 0.0, (w - 1.0) / (w + 1.0), 0.0]] if order % 2 else []
    for pair in range(order // 2):
        damping = 2.0 * np.sin(np.pi * (2 * pair + 1) / (2 * order))
        whole = 1.0 + damping * w + w * w
        gain = w * w / whole
        sections.append([gain, 2.0 * gain, gain, 2.0 * (w * w - 1.0) / whole, (1.0 - damping * w + w * w) / whole])
    return np.array(sections)


class LowPass(RunningTransform):
    """Low-pass filter that is settled at its first sample.

    Parameters
    ----------
    sections : ndarray, shape (n, 5)
        Sections as ``butterworth_sections`` returns them.
    """

    def __init__(self, sections: Floats) -> None:
        self._sections = sections
        self._state: Floats | None = None

    def apply(self, values: Floats) -> None:
        """Filter the next values [k] in place."""
        if self._state is None:
            b0, _, b2, _, a2 = self._sections.T
            self._state = np.stack([1.0 - b0, b2 - a2], axis=1) * values[0]
        filtered = np.ascontiguousarray(values)
        _run(filtered, self._sections, self._state)
        values[:] = filtered


@compiled
def _run(values, sections, state):  # type: ignore[no-untyped-def]
    """Filter values [n] in place, in direct form II transposed; state [sections, 2] continues from call to call."""
    for i in range(sections.shape[0]):
        b0, b1, b2, a1, a2 = sections[i]
        one, two = state[i]
        for k in range(values.size):
            x = values[k]
            y = b0 * x + one
            one = b1 * x - a1 * y + two
            two = b2 * x - a2 * y
            values[k] = y
        state[i, 0], state[i, 1] = one, two
