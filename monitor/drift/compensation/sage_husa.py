"""Adaptive Kalman filter that estimates the bias of a gyro axis, with one update per interval.

The state is [x, x̂, level]. Here x is an ARMA process, x̂ is its one-step prediction, and the level is a slow random
walk. The measured interval mean is z = x + level + v, where v is white noise. The noise variances Q̂ and R̂ are
estimated by the method of Sage and Husa (1969), modified so that they stay positive. Let ε be the innovation, S its
variance, and d_k = (1 − b)/(1 − b^{k+1}) the weight of interval k. The variances are updated by

    Q̂ ← Q̂ + d Q̂ D (ε² − S) Dᵀ Q̂,  D = Hᵀ/S        R̂ ← (1 − d) R̂ + d [(1 − H K)² ε² + H P Hᵀ]

Because Q̂ = s B Bᵀ, only the factor s is updated: s ← s + d s² (ε² − S)/S². Lower limits prevent s and R̂ from becoming
zero. In contrast to the original method, the means of the noise are not estimated. On recordings at rest, estimated
means increased the error by a factor of up to three.

An interval is rejected as an outlier if its innovation exceeds OUTLIER_SIGMAS standard deviations, or if the scatter
within the interval is unusually large. After an outlier, the filter ignores all intervals until GUARD_INTERVALS
successive intervals agree with each other. If the bias persists at a new value, the filter assumes a bias step.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled
from monitor.drift.compensation.arma import ArmaModel, stationary_covariance

FORGETTING_FACTOR: Final = 0.995
"""Forgetting factor b of the noise estimation, which corresponds to a memory of 200 intervals."""
MIN_VARIANCE_SHARE: Final = 0.05
"""Lower limit of the estimated innovation variance, relative to the identified innovation variance."""
OUTLIER_SIGMAS: Final = 6.0
"""Maximum innovation of an accepted interval, in predicted standard deviations."""
MAX_SCATTER_RATIO: Final = (16.0, 10.0)
"""Maximum ratio of the variance within an interval to its running average, and minimum number of averaged intervals.

