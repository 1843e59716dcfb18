"""Conversion of received messages into result objects, so that a viewer can display the results of another process.

The input are typed messages of ``monitor.publishing.messages.remote_device``. The output are ``Estimate``, ``Health``
and ``Event`` objects, as the viewer of the daemon receives them. Messages do not contain degrees of freedom and term
counts, so these are unknown here. The fitted curve is that of the five terms of IEEE Std 952 with the estimated
coefficients. The module does no I/O.
"""

from typing import Final

import numpy as np

from drivers.sample import AXES, Event, Floats
from monitor.common.health import Health
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Coefficients
from monitor.noise.standard_terms import unit_allan_variances
from monitor.publishing.messages import remote_device

MAX_AVERAGING_TIMES: Final = 1000
"""Largest accepted number of averaging times."""


def to_estimate(allan: remote_device.AllanMessage, noise: remote_device.Noise) -> Estimate:
    """Build an estimate from the messages of a device.

    Parameters
    ----------
    allan
        Allan deviation message.
    noise
        Coefficients.

    Raises
    ------
    ValueError
        The averaging times do not increase from above zero, or a curve has another length.
    """
    tau_s = np.array(allan.tau)
    m = tau_s.size
    if (
        not 0 < m <= MAX_AVERAGING_TIMES
        or not np.all(tau_s > 0)
        or not np.all(np.diff(tau_s) > 0)
        or not allan.rate > 0
    ):
        raise ValueError("averaging times must rise from above zero")
    deviation, lo, hi = (np.full((m, len(AXES)), np.nan) for _ in range(3))
    for axis, curve in allan.axes.items():
        if axis in AXES:
            for column, values in ((deviation, curve.deviation), (lo, curve.lo), (hi, curve.hi)):
                column[:, AXES.index(axis)] = _column(values, m)
    unknown = np.full((m, len(AXES)), np.nan)
    return Estimate(
        t_ns=round(allan.t * 1e9),
        rate_hz=allan.rate,
        window_s=allan.window,
        samples=allan.samples,
        curve=AllanCurve(
            tau_s=tau_s,
            factors=np.rint(tau_s * allan.rate).astype(np.int64),
            avar=deviation**2,
            terms=np.zeros((m, len(AXES)), np.int64),
            edf=unknown,
            lo=lo,
            hi=hi,
            n=round(allan.filled * allan.rate),
        ),
        fitted=fitted_variance(tau_s, noise.coefficients, 1.0 / allan.rate),
        coefficients=noise.coefficients,
        k_or_r=np.array([axis in noise.either for axis in AXES]),
    )


def fitted_variance(tau_s: Floats, coefficients: Coefficients, tau0_s: float) -> Floats:
    """Return the Allan variance of the estimated terms, shape [m, 6]. Axes without estimated terms are NaN.

    Parameters
    ----------
    tau_s
        Averaging times [s], shape [m].
    coefficients
        Coefficients, shape [5, 6], SI.
    tau0_s
        Sample interval [s].
    """
    total: Floats = unit_allan_variances(tau_s, tau0_s) @ np.nan_to_num(coefficients.value) ** 2
    total[:, np.isnan(coefficients.value).all(axis=0)] = np.nan
    return total


def to_health(status: remote_device.StatusMessage) -> Health:
    """Build a health report from a status message."""
    return Health(
        state=remote_device.strip_control_characters(status.state),
        rate_hz=status.rate,
        received=status.received,
        lost=status.lost,
        bad=status.bad,
        overflowed=status.overflowed,
        latency_p50_s=status.latency.p50,
        latency_p99_s=status.latency.p99,
        memory_bytes=status.memory,
        outputs={
            remote_device.strip_control_characters(name): remote_device.strip_control_characters(said)
            for name, said in status.outputs.items()
        },
        text=remote_device.strip_control_characters(status.text),
        uptime_s=status.uptime,
    )


def to_event(message: remote_device.EventMessage) -> Event:
    """Build an event from a message; it includes the changed coefficients, so that they can be marked in plots."""
    axis = message.axis if message.axis in AXES else None
    what = {
        letter: {side: value for side, value in sizes.items() if isinstance(value, float | int)}
        for letter, sizes in message.what.items()
        if letter in SYMBOLS
    }
    return Event(
        remote_device.strip_control_characters(message.kind),
        round(message.t * 1e9),
        remote_device.strip_control_characters(message.text),
        axis,
        what,
    )


def _column(values: list[float | None], m: int) -> Floats:
    """Return m values as an array; null becomes NaN."""
    if len(values) != m:
        raise ValueError(f"{len(values)} values for {m} averaging times")
    return np.array([np.nan if value is None else value for value in values])
