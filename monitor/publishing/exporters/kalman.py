"""Export of the process noise of a Kalman filter as TOML, with the discrete matrices F and Q of each axis.

The error model of one gyroscope axis has three states: the angle error, a random-walk bias and a Gauss-Markov bias. For
an accelerometer axis, the velocity error replaces the angle error.

    angle' = walk + markov + white
    walk' = white noise of density K²
    markov' = -markov/T + white noise of density 2σ²/T

The white noise of the rate has the density N². Flicker noise has no finite-dimensional state model, so a first-order
Gauss-Markov process approximates it. The Allan deviation of the Gauss-Markov process has a peak of 0.618 σ at τ =
1.89 T (IEEE Std 952). The standard deviation σ is chosen so that this peak equals the Allan deviation of flicker noise,
0.664 B.

Bias instability dominates the Allan deviation from τ = N²/(0.664 B)² to τ = 3 (0.664 B)²/K². The correlation time T
places the peak at the geometric mean of these limits, τ = √3 N/K. If N or K is unknown, the user must specify T.
Without T, the file omits flicker noise and says so in a comment. If only an upper bound of a coefficient is known, the
bound is used as the value, because too large a process noise is safer than too small a process noise.
"""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.unit_formatting import sensor_kind
from monitor.noise.effects import BiasInstability
from monitor.publishing.exporters.export_input import (
    AxisCoefficientOrBound,
    NoiseCoefficients,
    ascii_unit,
    choose_time_step_s,
    comment_on_omitted_terms,
    describe_coefficients,
    format_float,
    header_comments,
    join_lines,
)

FLICKER_TAU_S: Final = np.array([1000.0])  # much longer than a sample, where the deviation of flicker noise is constant
MARKOV_PEAK_RATIO: Final = 0.437 * math.sqrt(2.0)
"""Ratio of the peak Allan deviation of the Gauss-Markov process to σ: 0.437 q √T with q² = 2σ²/T (IEEE Std 952)."""
MARKOV_PEAK_AT: Final = 1.89
"""Averaging time at which the Allan deviation of the Gauss-Markov process peaks, in units of T."""
SERIES_BELOW: Final = 0.1
"""Value of dt/T below which differences of exponentials are computed from a power series."""

HEADER_COMMENT: Final = (
    "# Process noise of a Kalman filter. States of an axis: angle (velocity) error, random-walk bias, first-order",
    "# Gauss-Markov bias for the bias instability B (its Allan deviation has the peak value 0.664 B):",
    "#   angle' = bias_walk + bias_markov + w_white,  bias_walk' = w_walk,  bias_markov' = -bias_markov/T + w_markov",
    "# psd: two-sided densities of w_white, w_walk and w_markov; the white noise of a sample has variance psd_white/dt",
    "# x[k+1] = F x[k] + w[k], cov(w) = Q: exact over dt",
)


def export_kalman_process_noise(
    noise: NoiseCoefficients, inflation: float = 1.0, dt_s: float | None = None, correlation_time_s: float | None = None
) -> str:
    """Export the process noise of a Kalman filter as TOML.

    Parameters
    ----------
    noise
        Noise coefficients of each axis, in SI units.
    inflation
        Factor that multiplies N, B and K.
    dt_s
        Time step of the filter [s]. By default, the sample period of the noise model or recording.
    correlation_time_s
        Correlation time T of the Gauss-Markov process [s]. By default, T is computed from N and K.

    Raises
    ------
    ConfigError
        If the time step is unknown or outside the supported range.
    """
    step_s = choose_time_step_s(noise, dt_s, "kalman")
    lines = [
        *HEADER_COMMENT,
        *header_comments(noise, inflation, "#"),
        'schema = "imu-monitor/kalman/1"',
        f"dt = {step_s!r}  # s",
        f"inflation = {float(inflation)!r}",
    ]
    for axis, terms in noise.axes.items():
        described = f"# {axis}: {describe_coefficients(terms, 'NBK')}"
        lines += ["", described, f"[{axis}]", *_axis(axis, terms, inflation, step_s, correlation_time_s)]
    return join_lines([*lines, *comment_on_omitted_terms(noise, "NBK", "#")])


def markov_sigma(B: float) -> float:
    """Return the standard deviation σ of the Gauss-Markov process whose Allan deviation peaks at 0.664 B.

    >>> round(markov_sigma(1.0), 3)
    1.075
    """
    return float(np.sqrt(BiasInstability(B).avar(FLICKER_TAU_S, 1.0)[0])) / MARKOV_PEAK_RATIO


def markov_time_s(N: float, K: float) -> float:
    """Return the correlation time [s] of the Gauss-Markov process whose Allan deviation peaks at τ = √3 N/K.

    >>> round(markov_time_s(N=1.5e-4, K=1.5e-6), 1)
    91.6
    """
    return math.sqrt(3.0) * N / K / MARKOV_PEAK_AT


