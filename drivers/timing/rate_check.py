"""Compares the configured sample rate with the rate that the sample times show.

A wrong rate shifts the Allan curve along τ and scales the coefficients: N by the root of the error, K by its inverse
root. Three outcomes are possible. If the two rates agree, the configured rate is used. If they differ by more than the
measurement allows, but by no more than an oscillator may be off, the measured rate is used. If they differ by more
than that, one of them is wrong for a reason that the program cannot see, and the configured rate is contradicted:
the owner of the check must not publish what depends on the rate. The reasons are in docs/decisions/rate-is-a-label.md
and docs/decisions/contradicted-rate.md. No I/O, no clock.
"""

from typing import Final

from drivers.timing.arrival_regression import made_rate

AGREES: Final = 0.005
"""Relative difference up to which two rates agree: N and K are off by a quarter of a percent at most."""
CONTRADICTED: Final = 0.02
"""Relative difference above which the configured rate is contradicted: oscillators of sensors are better than this."""
AGAIN: Final = 0.75
"""A contradiction ends below this share of the limit at which it began, so that it does not come and go."""
KEPT: Final = 0.001
"""A measured rate that is in use is replaced when the measurement has moved by more than this share."""


class RateCheck:
    """The configured rate of one device beside the measured one.

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
        """Newest measured rate in Hz; None until there is one."""
        self.rate_hz = configured_hz
        """The rate to be used, in Hz."""
        self.contradicted = False
        """True if the configured rate cannot be right, given the measured one."""

    def update(self, measured_hz: float, uncertainty: float) -> None:
        """Compare with a new measurement.

        Parameters
        ----------
        measured_hz : float
            Measured sample rate in Hz.
        uncertainty : float
            Relative error of the measured rate that is still plausible.
        """
        self.measured_hz = measured_hz
        difference = abs(measured_hz / self.configured_hz - 1.0)
        limit = CONTRADICTED * (AGAIN if self.contradicted else 1.0)
        self.contradicted = difference > max(limit, uncertainty)
        if difference <= max(AGREES, uncertainty):
            self.rate_hz = self.configured_hz
        elif self.rate_hz == self.configured_hz or abs(measured_hz / self.rate_hz - 1.0) > KEPT:
            self.rate_hz = made_rate(measured_hz)