White noise exceeds the maximum ratio with a probability of at most 1e-6.
"""
GUARD_INTERVALS: Final = 5.0
"""Number of successive intervals that must agree with each other after a rejected interval."""
AGREEMENT_SIGMAS: Final = 4.0
"""Maximum difference at which the means of two intervals agree, in standard deviations of the difference."""
STEP_INTERVALS: Final = (10.0, 300.0)
"""Minimum and maximum number of intervals after which a persistent change counts as a bias step."""
MIN_CONFIRMED_INTERVALS: Final = 5
"""Number of successive intervals at rest that confirm the initial bias level."""
SCATTER_WEIGHT: Final = 0.02
"""Weight of a new interval in the running average of the scatter."""
MIN_LEVEL_MEMORY, MAX_LEVEL_MEMORY = 40, 1000
"""Minimum and maximum memory of the bias level in intervals."""

DRIFT_FILTER: Final = np.dtype(
    [
        ("state", "f8", (3,)),  # x, x̂ and level, rad/s
        ("covariance", "f8", (3, 3)),  # (rad/s)²
        ("phi1", "f8"),
        ("phi2", "f8"),
        ("g1", "f8"),
        ("identified_variance", "f8"),  # identified variance of the innovation a, (rad/s)²
        ("level_variance", "f8"),  # variance of the random walk steps of the level, (rad/s)²
        ("variance", "f8"),  # s, adapted variance of the innovation a, (rad/s)²
        ("white_variance", "f8"),  # R̂, adapted variance of v, (rad/s)²
        ("scatter", "f8"),  # average variance of an interval mean, from the scatter within intervals, (rad/s)²
        ("scatter_count", "f8"),  # number of intervals in ``scatter``
        ("rest_count", "f8"),  # number of intervals at rest
        ("outlier_run", "f8"),  # number of successive outliers that agree with each other
        ("last_outlier", "f8"),  # interval mean of the last outlier, rad/s
        ("guard_left", "f8"),  # number of intervals that must still agree after an outlier
        ("adaptive", "?"),  # True to adapt the noise variances
        ("identified", "?"),  # True if an ARMA model has been identified
    ],
    align=True,
)
"""Data type of the filter state of a gyro axis."""
NOT_AT_REST, USED, REJECTED, STEPPED = range(4)
"""Possible outcomes of an interval: not at rest, used, rejected as an outlier, or used as the end of a bias step."""


def restart_with_model(drift_filter: np.void, model: ArmaModel) -> None:
    """Restart the filter with a new ARMA model.

    The state becomes unknown, and the noise variances are taken from the new model.

    Parameters
    ----------
    drift_filter : record of DRIFT_FILTER
        Filter state of a gyro axis, updated in place.
    model : ArmaModel
        Identified ARMA model in rad/s.
    """
    phi1, phi2 = model.phi
    p11, p12, p22 = stationary_covariance(phi1, phi2, model.theta)
    drift_filter["state"] = 0.0, 0.0, model.mean
    drift_filter["covariance"] = model.variance * np.array([[p11, p12, 0.0], [p12, p22, 0.0], [0.0, 0.0, 0.0]])
    drift_filter["phi1"], drift_filter["phi2"], drift_filter["g1"] = phi1, phi2, phi1 + model.theta
    drift_filter["identified_variance"] = drift_filter["variance"] = model.variance
    drift_filter["white_variance"] = model.white_variance
    # This is the spectral density of x + v at zero frequency.
    slow = model.white_variance + model.variance * ((1.0 + model.theta) / (1.0 - phi1 - phi2)) ** 2
    drift_filter["level_variance"] = slow / min(max(model.count / 3.0, MIN_LEVEL_MEMORY), MAX_LEVEL_MEMORY) ** 2
    drift_filter["covariance"][2, 2] = slow / model.count
    drift_filter["outlier_run"] = drift_filter["guard_left"] = 0.0
    drift_filter["identified"] = True


@compiled
def predict_next_interval(drift_filter: np.void) -> None:
    """Predict the state of the filter for the next interval."""
    phi1, phi2, g1, s = drift_filter["phi1"], drift_filter["phi2"], drift_filter["g1"], drift_filter["variance"]
    x, p = drift_filter["state"], drift_filter["covariance"]
    x[0], x[1] = x[1], phi2 * x[0] + phi1 * x[1]
    p00, p01, p02, p11, p12 = p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2]
    p[0, 0] = p11 + s
    p[0, 1] = p[1, 0] = phi2 * p01 + phi1 * p11 + g1 * s
    p[1, 1] = phi2 * phi2 * p00 + 2.0 * phi1 * phi2 * p01 + phi1 * phi1 * p11 + g1 * g1 * s
    p[0, 2] = p[2, 0] = p12
    p[1, 2] = p[2, 1] = phi2 * p02 + phi1 * p12
    p[2, 2] += drift_filter["level_variance"]


@compiled
def discard_unconfirmed_level_in_motion(drift_filter: np.void) -> None:
    """Process an interval in motion. A bias level that has not been confirmed yet is discarded."""
    if drift_filter["rest_count"] < MIN_CONFIRMED_INTERVALS:
        drift_filter["rest_count"] = 0.0


@compiled
def expected_bias_and_variance(drift_filter: np.void) -> tuple[float, float]:
    """Return the predicted bias in rad/s and the variance of the prediction in (rad/s)²."""
    x, p = drift_filter["state"], drift_filter["covariance"]
    return x[0] + x[2], p[0, 0] + 2.0 * p[0, 2] + p[2, 2]


@compiled
def update_with_interval(
    drift_filter: np.void, interval_mean: float, scatter_variance: float, min_variance: float
) -> tuple[float, int]:
    """Update the filter with the mean of an interval at rest.

    Parameters
    ----------
    drift_filter : record of DRIFT_FILTER
        Filter state of a gyro axis, updated in place.
    interval_mean : float
        Mean of the interval, rad/s.
    scatter_variance : float
        Variance of the mean, estimated from the scatter within the interval, (rad/s)²; NaN means unknown.
    min_variance : float
        Minimum variance of the mean, (rad/s)².

    Returns
    -------
    variance : float
        Variance S of the innovation, (rad/s)².
    outcome : int
        Outcome USED, REJECTED or STEPPED.
    """
    loud = _update_scatter(drift_filter, scatter_variance, min_variance)
    if not drift_filter["identified"]:
        _model_level_only(drift_filter, interval_mean, min_variance)
    drift_filter["white_variance"] = max(drift_filter["white_variance"], min_variance)
    expected, known = expected_bias_and_variance(drift_filter)
    e, total = interval_mean - expected, known + drift_filter["white_variance"]
    outcome = USED
    if loud or e * e > OUTLIER_SIGMAS * OUTLIER_SIGMAS * total:
        outcome = _process_outlier(drift_filter, interval_mean, e)
        if outcome == REJECTED:
            return total, REJECTED
    drift_filter["outlier_run"] = 0.0
    if drift_filter["guard_left"] > 0.0:
        agrees = _agree(drift_filter, interval_mean, AGREEMENT_SIGMAS)
        drift_filter["guard_left"] = drift_filter["guard_left"] - 1.0 if agrees else GUARD_INTERVALS
        drift_filter["last_outlier"] = interval_mean
        return total, REJECTED
    drift_filter["rest_count"] += 1.0
    _correct(drift_filter, e)
    if drift_filter["adaptive"] and drift_filter["identified"] and outcome == USED:
        _adapt_noise(drift_filter, e, total, min_variance)
    return total, outcome


@compiled
def _update_scatter(drift: np.void, scatter: float, least: float) -> bool:
    """Update the average scatter within intervals, and return True if the new value is unusually large."""
    usual = max(drift["scatter"], least)
    loud = drift["scatter_count"] >= MAX_SCATTER_RATIO[1] and scatter > MAX_SCATTER_RATIO[0] * usual
    if scatter == scatter and not loud:
        drift["scatter_count"] += 1.0
        drift["scatter"] += max(SCATTER_WEIGHT, 1.0 / drift["scatter_count"]) * (scatter - drift["scatter"])
    return bool(loud)


@compiled
def _model_level_only(drift: np.void, z: float, least: float) -> None:
    """Set the noise variances for a slowly varying level plus white noise, until an ARMA model is identified."""
    drift["white_variance"] = max(drift["scatter"], least)
    drift["level_variance"] = drift["white_variance"] / MIN_LEVEL_MEMORY**2
    if drift["rest_count"] == 0.0:
        drift["state"][2], drift["covariance"][2, 2] = z, drift["white_variance"]


@compiled
def _process_outlier(drift: np.void, z: float, e: float) -> int:
    """Process an outlier with the innovation ``e``, and decide whether it is REJECTED or STEPPED."""
    if drift["rest_count"] < MIN_CONFIRMED_INTERVALS:
        drift["state"][2], drift["covariance"][2, 2], drift["rest_count"] = z, drift["white_variance"], 1.0
        return REJECTED
    drift["outlier_run"] = drift["outlier_run"] + 1.0 if _agree(drift, z, OUTLIER_SIGMAS) else 1.0
    drift["last_outlier"] = z
    if drift["outlier_run"] < min(max(drift["rest_count"], STEP_INTERVALS[0]), STEP_INTERVALS[1]):
        drift["guard_left"] = GUARD_INTERVALS
        return REJECTED
    drift["guard_left"] = 0.0
    drift["covariance"][2, 2] += e * e
    drift["scatter_count"] = 0.0  # The noise may have changed together with the level.
    return STEPPED


@compiled
def _agree(drift: np.void, z: float, sigmas: float) -> bool:
    """Return True if an interval mean agrees with the last outlier."""
    return bool((z - drift["last_outlier"]) ** 2 < 2.0 * sigmas * sigmas * drift["white_variance"])


@compiled
def _adapt_noise(drift: np.void, e: float, total: float, least: float) -> None:
    """Adapt the noise variances to an innovation ``e`` of variance ``total``."""
    d = (1.0 - FORGETTING_FACTOR) / (1.0 - FORGETTING_FACTOR ** (drift["rest_count"] + 1.0))
    r = drift["white_variance"]
    left = r / total  # 1 − H K
    r = (1.0 - d) * r + d * (left * left * e * e + expected_bias_and_variance(drift)[1])
    drift["white_variance"] = max(r, 0.5 * drift["scatter"], least)
    s = drift["variance"]
    s += d * s * s * (e * e - total) / (total * total)
    drift["variance"] = max(s, MIN_VARIANCE_SHARE * drift["identified_variance"])


@compiled
def _correct(drift: np.void, e: float) -> None:
    """Correct the state and its covariance with the innovation ``e``."""
    x, p = drift["state"], drift["covariance"]
    h = p[0, 0] + p[2, 0], p[0, 1] + p[2, 1], p[0, 2] + p[2, 2]  # H P
    total = h[0] + h[2] + drift["white_variance"]
    for i in range(3):
        x[i] += h[i] / total * e
    for i in range(3):
        for j in range(3):
            p[i, j] -= h[i] * h[j] / total


@compiled
def refilter_history(
    drift_filter: np.void, interval_means: Floats, scatter_variances: Floats, min_variance: float
) -> None:
    """Run the filter over all stored intervals, for example after ``restart_with_model``.

    Parameters
    ----------
    drift_filter : record of DRIFT_FILTER
        Filter state of a gyro axis, updated in place.
    interval_means : ndarray, shape (n,)
        Interval means in rad/s, oldest first; NaN means not at rest.
    scatter_variances : ndarray, shape (n,)
        Variances of the means, estimated from the scatter within the intervals, (rad/s)².
    min_variance : float
        Minimum variance of a mean, (rad/s)².
    """
    for k in range(interval_means.size):
        if interval_means[k] == interval_means[k]:
            update_with_interval(drift_filter, interval_means[k], scatter_variances[k], min_variance)
        predict_next_interval(drift_filter)
