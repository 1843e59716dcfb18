"""Comparison of the configured sample rate with the measured sample rate.

A wrong rate shifts the Allan deviation along τ and scales the coefficients. N scales with the square root of the error
of the rate, K with the inverse square root. If the two rates agree within the measurement uncertainty, the configured
rate is used. If the difference is larger but within the tolerance of an oscillator, the measured rate is used. If the
difference exceeds this tolerance, the measured rate contradicts the configured rate, and the program cannot determine
the cause. The caller must then not publish results that depend on the rate. The reasons are in
docs/decisions/rate-is-a-label.md and docs/decisions/contradicted-rate.md. The module does no I/O and reads no clock.
"""

from typing import Final

from drivers.timing.arrival_regression import snap_to_standard_rate

AGREEMENT_LIMIT: Final = 0.005
"""Relative difference up to which two rates agree. The resulting error of N and K is at most a quarter of a percent."""
CONTRADICTION_LIMIT: Final = 0.02
"""Relative difference above which the rates contradict each other. Oscillators of sensors are more accurate."""
HYSTERESIS_FACTOR: Final = 0.75
"""Ratio of the limit at which a contradiction ends to the limit at which the contradiction begins."""
UPDATE_THRESHOLD: Final = 0.001
"""Relative change of the measured rate above which the rate in use is replaced."""


class RateCheck:
    """Comparison of the configured sample rate of one device with the measured rate.

    Parameters
    ----------
    configured_hz : float
        Sample rate of the configuration in Hz.

    Examples
    --------
    >>> check = RateCheck(200.0)
    >>> check.compare_with_measured_rate(99.3, relative_uncertainty=0.001)
    >>> check.rate_hz, check.contradicted
    (99.3, True)
    >>> check.compare_with_measured_rate(200.3, relative_uncertainty=0.001)
    >>> check.rate_hz, check.contradicted
    (200.0, False)
    """

    def __init__(self, configured_hz: float) -> None:
        self.configured_hz = configured_hz
        self.measured_hz: float | None = None
        """Newest measured rate in Hz; None before the first measurement."""
        self.rate_hz = configured_hz
        """Rate to use, in Hz."""
        self.contradicted = False
        """True if the measured rate contradicts the configured rate."""

    def compare_with_measured_rate(self, measured_hz: float, relative_uncertainty: float) -> None:
        """Compare the configured rate with a new measurement.

        Parameters
        ----------
        measured_hz : float
            Measured sample rate in Hz.
        relative_uncertainty : float
            Plausible relative error of the measured rate.
        """
        self.measured_hz = measured_hz
        difference = abs(measured_hz / self.configured_hz - 1.0)
        limit = CONTRADICTION_LIMIT * (HYSTERESIS_FACTOR if self.contradicted else 1.0)
        self.contradicted = difference > max(limit, relative_uncertainty)
        if difference <= max(AGREEMENT_LIMIT, relative_uncertainty):
            self.rate_hz = self.configured_hz
        elif self.rate_hz == self.configured_hz or abs(measured_hz / self.rate_hz - 1.0) > UPDATE_THRESHOLD:
            self.rate_hz = snap_to_standard_rate(measured_hz)
