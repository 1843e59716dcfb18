"""Process noise of a Kalman filter, as TOML: densities, and the discrete F and Q of every axis over one time step.

Error model of one gyroscope (of an accelerometer with velocity for angle):

    angle' = walk + markov + white,   walk' = white of density K²,   markov' = -markov/T + white of density 2σ²/T

with white noise of density N² on the rate. Flicker has no finite state; a first-order Gauss-Markov process stands for
it where it matters: its Allan deviation peaks at 0.618 σ and τ = 1.89 T (IEEE Std 952), which is put on the floor
0.664 B, in the middle (of log τ) of the range that flicker rules: from τ = N²/(0.664 B)² to 3 (0.664 B)²/K², so √3 N/K.
Without N or K that range has no end; then T must be given, or B is left out and the file says so.

A bound counts as if it were the value: a filter that trusts too little is safer. The file says where.
"""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.quantities import DURATION_S
from drivers.sample import Floats
from monitor.publishing.exporters.noise import AXES_OF, Noise, Term, head, number, tail, text

FLOOR: Final = math.sqrt(2.0 * math.log(2.0) / math.pi)
"""Allan deviation of flicker noise over B (IEEE Std 952)."""
MARKOV_PEAK: Final = 0.437 * math.sqrt(2.0)
"""Peak of the Allan deviation of the Gauss-Markov process over its σ: 0.437 q √T with q² = 2σ²/T (IEEE Std 952)."""
MARKOV_PEAK_AT: Final = 1.89
"""Where that peak stands, in correlation times."""
SMALL: Final = 0.1
"""Of dt/T: below, differences of exponentials are taken from their series."""

EXPLAINED: Final = (
    "# Process noise of a Kalman filter. States of an axis: angle (velocity) error, bias that walks, and a first-order",
    "# Gauss-Markov bias that stands for the bias instability B (peak of its Allan deviation on the floor 0.664 B):",
    "#   angle' = bias_walk + bias_markov + w_white,  bias_walk' = w_walk,  bias_markov' = -bias_markov/T + w_markov",
    "# psd: two-sided densities of the w; white noise of a sample has variance psd_white/dt",
    "# x[k+1] = F x[k] + w[k], cov(w) = Q: exact over dt",
)


def kalman(
    noise: Noise, inflation: float = 1.0, dt_s: float | None = None, correlation_time_s: float | None = None
) -> str:
    """The file; the time step is that of the samples, the correlation time as in the module, unless given."""
    step_s = 1.0 / noise.sample_rate_hz if dt_s is None and noise.sample_rate_hz else dt_s
    if step_s is None or not DURATION_S.supports(step_s):
        raise ConfigError(
            f"kalman needs a time step of {DURATION_S.range_text()}: the model's sample_rate, or one that is given"
        )
    if correlation_time_s is not None:
        try:
            DURATION_S.check(correlation_time_s)
        except ConfigError as error:
            raise ConfigError(f"correlation time: {error}") from None
    lines = [
        *EXPLAINED,
        *head(noise, inflation, "#"),
        'schema = "imu-monitor/kalman/1"',
        f"dt = {step_s!r}  # s",
        f"inflation = {float(inflation)!r}",
    ]
    for axis, terms in noise.axes.items():
        lines += ["", f"[{axis}]", *_axis(axis, terms, inflation, step_s, correlation_time_s)]
    return text([*lines, *tail(noise, "NBK", "#")])


def markov_sigma(B: float) -> float:
    """σ of the Gauss-Markov process whose Allan deviation peaks at the floor of flicker noise.

    >>> round(markov_sigma(1.0), 3)
    1.075
    """
    return FLOOR * B / MARKOV_PEAK


def markov_time_s(N: float, K: float) -> float:
    """Correlation time of the process that peaks in the middle of the floor, √3 N/K.

    >>> round(markov_time_s(N=1.5e-4, K=1.5e-6), 1)
    91.6
    """
    return math.sqrt(3.0) * N / K / MARKOV_PEAK_AT


