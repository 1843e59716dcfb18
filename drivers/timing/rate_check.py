"""Comparison of the configured sample rate with the measured one.

A wrong rate shifts the Allan deviation curve along τ and scales the coefficients: N by the square root of the error, K
by its inverse square root. Three outcomes are possible. If the two rates agree, the configured rate is used. If they
differ by more than the measurement uncertainty but by no more than the tolerance of an oscillator, the measured rate is
used. If they differ by more than that, one of them is wrong for a reason that the program cannot determine, and the
configured rate is contradicted. The caller must then not publish results that depend on the rate. The reasons are in
docs/decisions/rate-is-a-label.md and docs/decisions/contradicted-rate.md. The module does no I/O and reads no clock.
"""

from typing import Final

from drivers.timing.arrival_regression import snap_to_standard_rate

AGREEMENT_LIMIT: Final = 0.005
"""Relative difference up to which two rates agree. N and K are then off by a quarter of a percent at most."""
CONTRADICTION_LIMIT: Final = 0.02
"""Relative difference above which the configured rate is contradicted. Oscillators of sensors are better than this."""
HYSTERESIS_FACTOR: Final = 0.75
"""A contradiction ends below this share of the limit at which it began, so that the decision does not alternate."""
UPDATE_THRESHOLD: Final = 0.001
"""Relative change of the measured rate above which the rate in use is replaced."""


class RateCheck:
    """Comparison of the configured rate of one device with the measured one.

    Parameters
    ----------
    configured_hz : float
        Sample rate of the configuration in Hz.

    Examples
    --------
    >>> check = RateCheck(200.0)
    >>> check.update(99.3, uncertainty=0.001)
    >>> check.rate_hz, check.contradicted
    (99.3, True)
    >>> check.update(200.3, uncertainty=0.001)
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

    def update(self, measured_hz: float, uncertainty: float) -> None:
        """Compare the configured rate with a new measurement.

        Parameters
        ----------
        measured_hz : float
            Measured sample rate in Hz.
        uncertainty : float
            Plausible relative error of the measured rate.
        """
        self.measured_hz = measured_hz
        difference = abs(measured_hz / self.configured_hz - 1.0)
        limit = CONTRADICTION_LIMIT * (HYSTERESIS_FACTOR if self.contradicted else 1.0)
        self.contradicted = difference > max(limit, uncertainty)
        if difference <= max(AGREEMENT_LIMIT, uncertainty):
            self.rate_hz = self.configured_hz
        elif self.rate_hz == self.configured_hz or abs(measured_hz / self.rate_hz - 1.0) > UPDATE_THRESHOLD:
            self.rate_hz = snap_to_standard_rate(measured_hz)