def state_transition_matrix(dt_s: float, correlation_time_s: float) -> Floats:
    """Return the transition matrix F, shape [3, 3], of angle, random-walk bias and Gauss-Markov bias.

    Parameters
    ----------
    dt_s
        Time step [s].
    correlation_time_s
        Correlation time T [s].
    """
    lost = -math.expm1(-dt_s / correlation_time_s)
    return np.array([[1.0, dt_s, correlation_time_s * lost], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0 - lost]])


def process_noise_matrix(dt_s: float, N: float, K: float, markov_sigma: float, correlation_time_s: float) -> Floats:
    """Return the process noise covariance Q, shape [3, 3], of angle, random-walk bias and Gauss-Markov bias.

    Q is the integral of F(s) G F(s)ᵀ over 0 ≤ s ≤ dt, where F is the transition matrix and G = diag(N², K², 2σ²/T).

    Parameters
    ----------
    dt_s
        Time step [s].
    N
        White noise, in rad/√s or m/s/√s.
    K
        Rate random walk, in rad/s/√s or m/s²/√s.
        markov_sigma
        Standard deviation σ of the Gauss-Markov process, in rad/s or m/s².
    correlation_time_s
        Correlation time T [s].
    """
    x = dt_s / correlation_time_s
    q = np.zeros((3, 3))
    q[:2, :2] = K**2 * np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    q[0, 0] += N**2 * dt_s + 2.0 * (markov_sigma * correlation_time_s) ** 2 * _integrated_markov_variance(x)
    q[0, 2] = q[2, 0] = markov_sigma**2 * correlation_time_s * math.expm1(-x) ** 2
    q[2, 2] = -(markov_sigma**2) * math.expm1(-2.0 * x)
    return q


def _integrated_markov_variance(x: float) -> float:
    """Return x - 2(1 - e^-x) + (1 - e^-2x)/2, with a power series for small x to avoid cancellation."""
    if x > SERIES_BELOW:
        return x + 2.0 * math.expm1(-x) - 0.5 * math.expm1(-2.0 * x)
    return math.fsum((-x) ** k * (2.0 - 2.0 ** (k - 1)) / math.factorial(k) for k in range(3, 14))


def _axis(
    axis: str,
    terms: Mapping[str, AxisCoefficientOrBound],
    inflation: float,
    dt_s: float,
    correlation_time_s: float | None,
) -> list[str]:
    kind = sensor_kind(axis)
    rate, drift = ascii_unit("B", kind), ascii_unit("R", kind)
    N, B, K = (terms[letter].value * inflation if letter in terms else 0.0 for letter in "NBK")
    time_s = correlation_time_s or (markov_time_s(N, K) if N and K else None)
    lines = _remarks(terms)
    states = ["angle" if kind == "gyro" else "velocity", "bias_walk"]
    densities = [
        f"psd_white = {format_float(N**2)}  # ({rate})^2/Hz, N^2",
        f"psd_walk = {format_float(K**2)}  # ({drift})^2/Hz, K^2",
    ]
    sigma = markov_sigma(B)
    if B and time_s is None:
        lines.append("# B is omitted: without N and K, the correlation time must be given (--correlation-time S)")
    elif B and time_s is not None:
        states.append("bias_markov")
        densities += [
            f"psd_markov = {format_float(2.0 * sigma**2 / time_s)}  # ({drift})^2/Hz, 2 sigma^2/T",
            f"sigma_markov = {format_float(sigma)}  # {rate}",
            f"correlation_time = {format_float(time_s)}  # s, T",
        ]
    size = len(states)
    sigma, time_s = (sigma, time_s or 1.0) if size == 3 else (0.0, 1.0)  # without the third state, T has no effect
    listed = ", ".join(f'"{state}"' for state in states)
    return [
        *lines,
        f"states = [{listed}]",
        *densities,
        f"F = {_matrix(state_transition_matrix(dt_s, time_s)[:size, :size])}",
        f"Q = {_matrix(process_noise_matrix(dt_s, N, K, sigma, time_s)[:size, :size])}",
    ]


def _remarks(terms: Mapping[str, AxisCoefficientOrBound]) -> list[str]:
    unknown = [letter for letter in "NBK" if letter not in terms]
    bounds = [letter for letter in "NBK" if letter in terms and terms[letter].bound]
    lines = [f"# unknown, set to 0: {', '.join(unknown)}"] if unknown else []
    return lines + ([f"# UPPER BOUND instead of a value: {', '.join(bounds)}"] if bounds else [])


def _matrix(rows: Floats) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{x:.9e}" for x in row) + "]" for row in rows.tolist()) + "]"