def transition(dt_s: float, time_s: float) -> Floats:
    """F [3, 3] of angle, walking bias and Gauss-Markov bias over dt."""
    lost = -math.expm1(-dt_s / time_s)
    return np.array([[1.0, dt_s, time_s * lost], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0 - lost]])


def process_noise(dt_s: float, N: float, K: float, sigma: float, time_s: float) -> Floats:
    """Q [3, 3] of angle, walking bias and Gauss-Markov bias over dt: ∫ F(s) G F(s)ᵀ ds in closed form."""
    x = dt_s / time_s
    q = np.zeros((3, 3))
    q[:2, :2] = K**2 * np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    q[0, 0] += N**2 * dt_s + 2.0 * (sigma * time_s) ** 2 * _integrated(x)
    q[0, 2] = q[2, 0] = sigma**2 * time_s * math.expm1(-x) ** 2
    q[2, 2] = -(sigma**2) * math.expm1(-2.0 * x)
    return q


def _integrated(x: float) -> float:
    """x - 2(1 - e^-x) + (1 - e^-2x)/2, which begins with x³/3 and would lose its digits where x is small."""
    if x > SMALL:
        return x + 2.0 * math.expm1(-x) - 0.5 * math.expm1(-2.0 * x)
    return math.fsum((-x) ** k * (2.0 - 2.0 ** (k - 1)) / math.factorial(k) for k in range(3, 14))


def _axis(
    axis: str, terms: Mapping[str, Term], inflation: float, dt_s: float, correlation_time_s: float | None
) -> list[str]:
    """One table: what the numbers are worth, densities, F and Q."""
    rate, drift, first = ("rad/s", "rad/s^2", "angle") if axis in AXES_OF["gyro"] else ("m/s^2", "m/s^3", "velocity")
    n, b, k = (terms[letter].value * inflation if letter in terms else 0.0 for letter in "NBK")
    time_s = correlation_time_s or (markov_time_s(n, k) if n and k else None)
    lines = _remarks(terms)
    densities = [
        f"psd_white = {number(n**2)}  # ({rate})^2/Hz, N^2",
        f"psd_walk = {number(k**2)}  # ({drift})^2/Hz, K^2",
    ]
    states = [first, "bias_walk"]
    if b and time_s is None:
        lines.append("# B is left out: without N and K its correlation time must be given (--correlation-time S)")
    elif b and time_s is not None:
        sigma = markov_sigma(b)
        states.append("bias_markov")
        densities += [
            f"psd_markov = {number(2.0 * sigma**2 / time_s)}  # ({drift})^2/Hz, 2 sigma^2/T",
            f"sigma_markov = {number(sigma)}  # {rate}",
            f"correlation_time = {number(time_s)}  # s, T",
        ]
    sigma, size = markov_sigma(b), len(states)
    own_s = time_s or 1.0  # without the third state no number depends on it
    listed = ", ".join(f'"{state}"' for state in states)
    return [
        *lines,
        f"states = [{listed}]",
        *densities,
        f"F = {_matrix(transition(dt_s, own_s)[:size, :size])}",
        f"Q = {_matrix(process_noise(dt_s, n, k, sigma if size == 3 else 0.0, own_s)[:size, :size])}",
    ]


def _remarks(terms: Mapping[str, Term]) -> list[str]:
    """What stands behind the numbers of one axis."""
    unknown = [letter for letter in "NBK" if letter not in terms]
    bounds = [letter for letter in "NBK" if letter in terms and terms[letter].bound]
    lines = [f"# not known, counted as 0: {', '.join(unknown)}"] if unknown else []
    return lines + ([f"# an UPPER BOUND, the data show no more: {', '.join(bounds)}"] if bounds else [])


def _matrix(rows: Floats) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{x:.9e}" for x in row) + "]" for row in rows.tolist()) + "]"
