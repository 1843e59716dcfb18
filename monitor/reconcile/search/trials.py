"""Trials of candidate effects, in which an effect is added to a hypothesis and the fit is repeated.

The **score** of a trial is the gain in log-likelihood less the penalties. ``generate_trial_groups`` yields the trials
in this order:

1. Quantization, clipping and repeated samples.
2. Outliers, heavy tails, and steps, periodic or random variations of the noise level.
3. Deterministic effects, with the gain over the best slow noise. Slow noise can resemble a deterministic effect.
4. Noise effects and a common factor for all noise effects of the model.

If a noise effect is much better, group 4 comes before group 3.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import isnan
from typing import Final, TypeVar

import numpy as np
from scipy.special import chdtrc

from drivers.data_types import Floats
from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    ExponentiallyCorrelated,
    HeavyTails,
    Narrowband,
    NoiseStep,
    Outliers,
    PowerLaw,
    RandomSampleHold,
    RateRandomWalk,
    Resolution,
    Saturation,
    ScaleFactor,
    Sinusoidal,
    VarianceModulation,
    WanderingVariance,
)
from monitor.noise.effects.disturbances.heavy_tails import DEGREES_OF_FREEDOM
from monitor.reconcile.diagnostics.whiteness_tests import STEP_MARGIN_FRACTION, find_changed_resolution
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import effect_size, linear_coefficient_names
from monitor.reconcile.likelihood.hypothesis_fit import (
    RESIZE_PENALTY_NATS,
    Hypothesis,
    compared_size_indices,
    find_maximum_by_golden_section,
    fit_shape_parameter,
    fit_with_fewest_changes,
    refit_correlation_times,
)
from monitor.reconcile.likelihood.outlier_fit import convert_student_to_gaussian, student_misfit_z
from monitor.reconcile.likelihood.variance_change_tests import compare_variance_change_forms, gains_in_frequency_bands
from monitor.reconcile.likelihood.wandering_variance_fit import FittedWanderingVariance, estimate_wandering_std
from monitor.reconcile.likelihood.whitening import MIN_NOISE_GAIN, WhitenedAxis, compute_periodogram, whiten_axis
from monitor.reconcile.preparation.value_artifacts import ValueWithInterval
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.candidate_effects import (
    DETERMINISTIC_CANDIDATES,
    NOISE_CANDIDATES,
    fit_low_pass,
    fit_resonance,
    initial_effect_size,
    propose_correlated_noise,
    propose_power_law,
    propose_pulse_trains,
)

RETUNE: Final = "retuned"
"""Name of a trial that only changes sizes of the noise model."""
SLOW_NOISE_EXPONENTS: Final = (0.5, 1.5, 2.5, 2.9)
MIN_RESIZE_GAIN_NATS: Final = 1.0
SCALE_FACTOR_MARGIN_NATS: Final = 3.0
"""Smallest advantage of separate sizes over a common factor, in nats."""
SINGLE_SIZE_MARGIN_NATS: Final = 1.5
"""Smallest advantage of a common factor over one new size, in nats. Often, only one size differs."""
SCALE_SEARCH_ITERATIONS: Final = 16
FREQUENCY_BANDS: Final = 8
"""Number of frequency bands in the tests of a leak coefficient and of a variance change."""
MIN_LEAK_PROBABILITY: Final = 1e-5
"""A leak is rejected if the scatter of its coefficient between frequency bands is less probable than this value."""
COEFFICIENT_PENALTY_NATS: Final = 3.3
"""Penalty for each further coefficient of a polynomial, in nats.

