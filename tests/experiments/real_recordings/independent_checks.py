"""Independent checks of the effects that ``reconcile`` reports for a recording.

The checks use Welch's spectra, block means, differences of successive samples and regressions of NumPy and SciPy. The
checks share no code with ``reconcile``. Each check returns a ``Check``: confirmed, or doubtful, with the figure that
led to the decision. The limits are those of a test at about 1e-5 for a single look.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

Floats = NDArray[np.float64]
MAX_KNOCK_DEVIATIONS: Final = 6.0
"""Largest deviation of a sample in the check of a leak, in robust standard deviations."""
MIN_SEGMENTS: Final = 16
"""Smallest number of segments of a coherence."""
MIN_Z: Final = 4.5
"""Smallest number of standard deviations of a confirmed finding."""
STEP_LENGTHS: Final = (20, 60, 200)
"""Numbers of samples of the means before and after a step."""


@dataclass(frozen=True)
class Check:
    """Result of an independent check of one effect on one axis."""

    confirmed: bool
    evidence: str


@dataclass(frozen=True)
class CheckedRecording:
    """Samples of a recording at rest, without missing samples."""

    values: Mapping[str, Floats]  # in SI units, equal lengths
    rate_hz: float
    temperature_c: Floats | None

    @property
    def duration_s(self) -> float:
        """Length of the recording, s."""
        return float(next(iter(self.values.values())).size) / self.rate_hz

    def times_s(self, axis: str) -> Floats:
        """Return the time of each sample, s."""
        return np.arange(self.values[axis].size) / self.rate_hz

    def block_means(self, axis: str, blocks: int) -> Floats:
        """Return the means of consecutive blocks of equal length."""
        x = self.values[axis]
        size = max(x.size // blocks, 1)
        return np.asarray(x[: size * (x.size // size)].reshape(-1, size).mean(axis=1))


Parameters = Mapping[str, float]
CheckFunction = Callable[[CheckedRecording, str, Parameters], Check]


def check_effect(
    recording: CheckedRecording, axis: str, effect: str, parameters: Mapping[str, float | str]
) -> Check | None:
    """Check one effect of a report. Return None if there is no check for the effect.

    Parameters
    ----------
    recording : CheckedRecording
        Recording of the report.
    axis : str
        Axis of the effect.
    effect : str
        Name of the effect.
    parameters : mapping
        Parameters of the effect in SI units.
    """
    source = parameters.get("source")
    if isinstance(source, str):
        return _check_leak(recording, axis, source, float(parameters["coefficient"]))
    numbers = {name: float(value) for name, value in parameters.items() if not isinstance(value, str)}
    return CHECKS[effect](recording, axis, numbers) if effect in CHECKS else None


def _z_check(z: float, text: str) -> Check:
    return Check(bool(abs(z) > MIN_Z), f"{text}, z = {z:.1f}")


def _white_level(recording: CheckedRecording, axis: str) -> float:
    """Return the two-sided density of the middle of the spectrum, unit²/Hz."""
    f_hz, density = signal.welch(recording.values[axis], recording.rate_hz, nperseg=1024)
    middle = (f_hz > 0.05 * recording.rate_hz) & (f_hz < 0.25 * recording.rate_hz)
    return float(np.median(density[middle])) / 2.0


def _check_resolution(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    steps = np.diff(np.unique(recording.values[axis]))
    multiples = steps[steps > 0.3 * p["step"]] / p["step"]
    share = float(np.mean(np.abs(multiples - np.round(multiples)) < 0.05)) if multiples.size else 0.0
    return Check(share > 0.95, f"{100 * share:.0f} % of the differences of values are multiples of the step")


def _check_peak(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    x, rate_hz, f0 = recording.values[axis], recording.rate_hz, p["frequency"]
    # the power of a wandering line lies mostly within one standard deviation of its frequency
    width_hz = max(p.get("bandwidth", 0.0), 2.0 * p.get("frequency_deviation", 0.0), 4.0 / recording.duration_s)
    size = int(min(x.size, max(256, 2.0 * rate_hz / width_hz)))
    f_hz, density = signal.welch(signal.detrend(x), rate_hz, nperseg=size)
    inside = np.abs(f_hz - f0) <= max(0.5 * width_hz, 0.75 * f_hz[1])
    around = (np.abs(f_hz - f0) > 2.0 * width_hz + 2.0 * f_hz[1]) & (
        np.abs(f_hz - f0) < 8.0 * width_hz + 20.0 * f_hz[1]
    )
    if not inside.any() or around.sum() < 6:
        return Check(False, "too few frequencies for a check")
    ratio = float(density[inside].mean() / np.median(density[around]))
    looks = max(1.0, 2.0 * x.size / size - 1.0) * inside.sum()
    return Check((ratio - 1.0) * looks**0.5 > MIN_Z and ratio > 1.2, f"{ratio:.2f} times the density around the peak")


def _check_low_pass(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    f_hz, density = signal.welch(recording.values[axis], recording.rate_hz, nperseg=512)
    top = float(np.median(density[f_hz > 0.44 * recording.rate_hz]))
    low = float(
        np.median(
            density[(f_hz > 0.02 * recording.rate_hz) & (f_hz < max(0.4 * p["cutoff"], 0.05 * recording.rate_hz))]
        )
    )
    return Check(
        top < 0.9 * low, f"density near half the sample rate is {top / low:.2f} of the density below the cutoff"
    )


def _check_rising_density(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    f_hz, density = signal.welch(recording.values[axis], recording.rate_hz, nperseg=512)
    relative = f_hz / recording.rate_hz
    top, middle = (density[(relative > lo) & (relative < hi)] for lo, hi in ((0.42, 0.49), (0.2, 0.3)))
    looks = 2.0 * recording.values[axis].size / 512
    ratio = float(top.mean() / middle.mean())
    z = (ratio - 1.0) * (looks * top.size / 2.0) ** 0.5
    return Check(z > MIN_Z, f"density near half the sample rate is {ratio:.2f} of the density in the middle")


def _check_white_noise(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    ratio = _white_level(recording, axis) ** 0.5 / p["N"]
    return Check(0.8 < ratio < 1.25, f"middle of the spectrum is {ratio:.2f} times N")


def _excess_at(recording: CheckedRecording, axis: str, tau_s: float) -> tuple[float, float]:
    """Return the ratio of the Allan variance at ``tau_s`` to white noise, and the probability of a smaller one."""
    blocks = max(int(recording.duration_s / tau_s), 6)
    means = recording.block_means(axis, blocks)
    tau_s = recording.duration_s / blocks
    avar = 0.5 * float(np.mean(np.diff(means) ** 2))
    ratio = avar / (_white_level(recording, axis) / tau_s)
    degrees = max(2.0, 2.0 * (means.size - 1) / 3.0)
    return ratio, float(stats.chi2.sf(ratio * degrees, degrees))


def _slow_noise_check(tau_of: Callable[[Parameters, float], float]) -> CheckFunction:
    def check(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
        tau_s = tau_of(p, recording.duration_s)
        found = [_excess_at(recording, axis, tau) for tau in (tau_s, 0.4 * tau_s)]
        ratio, probability = min(found, key=lambda one: one[1])
        return Check(probability < 1e-4, f"Allan variance near {tau_s:.3g} s is {ratio:.1f} times white noise")

    return check


def _trend_check(column: Callable[[Floats, Parameters], Floats], base: int) -> CheckFunction:
    """Return a regression of block means on a column, after a polynomial of degree ``base``."""

    def check(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
        y = recording.block_means(axis, 240)
        t = (np.arange(y.size) + 0.5) / y.size
        tested = column(t * recording.duration_s, p)
        return _regression(y, tested, np.vander(t, base + 1), "trend of block means")

    return check


def _regression(y: Floats, tested: Floats, others: Floats, text: str) -> Check:
    """Test a regressor with Newey-West standard errors, so that correlated residuals do not inflate z."""
    basis = np.column_stack([tested - tested.mean(), others])
    solution, *_ = np.linalg.lstsq(basis, y, rcond=None)
    residual = y - basis @ solution
    score = basis * residual[:, None]
    lags = max(4, y.size // 20)
    middle = score.T @ score
    for lag in range(1, lags + 1):
        part = score[lag:].T @ score[:-lag]
        middle += (1.0 - lag / (lags + 1.0)) * (part + part.T)
    inverse = np.linalg.pinv(basis.T @ basis)
    error = float((inverse @ middle @ inverse)[0, 0]) ** 0.5
    return _z_check(float(solution[0]) / max(error, 1e-300), text)


def _check_step(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    """Compare the change of the mean at a step with the changes at all other times.

    Other steps can hide a step in long means, and slow noise hides it less in short means, so several lengths are used.
    """
    x, rate_hz = recording.values[axis], recording.rate_hz
    at = int(p["time"] * rate_hz)
    sums = np.concatenate([[0.0], np.cumsum(x)])
    best = 0.0
    for size in {*STEP_LENGTHS, int(max(STEP_LENGTHS[0], 0.02 * x.size))}:
        if not size // 2 < at < x.size - size // 2:
            continue
        places = np.arange(size, x.size - size, max(size // 10, 1))
        changes = (sums[places + size] - 2.0 * sums[places] + sums[places - size]) / size
        away = np.abs(places - at) > size
        left, right = max(at - size, 0), min(at + size, x.size)
        found = float(x[at:right].mean() - x[left:at].mean())
        scatter = 1.4826 * float(np.median(np.abs(changes[away] - np.median(changes[away]))))
        best = max(best, found / scatter, key=abs)
    return _z_check(best, "change of the mean beside other changes")


def _check_jumps(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    changes = np.diff(recording.block_means(axis, 400))
    kurtosis = float(stats.kurtosis(changes))
    return _z_check(kurtosis / (24.0 / changes.size) ** 0.5, f"kurtosis {kurtosis:.2f} of changes of block means")


def _block_log_deviation(recording: CheckedRecording, axis: str, blocks: int) -> Floats:
    difference = np.diff(recording.values[axis])
    size = difference.size // blocks
    return np.asarray(np.log(difference[: size * blocks].reshape(blocks, size).std(axis=1) + 1e-300))


def _check_noise_step(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    logs = _block_log_deviation(recording, axis, 200)
    at = int(np.clip(round(p["time"] / recording.duration_s * logs.size), 1, logs.size - 1))
    before, after = logs[:at], logs[at:]
    error = float(np.sqrt(logs.var() / before.size + logs.var() / after.size))
    change = float(after.mean() - before.mean())
    same_sign = change * np.log(max(p["ratio"], 1e-9)) > 0.0
    return Check(
        same_sign and abs(change) > MIN_Z * error, f"noise of successive samples changes by {np.expm1(change):+.1%}"
    )


def _check_variance_period(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    blocks = int(min(recording.values[axis].size // 16, 40.0 * recording.duration_s / p["period"]))
    logs = _block_log_deviation(recording, axis, max(blocks, 16))
    t_s = (np.arange(logs.size) + 0.5) * recording.duration_s / logs.size
    wave = np.exp(2j * np.pi * t_s / p["period"])
    power = abs(np.vdot(wave, logs - logs.mean())) ** 2 / (logs.size * logs.var())
    return Check(power > 12.0, f"periodogram of the logarithm of the variance: {power:.1f} times its mean")


def _check_variance_correlation(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    difference = np.abs(np.diff(recording.values[axis]))
    wanted = max(200, int(12.0 * recording.duration_s / p["correlation_time"]))
    blocks = max(16, min(difference.size // 32, wanted))
    size = difference.size // blocks
    logs = np.log(difference[: size * blocks].reshape(blocks, size).mean(axis=1) + 1e-300)
    logs = np.clip(logs, *np.quantile(logs, [0.05, 0.95]))  # single knocks
    logs = logs - logs.mean()
    lags = range(1, int(np.clip(0.5 * p["correlation_time"] * blocks / recording.duration_s, 1, blocks // 8)) + 1)
    correlations = [float(logs[lag:] @ logs[:-lag] / (logs @ logs)) for lag in lags]
    z = float(np.sum(correlations)) * (blocks / len(lags)) ** 0.5
    return Check(
        z > MIN_Z, f"mean correlation {np.mean(correlations):.2f} of the noise of {blocks} blocks, z = {z:.1f}"
    )


def _check_tails(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    x = signal.detrend(recording.values[axis])
    spread = 1.4826 * float(np.median(np.abs(x - np.median(x))))
    far = int((np.abs(x - np.median(x)) > 4.5 * spread).sum())
    expected = x.size * 2.0 * float(stats.norm.sf(4.5))
    by_chance = float(stats.poisson.sf(far - 1, expected))
    return Check(by_chance < 1e-5, f"{far} samples beyond 4.5 deviations, {expected:.2f} by chance")


def _check_temperature(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    if recording.temperature_c is None:
        return Check(False, "no temperature")
    y = recording.block_means(axis, 240)
    size = recording.values[axis].size // 240 or 1
    t = recording.temperature_c
    warm = t[: size * (t.size // size)].reshape(-1, size).mean(axis=1)[: y.size]
    return _regression(y, warm, np.ones((y.size, 1)), "regression of block means on temperature")


def _check_leak(recording: CheckedRecording, axis: str, source: str, coefficient: float) -> Check:
    """Compare the regression coefficients of eight frequency bands.

    The lowest hundredth of the frequencies is not used, because a drift would outweigh all other frequencies of a band.
    Knocks move both axes in any direction and can outweigh all other samples of a regression. Samples beyond
    ``MAX_KNOCK_DEVIATIONS`` robust standard deviations on one of the axes are therefore interpolated on both axes.
    """
    both = [signal.detrend(recording.values[name]) for name in (source, axis)]
    spreads = [max(1.4826 * float(np.median(np.abs(one - np.median(one)))), 0.1 * float(one.std())) for one in both]
    quiet = np.logical_and(
        *(
            np.abs(one - np.median(one)) <= MAX_KNOCK_DEVIATIONS * spread
            for one, spread in zip(both, spreads, strict=True)
        )
    )
    at = np.arange(quiet.size)
    x, y = (np.fft.rfft(np.interp(at, at[quiet], one[quiet])) for one in both)
    edges = np.linspace(max(x.size // 100, 1), x.size, 9).astype(int)
    bands, errors = [], []
    for first, last in pairwise(edges.tolist()):
        a, b = x[first:last], y[first:last]
        power = float((np.abs(a) ** 2).sum())
        value = float(np.real(np.vdot(a, b))) / power
        rest = float((np.abs(b - value * a) ** 2).mean())
        bands.append(value)
        errors.append((rest / (2.0 * power)) ** 0.5)
    weights = 1.0 / np.square(errors)
    mean = float(np.average(bands, weights=weights))
    scatter = float(np.sum(weights * np.square(np.array(bands) - mean)))
    flat = stats.chi2.sf(scatter, len(bands) - 1) > 1e-4
    agrees = 0.5 < mean / coefficient < 2.0
    return Check(
        bool(flat and agrees and abs(mean) * weights.sum() ** 0.5 > MIN_Z),
        f"coefficient {mean:.4g} in eight bands from {min(bands):.3g} to {max(bands):.3g}",
    )


def _check_common_vibration(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    """Test the coherence with the other axes, which does not depend on the sign and the phase of a vibration.

    The strength of the peak on one axis is no evidence that several axes share a vibration: a strong vibration of one
    axis can be a small part of the noise of another axis. For K independent segments without a common source, the
    coherence C of one frequency has the probability P(C > c) = (1 − c)^(K − 1) (Carter, Knapp & Nuttall, "Estimation of
    the magnitude-squared coherence function via overlapped fast Fourier transform processing", IEEE Trans. Audio
    Electroacoust. 21, 1973). The sum of −(K − 1) ln(1 − C) over m independent frequencies then has a gamma
    distribution. A Hann window makes neighbouring frequencies dependent, so only every second frequency is used. The
    band of the vibration is compared with all other axes, and the probability is multiplied by the number of axes.
    """
    x, rate_hz = recording.values[axis], recording.rate_hz
    middle_hz, width_hz = p.get("frequency", 0.0), p["bandwidth"]
    reach_hz = 0.5 * width_hz if "frequency" in p else width_hz
    size = int(np.clip(4.0 * rate_hz / width_hz, 128, x.size // MIN_SEGMENTS))
    segments = x.size // size
    best_sum, best_mean, count = 0.0, 0.0, 1
    others = [other for other in recording.values if other != axis]
    for other in others:
        f_hz, coherence = signal.coherence(x, recording.values[other], rate_hz, nperseg=size, noverlap=0)
        inside = np.abs(f_hz - middle_hz) <= max(reach_hz, f_hz[1])
        used = np.minimum(coherence[1:-1][inside[1:-1]][::2], 1.0 - 1e-12)
        total = float(-(segments - 1.0) * np.log1p(-used).sum())
        if total > best_sum:
            best_sum, best_mean, count = total, float(used.mean()), used.size
    probability = min(1.0, len(others) * float(stats.gamma.sf(best_sum, count)))
    return Check(
        probability < 1e-5,
        f"coherence {best_mean:.3f} with another axis in {segments} segments, probability {probability:.1g} by chance",
    )


def _check_transient(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    y = recording.block_means(axis, 240)
    t_s = (np.arange(y.size) + 0.5) / y.size * recording.duration_s
    return _regression(y, np.exp(-t_s / p["time_constant"]), np.vander(t_s / t_s[-1], 2), "exponential at the start")


def _check_hold(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    equal = float(np.mean(np.diff(recording.values[axis]) == 0.0))
    return Check(abs(equal - p["fraction"]) < 0.3 * p["fraction"], f"{equal:.2%} of the samples equal the one before")


def _check_clipping(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    x = recording.values[axis]
    ends = int((x == x.max()).sum() + (x == x.min()).sum())
    return Check(ends > 10, f"{ends} samples have the largest or the smallest value")


def _check_pulses(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    x, t_s = signal.detrend(recording.values[axis]), recording.times_s(axis)
    bins = int(np.clip(2.0 * p["period"] / max(p["width"], 1.0 / recording.rate_hz), 8, 400))
    where = ((t_s % p["period"]) / p["period"] * bins).astype(int) % bins
    counts = np.maximum(np.bincount(where, minlength=bins), 1)
    folded = np.bincount(where, x, minlength=bins) / counts
    z = np.abs(folded - np.median(folded)) / (x.std() / counts**0.5)
    return Check(
        float(z.max()) > 6.0, f"folded at the period, the largest mean is {z.max():.1f} standard deviations away"
    )


def _check_power_law(recording: CheckedRecording, axis: str, p: Parameters) -> Check:
    return _slow_noise_check(lambda _p, duration_s: duration_s / 12.0)(recording, axis, p)


CHECKS: Final[dict[str, CheckFunction]] = {
    "resolution": _check_resolution,
    "sinusoidal": _check_peak,
    "narrowband": _check_peak,
    "wandering_line": _check_peak,
    "common_vibration": _check_common_vibration,
    "bandwidth_limit": _check_low_pass,
    "quantization_noise": _check_rising_density,
    "angle_random_walk": _check_white_noise,
    "bias_instability": _slow_noise_check(lambda _p, duration_s: duration_s / 12.0),
    "rate_random_walk": _slow_noise_check(lambda _p, duration_s: duration_s / 6.0),
    "exponentially_correlated": _slow_noise_check(lambda p, _duration_s: 1.9 * p["correlation_time"]),
    "random_telegraph": _slow_noise_check(lambda p, _duration_s: p["dwell_time"]),
    "power_law": _check_power_law,
    "poisson_steps": _check_jumps,
    "rate_ramp": _trend_check(lambda t_s, _p: t_s, 0),
    "bias_curve": _trend_check(lambda t_s, _p: (t_s / t_s[-1]) ** 2, 1),
    "bias_step": _check_step,
    "noise_step": _check_noise_step,
    "variance_modulation": _check_variance_period,
    "wandering_variance": _check_variance_correlation,
    "outliers": _check_tails,
    "heavy_tails": _check_tails,
    "temperature_bias": _check_temperature,
    "temperature_lag": _check_temperature,
    "temperature_hysteresis": _check_temperature,
    "turn_on_transient": _check_transient,
    "sample_hold": _check_hold,
    "saturation": _check_clipping,
    "pulse_train": _check_pulses,
}
"""Check of each effect, by name. Leaks are checked by ``_check_leak``."""
