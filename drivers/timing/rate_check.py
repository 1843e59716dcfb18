"""Check of the configured sample rate against the measured sample rate.

An incorrect sample rate shifts the Allan deviation along τ and scales the noise coefficients. If the difference is
within the tolerance of an oscillator, the measured rate is used. If the difference is larger, its cause is unknown, and
results that depend on the sample rate must not be published (docs/explanation/decisions/rate-is-a-label.md,
docs/explanation/decisions/contradicted-rate.md).
"""

from typing import Final

from drivers.timing.arrival_regression import snap_to_standard_rate

AGREEMENT_LIMIT: Final = 0.005
"""Maximum relative difference between two rates that agree. The resulting error of N and K is at most 0.25 %."""
CONTRADICTION_LIMIT: Final = 0.02
"""Relative difference above which the measured rate contradicts the configured rate.

Sensor oscillators are more accurate.
"""
HYSTERESIS_FACTOR: Final = 0.75
"""Ratio of the threshold at which a contradiction ends to the threshold at which it starts."""
UPDATE_THRESHOLD: Final = 0.001
"""Relative change of the measured rate above which the sample rate in use is updated."""


class RateCheck:
    """Check of the configured sample rate of one device against measured rates.

    Parameters
    ----------
    configured_hz : float
        Configured sample rate in Hz.

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
        """Sample rate in use, in Hz."""
        self.contradicted = False
        """True if the measured rate contradicts the configured rate."""

    def compare_with_measured_rate(self, measured_hz: float, relative_uncertainty: float) -> None:
        """Compare the configured sample rate with a newly measured rate.

        Parameters
        ----------
        measured_hz : float
            Measured sample rate in Hz.
        relative_uncertainty : float
            Relative uncertainty of the measured rate.
        """
        self.measured_hz = measured_hz
        difference = abs(measured_hz / self.configured_hz - 1.0)
        limit = CONTRADICTION_LIMIT * (HYSTERESIS_FACTOR if self.contradicted else 1.0)
        self.contradicted = difference > max(limit, relative_uncertainty)
        if difference <= max(AGREEMENT_LIMIT, relative_uncertainty):
            self.rate_hz = self.configured_hz
        elif self.rate_hz == self.configured_hz or abs(measured_hz / self.rate_hz - 1.0) > UPDATE_THRESHOLD:
            self.rate_hz = snap_to_standard_rate(measured_hz)
