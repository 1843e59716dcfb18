"""Allan deviations and noise coefficients in a sliding window, updated with every sample."""

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from drivers.data_types import AXES, NS_PER_S, make_block
from drivers.errors import ConfigError
from drivers.validation.number_ranges import DURATION_S, RATE_HZ
from imu_monitor._estimates import AllanEstimate
from imu_monitor._message_wording import errors_name_arguments
from imu_monitor._recordings import check_axes, check_range, to_tau_grid
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH
from monitor.estimation.estimator import Estimator

MAX_MISSING: Final = (1 << 63) - 1


class AllanWindow:
    """Streaming estimator of Allan deviations and noise coefficients in a sliding window.

    If the window is full, each appended sample replaces the oldest sample. The computing time per sample does not
    depend on the length of the window.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    window_s : float
        Length of the window in s. The length must correspond to 100 to 10 000 000 samples.
    axes : str or sequence of str, optional
        Axis of each column of the samples. By default, all six axes.
    tau : {"octave", "decade10"} or sequence of float
        Averaging times: powers of two times the sample interval, ten per decade, or a list in s.

    Raises
    ------
    ConfigError
        If an argument is out of range.

    Examples
    --------
    >>> import imu_monitor
    >>> import numpy as np
    >>> window = imu_monitor.AllanWindow(rate_hz=100.0, window_s=60.0, axes="gz")
    >>> rng = np.random.default_rng(1)
    >>> for _ in range(100):
    ...     window.append(0.01 * rng.standard_normal(100))
    >>> window
    <AllanWindow of gz: 6000 of 6000 samples at 100 Hz>
    >>> print(f"{window.estimate()['gz'].coefficients['N'].value:.4f}")
    0.0010
    """

    @errors_name_arguments()
    def __init__(
        self,
        rate_hz: float,
        window_s: float = 3600.0,
        *,
        axes: str | Sequence[str] | None = None,
        tau: Literal["octave", "decade10"] | Sequence[float] = "octave",
    ) -> None:
        check_range("rate_hz", RATE_HZ, rate_hz)
        check_range("window_s", DURATION_S, window_s)
        if not MIN_LENGTH <= round(window_s * rate_hz) <= MAX_LENGTH:
            raise ConfigError(
                f"window_s: {window_s:g} s at {rate_hz:g} Hz are {window_s * rate_hz:.0f} samples; a window has "
                f"{MIN_LENGTH} to {MAX_LENGTH} samples"
            )
        self._axes = check_axes(axes)
        self._columns = [AXES.index(axis) for axis in self.axes]
        self._estimator = Estimator(rate_hz, window_s, to_tau_grid(tau))

    @property
    def axes(self) -> tuple[str, ...]:
        """Axis of each column of the samples."""
        return self._axes

    @property
    def rate_hz(self) -> float:
        """Sample rate in Hz."""
        return self._estimator.rate_hz

    @property
    def window_s(self) -> float:
        """Length of the full window in s."""
        return self._estimator.window_s

    def __len__(self) -> int:
        """Return the number of samples in the window, including missing samples."""
        return self._estimator.samples_in_window

    @errors_name_arguments()
    def append(self, values: ArrayLike, *, missing_before: int = 0) -> None:
        """Append samples to the window.

        Parameters
        ----------
        values : array_like, shape (n, k), (k,) or (n,)
            Samples of the k ``axes`` in rad/s and m/s²; NaN means missing. A one-dimensional array is one sample of
            several axes, or n samples of one axis.
        missing_before : int
            Number of samples that are missing directly before the appended samples.

        Raises
        ------
        ConfigError
            If the shape of ``values`` does not match ``axes``, or if ``missing_before`` is negative.
        """
        rows = np.asarray(values, np.float64)
        if rows.ndim <= 1:
            rows = rows.reshape(-1, 1) if len(self.axes) == 1 else rows.reshape(1, -1)
        if rows.ndim != 2 or rows.shape[1] != len(self.axes):
            raise ConfigError(
                f"values: shape {np.shape(values)}, expected (n, {len(self.axes)}) for {' '.join(self.axes)}"
            )
        if not 0 <= missing_before <= MAX_MISSING:
            raise ConfigError(f"missing_before: {missing_before}; expected 0 or more")
        if not len(rows):
            return
        samples = np.full((len(rows), len(AXES)), np.nan)
        samples[:, self._columns] = rows
        first = self._estimator.samples_received
        t_ns = np.rint((first + np.arange(len(rows))) * (NS_PER_S / self.rate_hz)).astype(np.int64)
        self._estimator.add_samples(make_block(t_ns, samples, lost=int(missing_before)))

    def clear(self) -> None:
        """Remove all samples from the window."""
        self._estimator.empty_window()

    @errors_name_arguments()
    def estimate(self) -> AllanEstimate:
        """Return the Allan deviations and noise coefficients of the samples in the window.

        Raises
        ------
        NotReady
            If the window contains fewer than 8 samples.
        """
        return AllanEstimate(self._estimator.get_converged_estimate())

    def __repr__(self) -> str:
        full = self._estimator.window_length_samples
        return f"<AllanWindow of {' '.join(self.axes)}: {len(self)} of {full} samples at {self.rate_hz:g} Hz>"
