"""One Allan curve: what the window or a whole recording says at each τ, with degrees of freedom."""

from dataclasses import dataclass

from drivers.sample import Floats, Ints


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Overlapping Allan variance of the rate at m averaging times, six axes."""

    tau_s: Floats  # [m]
    factors: Ints  # [m] cluster sizes in samples
    avar: Floats  # [m, 6] unit² of the axis; NaN where the window is still too short
    terms: Ints  # [m, 6] second differences averaged
    edf: Floats  # [m, 6] equivalent degrees of freedom; NaN as avar
    lo: Floats  # [m, 6] deviation, lower end of the 95 % interval
    hi: Floats  # [m, 6] deviation, upper end
    n: int  # samples in the window, missing ones included