By chance, the gain exceeds the penalty for 1 % of all coefficients (χ² distribution).
"""
MIN_STUDENT_GAIN_NATS: Final = 2.0
"""Smallest log-likelihood gain of outliers over Student's t, in nats."""
MAX_OUTLIER_Z: Final = 4.0
"""Largest accepted z value, both for the clustering of large samples and for the misfit."""
MIN_DISTANT_SCALE: Final = 3.5
"""Smallest standard deviation of distant outliers, relative to the noise. Other heavy tails have a smaller ratio."""
MAX_MISFIT_SHARE: Final = 0.25
"""Largest accepted misfit of distant outliers, as a fraction of the gain from fitting the outliers."""
MAX_BAND_SHARE: Final = 0.5
"""Largest share of one frequency band in the gain of a variance change of white noise."""
BAND_MARGIN_NATS: Final = 3.0
"""Chance variation of the gain in one frequency band, in nats."""
MAX_VARIANCE_SHARE: Final = 0.3
"""Largest gain of a variance change after heavy tails are removed, relative to the gain of the heavy tails."""
ALTERNATIVE_MARGIN_NATS: Final = 1.0
"""Largest advantage of another variance change over a step of the noise, in nats."""
MAX_BAND_FRACTION: Final = 0.25
"""Largest width of a narrow frequency band, as a fraction of the sample rate."""
MOVE_ADVANTAGE_NATS: Final = 4.0
"""Score advantage, in nats, of a moved line over an additional line, which would need two more fitted sizes."""
MAX_NEIGHBOUR_CYCLES: Final = 10.0
"""Largest change of the frequency of a line that is searched near the line, in cycles per recording."""
MIN_NEIGHBOUR_CYCLES: Final = 0.1
"""Smallest such change. A smaller change is hardly distinguishable from another phase."""
MAX_MOVED_SIZE_RATIO: Final = 3.0
"""Largest ratio of the sizes of a line before and after a change of the frequency."""
NOISE_PRIORITY_NATS: Final = 5.0
"""Smallest score advantage, in nats, at which noise effects are tried before deterministic effects."""

Proposed = TypeVar("Proposed", Effect, "Trial")


@dataclass(frozen=True, slots=True)
class Trial:
    """Candidate effect with the score of the fit."""

    name: str  # name of the effect, or ``RETUNE``
    effect: Effect | None  # None if no effect is added
    score: float  # log-likelihood gain less penalties, nats; for a deterministic effect, the gain over slow noise
    score_without_slow_noise: float = 0.0  # of a deterministic effect, nats
    slow_noise_score: float = 0.0  # score of the best slow noise, which ``score`` of a deterministic effect excludes
    is_rival_only: bool = False  # True if the trial belongs to another group and only affects the confidence
    intervals: Mapping[str, ParameterInterval] = field(
        default_factory=dict
    )  # parameters that the fit does not determine
    event_count: int = 0  # number of events that were detected
    misfit_nats: float = 0.0  # difference from the data that ``effect`` hides from the diagnostics
    gain_over_same_spectrum: float = 0.0  # gain over the Gaussian effect with the same spectrum, nats
    moved: int | None = None  # index of the model effect that ``effect`` replaces; None for an additional effect
    replaced: Effect | None = None  # this model effect

    def __post_init__(self) -> None:
        if isnan(self.score):
            raise FloatingPointError("the score is not a number")

    @property
    def score_with_slow_noise(self) -> float:
        """Score relative to the hypothesis before the round, in nats. Scores of the same round are comparable."""
        return self.score + self.slow_noise_score


def generate_trial_groups(hypothesis: Hypothesis, whitened: WhitenedAxis) -> Iterator[list[Trial]]:
    """Yield groups of trials, each in descending order of the score.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects.
    whitened : WhitenedAxis
        Axis whitened with ``hypothesis``.
    """
    yield _best_first(_call_for_axis(VALUE_TRIALS, whitened))
    samples = _best_first(_call_for_axis(SAMPLE_TRIALS, whitened))
    # short pulses have heavy tails and a periodic variance too, and are tried with the noise effects
    pulses = _noise_trial_of_each(hypothesis, _call_for_axis((propose_pulse_trains,), whitened)) if samples else []
    yield [] if any(one.score > samples[0].score for one in pulses) else samples
    deterministic, noises = _deterministic_trials(hypothesis, whitened), _noise_trials(hypothesis, whitened)
    groups = [noises + _as_rivals_of_noise(deterministic), deterministic + _as_rivals(noises)]
    if deterministic and deterministic[0].slow_noise_score > noises[0].score:  # the best slow noise is a power law
        rival = Trial("power_law", None, 0.0, slow_noise_score=deterministic[0].slow_noise_score, is_rival_only=True)
        groups[1].append(rival)
    yield from reversed(groups) if _is_deterministic_first(deterministic, noises) else groups


