"""Blocks in, Estimate out: the window, its uncertainty and the fit of one device.

``update`` advances the window sample by sample, missing ones in their places; ``get`` is a look at the result and
refits. The rate enters only as the label of the τ axis and the units of the coefficients: a cluster is a number of
samples.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import NotReady
from drivers.sample import Floats, Ints, SampleBlock, block
from monitor.estimate.batch import TauGrid, cluster_sizes
from monitor.estimate.curve import AllanCurve
from monitor.estimate.estimate import Estimate
from monitor.estimate.fit import Fit, design, fit, nothing_fitted
from monitor.estimate.uncertainty import Tables, intervals
from monitor.estimate.window import MAX_LENGTH, MIN_LENGTH, AllanWindow

FEWEST: Final = 8
"""Samples before the first answer: three τ with a few terms each."""


class Estimator:
    """The live estimate of one device.

    Args:
        rate_hz: nominal samples a second
        window_s: length of the sliding window
        tau: grid of averaging times, or a list of them in s
    Raises:
        ConfigError: the window or the list of τ is impossible at this rate
    """

    def __init__(self, rate_hz: float, window_s: float, tau: TauGrid = "octave") -> None:
        self.rate_hz = rate_hz
        length = min(max(round(window_s * rate_hz), MIN_LENGTH), MAX_LENGTH)
        self.window_s = length / rate_hz
        self._window = AllanWindow(length, cluster_sizes(length, rate_hz, tau))
        self._design = design(self._window.factors, rate_hz)
        self._tables = Tables(self._window.factors, length)
        self._entered: NDArray[np.bool_] = np.zeros((5, 6), np.bool_)
        self._samples = 0
        self._newest_ns = 0

    @property
    def samples(self) -> int:
        """Samples received since the start, resets notwithstanding."""
        return self._samples

    def update(self, samples: SampleBlock) -> None:
        """Advance by the samples missing before the block, then by the block."""
        if samples.lost:
            self._window.skip(samples.lost)
        self._window.update(samples.values)
        self._samples += len(samples)
        self._newest_ns = int(samples.t_ns[-1])

    def reset(self) -> None:
        """Empty the window."""
        self._window.reset()
        self._entered[:] = False

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better now: the same clusters of samples, other τ and units."""
        self.rate_hz = rate_hz
        self.window_s = self._window.length / rate_hz
        self._design = design(self._window.factors, rate_hz)

    def get(self, fitted: bool = True) -> Estimate:
        """The curve of the window and the coefficients fitted to it; without ``fitted``, deviations alone.

        Raises:
            NotReady: fewer than FEWEST samples in the window
        """
        if self._window.n < FEWEST:
            raise NotReady(f"{self._window.n} of at least {FEWEST} samples")
        avar, terms = self._window.avar(), self._window.terms()
        result = self._fit(avar, terms) if fitted else nothing_fitted(avar)
        lo, hi = intervals(avar, result.edf)
        curve = AllanCurve(
            self._window.factors / self.rate_hz, self._window.factors, avar, terms, result.edf, lo, hi, self._window.n
        )
        return Estimate(
            self._newest_ns, self.rate_hz, self.window_s, self._samples, curve, result.fitted, result.coefficients
        )

    def _fit(self, avar: Floats, terms: Ints) -> Fit:
        slope = self._window.slope() * self.rate_hz
        result = fit(self._design, self._tables.at(self._window.n), avar, terms, self._entered, slope)
        self._entered = result.entered
        return result


def warm_up() -> Iterator[str]:
    """Have the kernels compiled, or loaded from the disk cache; yields "window" and "fit" as each is ready.

    Seconds at the very first start on a machine, milliseconds later.
    """
    estimator = Estimator(100.0, 1.0)
    estimator.update(block(np.arange(100, dtype=np.int64), np.zeros((100, 6))))
    yield "window"
    estimator.get()
    yield "fit"
