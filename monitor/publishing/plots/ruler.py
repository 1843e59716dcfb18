"""Values along one side of a drawing: to pixels, ticks and grid, linear or logarithmic.

For drawings that are written as SVG by hand. In come the ends of a span, out go positions and labels that a person
reads: 1, 2, 5 and their powers of ten, plain where numbers are short, 10⁻⁵ where they are not. Pure NumPy.
"""

from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Final

import numpy as np

from drivers.sample import Floats

TICK_PX: Final = (36.0, 28.0)  # at least between two ticks of a linear side: across, and down
MOST: Final = 6  # labels of a logarithmic side, about
FEW: Final = 2.2  # decades: of fewer, 2 and 5 have labels too
ONE: Final = 1.0  # decades: of fewer, ticks are those of a linear side
FINE: Final = 5.0  # decades: of fewer, the grid has lines at 2 … 9
PLAIN: Final = 3  # powers of ten up to it are written out
SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, slots=True)
class Ruler:
    """``start`` and ``end`` are the pixels of ``low`` and ``high``; y grows downwards, so there ``end`` < ``start``."""

    low: float
    high: float
    log: bool
    start: float
    end: float

    def at(self, values: Floats) -> Floats:
        """Pixels [n]; NaN where a logarithm is asked of what is not positive.

        >>> Ruler(0.01, 100.0, True, 0.0, 400.0).at(np.array([0.01, 1.0, 10.0]))
        array([  0., 200., 300.])
        """
        low, high = (log10(self.low), log10(self.high)) if self.log else (self.low, self.high)
        shown = np.log10(np.where(values > 0, values, np.nan)) if self.log else values
        return np.asarray(self.start + (shown - low) / (high - low) * (self.end - self.start))

    def ticks(self) -> list[tuple[float, str]]:
        """Pixel and label of each."""
        found = self._decades() if self.log and self._span > ONE else self._steps()
        return [(float(self.at(np.array([value]))[0]), label) for value, label in found]

    def fine(self) -> list[float]:
        """Pixels of 2 … 9 between powers of ten, where those are few enough."""
        if not self.log or self._span > FINE:
            return []
        values = np.array([d * 10.0**p for p in self._powers() for d in range(2, 10)])
        return [float(px) for px in self.at(values[(values > self.low) & (values < self.high)])]

    @property
    def _span(self) -> float:
        """In decades."""
        return log10(self.high / self.low)

    def _powers(self) -> range:
        return range(floor(log10(self.low)), ceil(log10(self.high)) + 1)

    def _decades(self) -> list[tuple[float, str]]:
        if self._span < FEW:
            found = [(d * 10.0**p, _power(p, d)) for p in self._powers() for d in (1, 2, 5)]
        else:
            every = ceil(self._span / MOST)
            found = [(10.0**p, _power(p)) for p in self._powers() if p % every == 0]
        slack = 1e-9
        return [one for one in found if self.low * (1 - slack) <= one[0] <= self.high * (1 + slack)]

    def _steps(self) -> list[tuple[float, str]]:
        raw = (self.high - self.low) / max(2.0, abs(self.end - self.start) / TICK_PX[self.end < self.start])
        ten = 10.0 ** floor(log10(raw))
        step = next(k * ten for k in (1.0, 2.0, 5.0, 10.0) if k * ten >= raw * (1 - 1e-9))
        first, last = ceil(self.low / step - 1e-9), floor(self.high / step + 1e-9)
        return [(i * step, _plain(i * step, step)) for i in range(first, last + 1)]


def thinned(x_px: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The smallest and the largest ``y`` of each pixel of ``x_px`` (growing), so that no spike is lost.

    >>> thinned(np.array([0.1, 0.2, 0.3, 1.5]), np.array([1.0, 9.0, 5.0, 2.0]))
    (array([0.1, 0.2, 1.5]), array([1., 9., 2.]))
    """
    good = np.isfinite(x_px) & np.isfinite(y)
    x_px, y = x_px[good], y[good]
    if x_px.size < 3:
        return x_px, y
    pixel = np.floor(x_px)
    order = np.lexsort((y, pixel))
    edge = np.diff(pixel[order]) > 0
    ends = np.concatenate([[True], edge]) | np.concatenate([edge, [True]])
    keep = np.sort(order[ends])
    return x_px[keep], y[keep]


def _power(power: int, digit: int = 1) -> str:
    """
    >>> _power(-2), _power(2, 5), _power(-5), _power(7, 2)
    ('0.01', '500', '10⁻⁵', '2·10⁷')
    """
    if abs(power) <= PLAIN:
        return f"{digit * 10.0**power:g}"
    return f"{'' if digit == 1 else f'{digit}·'}10{str(power).translate(SUPERSCRIPT)}"


def _plain(value: float, step: float) -> str:
    """With the decimals that tell one tick from the next; very small and large ones as so many of a power of ten.

    >>> _plain(1.5, 0.5), _plain(3e-6, 1e-6), _plain(-20.0, 20.0), _plain(2.5e6, 5e5)
    ('1.5', '3·10⁻⁶', '−20', '25·10⁵')
    """
    if abs(value) < step / 2:
        return "0"
    if abs(value) >= 1e5 or step < 1e-4:
        power = floor(log10(step) + 1e-9)
        text = f"{value / 10.0**power:.0f}·10{str(power).translate(SUPERSCRIPT)}"
    else:
        text = f"{value:.{max(0, -floor(log10(step) + 1e-9))}f}"
    return text.replace("-", "−")