def _is_deterministic_first(deterministic: Sequence[Trial], noises: Sequence[Trial]) -> bool:
    """Return True if the deterministic effects are tried before the noise effects.

    With a wrong spectrum, the residuals contain apparent steps and slopes. A much better noise effect is therefore
    tried first. If the best noise trial only changes sizes and a deterministic effect with slow noise is more likely,
    the deterministic effect is tried first.
    """
    if not deterministic:
        return False
    best, noise = deterministic[0], noises[0]
    if best.score_without_slow_noise > noise.score - NOISE_PRIORITY_NATS:
        return True
    return noise.name == RETUNE and best.score > 0.0 and best.score_with_slow_noise > noise.score


def try_alternatives_to_slow_noise(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Return the trials of effects that explain the data better than the fitted sizes of slow noise.

    Parameters
    ----------
    hypothesis : Hypothesis
        Fitted effects.
    whitened : WhitenedAxis
        Axis whitened with ``hypothesis``.
    """
    trials = [one for one in _deterministic_trials(hypothesis, whitened) if one.score_without_slow_noise > 0.0]
    slow = _call_for_axis((propose_correlated_noise, propose_power_law), whitened)
    trials += _noise_trial_of_each(hypothesis, slow)
    return _best_first([one for one in trials if one.score > 0.0])


def _best_first(trials: Sequence[Trial]) -> list[Trial]:
    return sorted(trials, key=lambda one: -one.score)


def _as_rivals(trials: Sequence[Trial]) -> list[Trial]:
    return [replace(one, is_rival_only=True) for one in trials]


def _as_rivals_of_noise(deterministic: Sequence[Trial]) -> list[Trial]:
    """Convert deterministic trials to rivals of the noise effects, using their scores without additional slow noise."""
    return [
        replace(one, score=one.score_without_slow_noise, slow_noise_score=0.0, is_rival_only=True)
        for one in deterministic
    ]


def _resolution_trial(whitened: WhitenedAxis) -> list[Trial]:
    grid, changed = whitened.axis.value_artifacts.quantization, find_changed_resolution(whitened)
    if grid is None or (Resolution in whitened.effect_types and changed is None):
        return []
    resolution = Resolution(step=grid.step.value)
    trial = _penalised_trial(resolution, grid.gain, {"step": _scaled_bounds(grid.step)}, grid.levels)
    return [replace(trial, moved=changed, replaced=None if changed is None else whitened.effects[changed])]


def _saturation_trial(whitened: WhitenedAxis) -> list[Trial]:
    ends = whitened.axis.value_artifacts.clipping
    if ends is None or not ends.symmetric or Saturation in whitened.effect_types:
        return []
    saturation = Saturation(limit=ends.limit.value)
    return [_penalised_trial(saturation, ends.gain, {"limit": _scaled_bounds(ends.limit)}, ends.count)]


def _sample_hold_trial(whitened: WhitenedAxis) -> list[Trial]:
    twice = whitened.axis.value_artifacts.repeats
    if twice is None or RandomSampleHold in whitened.effect_types:
        return []
    hold = RandomSampleHold(fraction=min(twice.fraction.value, 0.999))
    return [_penalised_trial(hold, twice.gain, {"fraction": _scaled_bounds(twice.fraction)}, round(twice.count))]


def _outlier_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try outliers, unless another cause of heavy tails is as likely.

    Samples that are marked as outliers are replaced, so that the diagnostics no longer show the misfit of distant
    outliers. The trial keeps this misfit.
    """
    far = whitened.outlier_fit
    if far is None or Outliers in whitened.effect_types or far.gain_over_student <= MIN_STUDENT_GAIN_NATS:
        return []
    misfit_nats = 0.5 * (far.clustering_z**2 + far.misfit_z**2)
    core = np.sqrt(max(1.0 - far.fraction.value * far.scale.value**2, 1e-3))  # standard deviation without outliers
    is_distant = far.scale.value > MIN_DISTANT_SCALE * core and misfit_nats < MAX_MISFIT_SHARE * far.gain
    is_misfit = max(far.clustering_z, far.misfit_z) >= MAX_OUTLIER_Z
    if is_misfit and not is_distant:
        return []
    unit = _whitened_unit(whitened.fit)
    effect = Outliers(fraction=min(far.fraction.value, 1.0), scale=unit * far.scale.value)
    intervals = {"fraction": _scaled_bounds(far.fraction), "scale": _scaled_bounds(far.scale, unit)}
    trial = _penalised_trial(effect, far.gain, intervals, far.count)
    return [replace(trial, misfit_nats=misfit_nats if is_misfit else 0.0)]


def _variance_modulation_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try a periodic variance, if no other change of the variance is as likely."""
    changes, found = whitened.variance_changes, whitened.variance_changes.periodic
    if AngleRandomWalk not in whitened.effect_types or VarianceModulation in whitened.effect_types:
        return []
    if found.gain <= max(changes.step.gain, changes.trend_gain, _random_variation_gain(whitened), _band_gain(whitened)):
        return []
    effect = VarianceModulation(depth=found.depth.value, period=found.period.value, phase=found.phase)
    if not _changes_all_frequencies(whitened, whitened.axis.white_noise_gain_over_time((effect,))):
        return []
    intervals = {
        "depth": _scaled_bounds(found.depth),
        "period": _scaled_bounds(found.period),
        "phase": ParameterInterval(found.phase),
    }
    return [_penalised_trial(effect, found.gain, intervals)]


def _wandering_variance_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try a random variation of the variance, unless another cause is as likely or the logarithms are not Gaussian.

    Bursts and switches of the noise level have logarithms with heavy tails.
    """
    found, known = whitened.wandering_variance, whitened.effect_types
    if found is None or AngleRandomWalk not in known or WanderingVariance in known or found.misfit_z >= MAX_OUTLIER_Z:
        return []
    penalty = PENALTY_NATS["wandering_variance"]
    if found.gain <= max(_regular_variation_gain(whitened, found), _band_gain(whitened)) + ALTERNATIVE_MARGIN_NATS:
        return []
    deviation, time_s = found.deviation.value, found.correlation_time.value
    std = estimate_wandering_std(whitened.flat_series, 1.0 / whitened.axis.rate_hz, deviation, time_s)
    if found.gain_over_heavy_tails <= penalty or not _changes_all_frequencies(whitened, std):
        return []
    intervals = {
        "deviation": _scaled_bounds(found.deviation),
        "correlation_time": _scaled_bounds(found.correlation_time),
    }
    return [_penalised_trial(WanderingVariance(deviation=deviation, correlation_time=time_s), found.gain, intervals)]


def _regular_variation_gain(whitened: WhitenedAxis, found: FittedWanderingVariance) -> float:
    """Return the largest gain, in nats, of a step, a trend and a periodic variation of ln σ²."""
    changes, rate_hz, n = whitened.variance_changes, whitened.axis.rate_hz, whitened.axis.n
    return max(
        found.regression_gain(lambda k: (k[None] >= changes.step.time.value * rate_hz).astype(np.float64)),
        found.regression_gain(lambda k: np.stack([k / n, (k / n) ** 2])),
        found.regression_gain(
            lambda k: np.stack(
                [turn(2.0 * np.pi * k / (rate_hz * changes.periodic.period.value)) for turn in (np.cos, np.sin)]
            )
        ),
    )


def _heavy_tails_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try Student's t distribution, unless outliers or a changing variance are as likely a cause."""
    far = whitened.outlier_fit
    if far is None or {HeavyTails, Outliers} & whitened.effect_types or AngleRandomWalk not in whitened.effect_types:
        return []
    nu = far.student.nu
    if far.gain_over_student >= 0.0 or far.clustering_z >= MAX_OUTLIER_Z or not DEGREES_OF_FREEDOM.supports(nu.value):
        return []
    if student_misfit_z(whitened.flat_series, far.student) >= MAX_OUTLIER_Z:
        return []
    gain = far.gain - far.gain_over_student
    gaussian = convert_student_to_gaussian(whitened.flat_series, nu.value)
    changes = compare_variance_change_forms(gaussian, 1.0 / whitened.axis.rate_hz)
    if max(changes.step.gain, changes.largest_gain_other_than_step) > MAX_VARIANCE_SHARE * gain:
        return []
    return [_penalised_trial(HeavyTails(nu=nu.value), gain, {"nu": _scaled_bounds(nu)})]


def _noise_step_trial(whitened: WhitenedAxis) -> list[Trial]:
    """Try a step of the noise, unless another change of the variance is as likely."""
    changes, length_s = whitened.variance_changes, whitened.axis.length_s
    step = changes.step
    inside = STEP_MARGIN_FRACTION * length_s < step.time.value < (1.0 - STEP_MARGIN_FRACTION) * length_s
    if AngleRandomWalk not in whitened.effect_types or not inside:
        return []
    others = changes.trend_gain, changes.periodic.gain, _random_variation_gain(whitened), _band_gain(whitened)
    if step.gain <= max(others) - ALTERNATIVE_MARGIN_NATS:
        return []
    effect = NoiseStep(time=step.time.value, ratio=step.ratio.value)
    if not _changes_all_frequencies(whitened, whitened.axis.white_noise_gain_over_time((effect,))):
        return []
    intervals = {"time": _scaled_bounds(step.time), "ratio": _scaled_bounds(step.ratio)}
    return [_penalised_trial(effect, step.gain, intervals)]


def _random_variation_gain(whitened: WhitenedAxis) -> float:
    """Return the gain of a free variance at low frequencies, in nats, or 0 if a regular variation is more likely."""
    found = whitened.wandering_variance
    is_regular = found is not None and found.gain < _regular_variation_gain(whitened, found)
    return 0.0 if is_regular else whitened.variance_changes.slow_variation_gain


def _changes_all_frequencies(whitened: WhitenedAxis, std: Floats) -> bool:
    """Return True if the variance changes at most frequencies, and not only in one frequency band.

    A resonance whose frequency or strength varies changes the variance in one band.

    Parameters
    ----------
    whitened : WhitenedAxis
        Whitened axis.
    std : ndarray of float64, shape (n,)
        Relative standard deviation over time.
    """
    variance = np.maximum(std, MIN_NOISE_GAIN) ** 2
    gains = gains_in_frequency_bands(whitened.flat_series, variance / variance.mean(), FREQUENCY_BANDS)
    return bool(gains.max() < MAX_BAND_SHARE * gains.sum() + BAND_MARGIN_NATS)


def _band_gain(whitened: WhitenedAxis) -> float:
    """Return the gain of a power change within a narrow frequency band, or 0 for a wide band.

    A step of white noise changes the power at all frequencies.
    """
    found = whitened.unexplained_spectrogram_change
    return found.gain if np.ptp(found.frequency) < MAX_BAND_FRACTION * whitened.axis.rate_hz else 0.0


def _whitened_unit(fit: AxisFit) -> float:
    """Return the factor that converts the whitened series to the unit of the axis."""
    half = fit.axis.bins.count.size // 2
    count, variance = fit.axis.bins.count[half:], fit.whittle.residual[half:]
    return float(np.sqrt(variance.sum() / count.sum()))


def _penalised_trial(
    effect: Effect, gain: float, intervals: Mapping[str, ParameterInterval], event_count: int = 0
) -> Trial:
    return Trial(effect.name, effect, gain - PENALTY_NATS[effect.name], intervals=intervals, event_count=event_count)


def _scaled_bounds(found: ValueWithInterval, unit: float = 1.0) -> ParameterInterval:
    return ParameterInterval(unit * found.value, unit * found.lo, unit * found.hi)


def _call_for_axis(
    functions: Sequence[Callable[[WhitenedAxis], list[Proposed]]], whitened: WhitenedAxis
) -> list[Proposed]:
    """Return the results of all functions that do not fail numerically."""
    return [
        one
        for function in functions
        for one in whitened.axis.evaluate_candidate(
            function.__name__.removeprefix("propose_").strip("_"), partial(function, whitened), list[Proposed]()
        )
    ]


def _noise_trial_of_each(hypothesis: Hypothesis, effects: Sequence[Effect]) -> list[Trial]:
    """Return the trials of all noise effects that do not fail numerically."""
    return [
        trial
        for effect in effects
        for trial in hypothesis.axis.evaluate_candidate(
            effect.name, partial(_noise_trial, hypothesis, effect), list[Trial]()
        )
    ]


def _noise_trial(hypothesis: Hypothesis, effect: Effect) -> list[Trial]:
    score = hypothesis.refit_with_other_added_effects((*hypothesis.added, effect)).penalised_log_likelihood
    return [Trial(effect.name, effect, score - hypothesis.penalised_log_likelihood - PENALTY_NATS[effect.name])]


def _noise_trials(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Try noise effects, new sizes of the noise model, and a common factor.

    The sizes of a model that was fitted to this recording have no common factor.
    """
    resized = hypothesis.refit_with_other_added_effects(hypothesis.added)
    found = [
        Trial(
            RETUNE, None, resized.penalised_log_likelihood - hypothesis.penalised_log_likelihood - MIN_RESIZE_GAIN_NATS
        )
    ]
    found += _noise_trial_of_each(hypothesis, _call_for_axis(NOISE_CANDIDATES, whitened))
    reject, none = hypothesis.axis.evaluate_candidate, list[Trial]()
    found += reject("moved line or resonance", lambda: _moved_feature_trials(hypothesis, found), none)
    found += reject("changed low-pass filter", lambda: _low_pass_trials_beside_known_filter(hypothesis), none)
    if not hypothesis.axis.is_model_fitted:
        found += reject("scale_factor", lambda: [_scale_factor_trial(hypothesis, resized)], none)
    found = _best_first(found)
    return _prefer_single_size(found) if resized.resized_model_effect_count == 1 else found


def _moved_feature_trials(hypothesis: Hypothesis, trials: Sequence[Trial]) -> list[Trial]:
    """Try lines and resonances of the model at the frequencies of new lines and resonances of similar size."""
    moved: list[tuple[int, Effect]] = []
    for new in (trial.effect for trial in trials if trial.score > 0.0):
        for at, known in enumerate(hypothesis.model):
            if not isinstance(new, Sinusoidal | Narrowband) or type(known) is not type(new):
                continue
            effect: Effect = replace(known, frequency=new.frequency)
            if isinstance(new, Narrowband):
                others = (*hypothesis.effects[:at], *hypothesis.effects[at + 1 :])
                effect = fit_resonance(hypothesis.axis, others, replace(new, sigma=effect_size(known)))
            moved.append((at, effect))
    moved += _lines_at_neighbouring_frequencies(hypothesis)
    return [trial for at, effect in moved for trial in _moved_feature_trial(hypothesis, at, effect)]


def _lines_at_neighbouring_frequencies(hypothesis: Hypothesis) -> list[tuple[int, Effect]]:
    """Find the neighbouring frequency of each line of the model whose size or frequency differs from the recording.

    A line that moves by only a few cycles per recording leaves two peaks that are no lines.
    """
    axis, fit = hypothesis.axis, hypothesis.fit
    found: list[tuple[int, Effect]] = []
    for at, known in enumerate(hypothesis.model):
        if not isinstance(known, Sinusoidal) or at not in fit.fixed_sizes:
            continue
        if axis.fit(fit.effects, fit.fixed_sizes - {at}).log_likelihood - fit.log_likelihood < RESIZE_PENALTY_NATS:
            continue
        others = (*fit.effects[:at], *fit.effects[at + 1 :])
        fixed_sizes = frozenset(one - (one > at) for one in fit.fixed_sizes - {at})
        periodogram = compute_periodogram(whiten_axis(axis.fit(others, fixed_sizes)).series)
        spacing_hz = 0.5 * axis.rate_hz / (periodogram.size - 1)
        cycles = MAX_NEIGHBOUR_CYCLES / axis.length_s
        first = max(round((known.frequency - cycles) / spacing_hz), 1)
        near = periodogram[first : round((known.frequency + cycles) / spacing_hz) + 1]
        if near.size == 0:
            continue
        peak = replace(known, frequency=(first + int(np.argmax(near))) * spacing_hz)
        factor = float(np.exp(0.5 / (peak.frequency * axis.length_s)))
        moved = fit_shape_parameter(axis, others, peak, "frequency", factor)
        assert isinstance(moved, Sinusoidal)
        if abs(moved.frequency - known.frequency) * axis.length_s > MIN_NEIGHBOUR_CYCLES:
            found.append((at, moved))
    return found


def _moved_feature_trial(hypothesis: Hypothesis, at: int, effect: Effect) -> list[Trial]:
    """Try another frequency of a line or resonance of the model, if the size is similar.

    A moved line has nearly the same likelihood as an additional line if the amplitude of the old line becomes zero.
    """
    known = hypothesis.model[at]
    assert isinstance(effect, Sinusoidal | Narrowband)
    assert isinstance(known, Sinusoidal | Narrowband)
    model = (*hypothesis.model[:at], effect, *hypothesis.model[at + 1 :])
    moved = fit_with_fewest_changes(hypothesis.axis, hypothesis.added, model)
    size_ratio = effect_size(moved.effects[at]) / max(effect_size(known), 1e-300)
    if not 1.0 / MAX_MOVED_SIZE_RATIO < size_ratio < MAX_MOVED_SIZE_RATIO:
        return []
    gain = moved.penalised_log_likelihood - hypothesis.penalised_log_likelihood
    distance = abs(float(np.log(effect.frequency / known.frequency)))
    score = gain - PENALTY_NATS[effect.name] + MOVE_ADVANTAGE_NATS - distance
    return [Trial(effect.name, effect, score, moved=at, replaced=known)]


def _low_pass_trials_beside_known_filter(hypothesis: Hypothesis) -> list[Trial]:
    """Try another cutoff, kind and order of a low-pass filter of the model, and a second filter.

    A filter changes if the sensor has another bandwidth setting. The host computer may add a second filter.
    """
    places = [at for at, known in enumerate(hypothesis.model) if isinstance(known, BandwidthLimit)]
    if len(places) != 1 or any(isinstance(effect, BandwidthLimit) for effect in hypothesis.added):
        return []
    (at,) = places
    known = hypothesis.model[at]
    assert isinstance(known, BandwidthLimit)
    fitted = fit_low_pass(hypothesis.axis, (*hypothesis.effects[:at], *hypothesis.effects[at + 1 :]))
    if fitted is None:
        return []
    effect = replace(fitted, floor=known.floor)
    model = (*hypothesis.model[:at], effect, *hypothesis.model[at + 1 :])
    changed = fit_with_fewest_changes(hypothesis.axis, hypothesis.added, model)
    gain = changed.penalised_log_likelihood - hypothesis.penalised_log_likelihood
    found = [Trial(effect.name, effect, gain - PENALTY_NATS[effect.name], moved=at, replaced=known)]
    second = fit_low_pass(hypothesis.axis, hypothesis.effects)
    return found if second is None else [*found, *_noise_trial(hypothesis, second)]


def _prefer_single_size(trials: list[Trial]) -> list[Trial]:
    """Move the trial of a single new size to the start if a common factor is only slightly better."""
    size = next(one for one in trials if one.name == RETUNE)
    if trials[0].name != "scale_factor" or trials[0].score >= size.score + SINGLE_SIZE_MARGIN_NATS:
        return trials
    return [size, *(one for one in trials if one is not size)]


def _deterministic_trials(hypothesis: Hypothesis, whitened: WhitenedAxis) -> list[Trial]:
    """Try effects that depend on time, temperature or another axis."""
    free = hypothesis.axis.fit(hypothesis.effects).log_likelihood
    kept = [
        effect
        for effect in _call_for_axis(DETERMINISTIC_CANDIDATES, whitened)
        if hypothesis.axis.candidate_log_likelihood((*hypothesis.effects, effect)) - free
        > 0.3 * PENALTY_NATS[effect.name]
        and (not isinstance(effect, AxisLeak) or _has_flat_coefficient(whitened, effect))
    ]
    if not kept:
        return []
    slow_noises = _slow_noise_scores(hypothesis)
    resized = hypothesis.refit_with_other_added_effects(hypothesis.added)
    without = max(resized.penalised_log_likelihood, *(score(hypothesis.effects) for score in slow_noises))
    baseline = without - hypothesis.penalised_log_likelihood

    def try_effect(effect: Effect) -> list[Trial]:
        added = refit_correlation_times(hypothesis.axis, (*hypothesis.added, effect), hypothesis.model)
        alone = hypothesis.refit_with_other_added_effects(added).penalised_log_likelihood
        gain = max(alone, *(score((*hypothesis.effects, effect)) for score in slow_noises)) - without
        penalty = PENALTY_NATS[effect.name] + COEFFICIENT_PENALTY_NATS * (len(linear_coefficient_names(effect)) - 1)
        score_alone = alone - hypothesis.penalised_log_likelihood - penalty
        return [Trial(effect.name, effect, gain - penalty, score_alone, baseline)]

    reject = hypothesis.axis.evaluate_candidate
    trials = [reject(effect.name, partial(try_effect, effect), list[Trial]()) for effect in kept]
    return _best_first([trial for tried in trials for trial in tried])


def _has_flat_coefficient(whitened: WhitenedAxis, leak: AxisLeak) -> bool:
    """Return True if one coefficient describes a leak at all frequencies.

    If vibration acts on both axes, the coefficient depends on the frequency. A χ² test compares the coefficients of
    several frequency bands. With the source transform X and the noise variance v, the variance of a coefficient is
    1/Σ(X²/v).
    """
    column = whitened.axis.leak_sources[leak.source] * whitened.weights
    edges = np.linspace(0, column.size, FREQUENCY_BANDS + 1).astype(np.int64)[:-1]
    square = np.maximum(np.add.reduceat(column**2, edges), 1e-300)
    product = np.add.reduceat(column * whitened.coefficients, edges)
    scatter = float((square * (product / square - product.sum() / square.sum()) ** 2).sum())
    return bool(chdtrc(FREQUENCY_BANDS - 1, scatter) > MIN_LEAK_PROBABILITY)


def _slow_noise_scores(hypothesis: Hypothesis) -> list[Callable[[Effects], float]]:
    """Return functions that compute the score of given effects with additional slow noise."""
    axis, small = hypothesis.axis, initial_effect_size(hypothesis.axis)
    fixed_sizes, cost = hypothesis.fit.fixed_sizes, hypothesis.resize_penalty

    def make_score_with_added_noise(noise: Effect) -> Callable[[Effects], float]:
        penalty = cost + PENALTY_NATS[noise.name]
        return lambda effects: axis.candidate_log_likelihood((*effects, noise), fixed_sizes) - penalty

    times_s = np.geomspace(10.0 / axis.rate_hz, 0.1 * axis.length_s, 8)
    noises: list[Effect] = [ExponentiallyCorrelated(sigma=small, correlation_time=float(t)) for t in times_s]
    if not any(isinstance(effect, RateRandomWalk) for effect in hypothesis.effects):
        noises.append(RateRandomWalk(K=small))
    noises += [PowerLaw(density=small, exponent=exponent) for exponent in SLOW_NOISE_EXPONENTS]
    return [make_score_with_added_noise(one) for one in noises]


def _scale_factor_trial(hypothesis: Hypothesis, resized: Hypothesis) -> Trial:
    """Try a common factor for all noise effects of the model.

    If the factor fits nearly as well as several changed sizes, it gets at least the score of these sizes.
    """
    effects = (*hypothesis.model, *hypothesis.added)
    fixed_sizes = compared_size_indices(hypothesis.axis, hypothesis.model)

    def log_likelihood_with_axis_scale_factor(log_factor: float) -> float:
        return hypothesis.axis.fit(
            (*effects, ScaleFactor(factor=float(np.exp(log_factor)))), fixed_sizes
        ).log_likelihood

    start = float(max(np.linspace(-3.0, 3.0, 13), key=log_likelihood_with_axis_scale_factor))
    x = find_maximum_by_golden_section(
        log_likelihood_with_axis_scale_factor, start - 0.5, start + 0.5, SCALE_SEARCH_ITERATIONS
    )
    gain = log_likelihood_with_axis_scale_factor(x) - hypothesis.penalised_log_likelihood - PENALTY_NATS["scale_factor"]
    if (
        resized.resized_model_effect_count > 1
        and log_likelihood_with_axis_scale_factor(x) > resized.fit.log_likelihood - SCALE_FACTOR_MARGIN_NATS
    ):
        gain = max(gain, resized.penalised_log_likelihood - hypothesis.penalised_log_likelihood)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), gain)


VALUE_TRIALS: Final = (_resolution_trial, _saturation_trial, _sample_hold_trial)
"""Functions that try the artifacts of the values."""
SAMPLE_TRIALS: Final = (
    _outlier_trial,
    _heavy_tails_trial,
    _noise_step_trial,
    _variance_modulation_trial,
    _wandering_variance_trial,
)
"""Functions that try outliers, heavy tails and variations of the noise level."""
