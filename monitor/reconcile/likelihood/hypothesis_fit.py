"""Hypotheses about one axis: effects of a noise model, some with a new size, and added effects.

A noise effect of the model is resized only if the log-likelihood gain exceeds ``RESIZE_PENALTY_NATS``. The sizes of
added effects and of deterministic effects are always fitted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import exp, inf, log, sqrt
from typing import Final

import numpy as np

from monitor.common.distributions import HALF_CHI2_95, Z95
from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasStep,
    CommonVibration,
    ExponentiallyCorrelated,
    PulseTrain,
    RandomSampleHold,
    SampleRateError,
    Saturation,
    TemperatureBias,
    TemperatureHysteresis,
    TemperatureLag,
    UnitError,
    VarianceModulation,
    WanderingVariance,
)
from monitor.reconcile.effect_properties import SERIES_SIZE_PARAMETERS
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import (
    effect_size,
    is_noise_effect,
    is_repeatable_series,
    with_effect_size,
)
from monitor.reconcile.likelihood.periodic_pulse_search import find_pulse_delay
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.result import ParameterInterval

RESIZE_PENALTY_NATS: Final = 7.0
"""Smallest log-likelihood gain, in nats, for a new size of a noise effect of the model.

If the size in the model is true, the gain exceeds 7 nats by chance with the probability P(χ²₁ > 14) = 0.02 %. A
recording with six axes has about 24 sizes, so this occurs in about one of 200 recordings.
"""
TEMPERATURE_EFFECTS: Final = (TemperatureBias, TemperatureHysteresis, TemperatureLag)
UNMODELLED_TRANSFORMS: Final = (RandomSampleHold, SampleRateError, Saturation, UnitError)
"""Transforms that change deterministic effects in a way that the fit does not describe."""
STEP_TIME_95_NATS: Final = -log(1.0 - sqrt(0.95))
"""Loss of log-likelihood at the true time of a step that is exceeded with a probability of 5 %, in nats."""
MIN_INTERVAL_LOG: Final = 1e-6
MAX_INTERVAL_LOG: Final = 2.0
"""Smallest and largest half width of an interval in the search, on a logarithmic scale."""
GOLDEN: Final = 0.6180339887498949
SHAPE_ITERATIONS: Final = 12
MAX_LOG_HALF_WIDTH: Final = 3.0
"""Largest half width of an interval that is symmetric on a logarithmic scale."""


MAX_MEAN_DEVIATIONS: Final = 3.0
"""Largest change of the mean of a random variance, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects of a noise model and added effects, fitted to one axis."""

    model: Effects  # effects of the model under test with the original sizes; the first entries of ``effects``
    fit: AxisFit

    @property
    def axis(self) -> Axis:
        """Axis to which the effects are fitted."""
        return self.fit.axis

    @property
    def model_effect_count(self) -> int:
        """Number of effects in the original noise model."""
        return len(self.model)

    @property
    def added(self) -> Effects:
        """Effects that were added to the noise model."""
        return self.fit.effects[self.model_effect_count :]

    @property
    def effects(self) -> Effects:
        """All fitted effects: the effects of the noise model, then the added effects."""
        return self.fit.effects

    @property
    def resized_model_effect_count(self) -> int:
        """Number of effects of the model with a fitted size that the model determines."""
        return len(compared_size_indices(self.axis, self.model) - self.fit.fixed_sizes)

    @property
    def resize_penalty(self) -> float:
        """Penalty in nats for the fitted sizes of the noise model."""
        return RESIZE_PENALTY_NATS * self.resized_model_effect_count

    @property
    def penalised_log_likelihood(self) -> float:
        """Log-likelihood less the penalty for fitted sizes of the noise model, in nats."""
        return self.fit.log_likelihood - self.resize_penalty

    def refit_with_other_added_effects(self, added: Sequence[Effect]) -> "Hypothesis":
        """Fit the same noise model with another set of added effects."""
        return fit_with_fewest_changes(self.axis, added, self.model)


def fit_with_model_sizes(axis: Axis, model: Effects) -> Hypothesis:
    """Fit what differs between recordings, and keep the sizes that the model determines.

    The sizes of events that happen once, the delays of pulses, the phases of lines and modulations, and the mean of a
    random variance differ between recordings.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    model = with_fitted_mean_variance(axis, _with_fitted_timing(axis, model))
    return Hypothesis(model, axis.fit(model, compared_size_indices(axis, model)))


def fit_deterministic_effects(axis: Axis, model: Effects) -> AxisFit:
    """Fit the deterministic effects of a noise model, and keep the sizes of the noise effects.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    model = with_fitted_mean_variance(axis, _with_fitted_timing(axis, model))
    return axis.fit(model, noise_effect_indices(model))


def _lacks_timing(effect: Effect) -> bool:
    """Return True for pulses without a delay, and for a modulation without a phase."""
    pulses = isinstance(effect, PulseTrain) and effect.delay is None
    return pulses or (isinstance(effect, VarianceModulation) and effect.phase is None)


def _with_fitted_timing(axis: Axis, model: Effects) -> Effects:
    """Return the effects with fitted delays of pulses and fitted phases of modulations."""
    known = [effect for effect in model if not _lacks_timing(effect)]
    if len(known) == len(model):
        return model
    whitened = whiten_axis(axis.fit(known, noise_effect_indices(known)))

    def fit_timing(effect: Effect) -> Effect:
        if not _lacks_timing(effect):
            return effect
        if isinstance(effect, PulseTrain):
            return replace(effect, delay=find_pulse_delay(whitened.series, axis.rate_hz, effect.period, effect.width))
        assert isinstance(effect, VarianceModulation)
        turns = np.arange(axis.n) / (axis.rate_hz * effect.period)
        product = np.exp(-2j * np.pi * turns) @ (whitened.flat_series**2 - 1.0)
        return replace(effect, phase=float(np.angle(1j * product) % (2.0 * np.pi)))

    return tuple(fit_timing(effect) for effect in model)


def with_fitted_mean_variance(axis: Axis, model: Effects) -> Effects:
    """Return the effects with the angle random walk of this recording, if the variance varies randomly.

    The logarithm of the variance has the standard deviation s and the correlation time T. Over a long recording, the
    mean of the logarithm has the standard deviation s √(2T/length). The change is at most ``MAX_MEAN_DEVIATIONS`` times
    this value.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    model : tuple of Effect
        Effects of the axis.
    """
    spread = max(
        (
            one.deviation * min(1.0, (2.0 * one.correlation_time / axis.length_s) ** 0.5)
            for one in model
            if isinstance(one, WanderingVariance)
        ),
        default=0.0,
    )
    sizes = {at: effect_size(one) for at, one in enumerate(model) if isinstance(one, AngleRandomWalk)}
    whites = frozenset(at for at, size in sizes.items() if size > 0.0)
    if spread == 0.0 or not whites:
        return model
    fitted = axis.fit(model, noise_effect_indices(model) - whites).effects
    limit = 0.5 * MAX_MEAN_DEVIATIONS * spread

    def within_limit(at: int) -> Effect:
        log_ratio = log(max(effect_size(fitted[at]) / sizes[at], 1e-9))
        return with_effect_size(model[at], sizes[at] * exp(min(max(log_ratio, -limit), limit)))

    return tuple(within_limit(at) if at in whites else one for at, one in enumerate(model))


def fit_with_fewest_changes(axis: Axis, added: Sequence[Effect], model: Effects) -> Hypothesis:
    """Fit added effects together with a noise model, and change as few sizes of the model as possible.

    The gain of a common vibration is not fitted, because the spectrum of one axis does not determine the gain. The
    coefficients of unchanged leaks are not fitted either.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    added : sequence of Effect
        Effects that are added to the model.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    effects = (*model, *added)
    common = frozenset(len(model) + at for at, effect in enumerate(added) if isinstance(effect, CommonVibration))
    common |= frozenset(
        at
        for at, effect in enumerate(model)
        if isinstance(effect, AxisLeak) and effect.source in axis.sources_of_unchanged_leaks
    )
    fixed_sizes = compared_size_indices(axis, model) | common
    best = Hypothesis(model, axis.fit(effects, fixed_sizes))
    if fixed_sizes == common:
        return best
    free = Hypothesis(model, axis.fit(effects, common))
    if free.fit.log_likelihood - best.fit.log_likelihood < RESIZE_PENALTY_NATS:
        return best
    while fixed_sizes > common:
        trials = [Hypothesis(model, axis.fit(effects, fixed_sizes - {at})) for at in sorted(fixed_sizes - common)]
        better = max(trials, key=lambda one: one.penalised_log_likelihood)
        if better.penalised_log_likelihood <= best.penalised_log_likelihood:
            break
        best, fixed_sizes = better, better.fit.fixed_sizes
    # the loop fits one more size at a time and cannot find two sizes that improve the fit only together
    return free if free.penalised_log_likelihood > best.penalised_log_likelihood else best


def compared_size_indices(axis: Axis, model: Effects) -> frozenset[int]:
    """Return the indices of the effects whose size in the model is compared with the recording.

    The sizes of noise effects are always included. The sizes of repeatable deterministic effects are included, unless
    the model was fitted to the same recording or contains a transform whose effect on them is not modelled. If the
    recorded temperature is coarse, the sizes of temperature effects are not included.

    Parameters
    ----------
    axis : Axis
        Axis of the recording.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    if axis.is_model_fitted or any(isinstance(effect, UNMODELLED_TRANSFORMS) for effect in model):
        return noise_effect_indices(model)
    fitted = TEMPERATURE_EFFECTS if axis.is_temperature_coarse else ()
    return frozenset(
        at
        for at, effect in enumerate(model)
        if is_noise_effect(effect) or (is_repeatable_series(effect) and not isinstance(effect, fitted))
    )


def noise_effect_indices(effects: Sequence[Effect]) -> frozenset[int]:
    """Return the indices of the noise effects."""
    return frozenset(at for at, effect in enumerate(effects) if is_noise_effect(effect))


def fit_shape_parameter(
    axis: Axis, other_effects: Effects, effect: Effect, parameter_name: str, search_factor: float = 1.5
) -> Effect:
    """Fit one shape parameter of an effect by maximum likelihood, together with all sizes.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    other_effects : tuple of Effect
        Other effects of the axis.
    effect : Effect
        Effect whose shape parameter is varied.
    parameter_name : str
        Name of the shape parameter.
    search_factor : float, optional
        Largest factor between the result and the present value, in either direction.

    Returns
    -------
    Effect
        Effect with the fitted shape parameter and the original size.
    """

    def with_shape_parameter(log_value: float) -> Effect:
        return with_shape(effect, parameter_name, exp(log_value))

    middle, width = log(getattr(effect, parameter_name)), log(search_factor)
    highest = middle + width
    if parameter_name == "frequency":
        highest = min(highest, log(0.5 * axis.rate_hz))  # frequencies above half the sample rate are aliases
    best = find_maximum_by_golden_section(
        lambda x: axis.evaluate_candidate(
            effect.name, lambda: axis.fit((*other_effects, with_shape_parameter(x))).log_likelihood, -inf
        ),
        middle - width,
        highest,
        SHAPE_ITERATIONS,
    )
    return with_shape_parameter(best)


def refit_correlation_times(axis: Axis, added: Sequence[Effect], model: Effects) -> Effects:
    """Fit the correlation times of added correlated noise again, except for the last added effect.

    A slow effect that is not yet in the hypothesis increases the fitted correlation time.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    added : sequence of Effect
        Effects that are added to the model. The last effect is new.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    found = tuple(added)
    for at, effect in enumerate(found[:-1]):
        if isinstance(effect, ExponentiallyCorrelated):
            others = (*model, *found[:at], *found[at + 1 :])
            found = (*found[:at], fit_shape_parameter(axis, others, effect, "correlation_time"), *found[at + 1 :])
    return found


def find_maximum_by_golden_section(function: Callable[[float], float], lo: float, hi: float, iterations: int) -> float:
    """Find the maximum of a function with a single maximum in an interval, by golden-section search.

    Parameters
    ----------
    function : callable
        Function to maximise.
    lo, hi : float
        Ends of the interval.
    iterations : int
        Number of iterations. Each iteration evaluates the function once.
    """
    a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
    at_a, at_b = function(a), function(b)
    for _ in range(iterations):
        if at_a > at_b:
            hi, b, at_b = b, a, at_a
            a = hi - GOLDEN * (hi - lo)
            at_a = function(a)
        else:
            lo, a, at_a = a, b, at_b
            b = lo + GOLDEN * (hi - lo)
            at_b = function(b)
    return 0.5 * (lo + hi)


def compute_size_interval(fit: AxisFit, effect_index: int) -> ParameterInterval:
    """Compute the 95 % interval of the size of an effect. A fixed size has no interval.

    The interval is symmetric for a deterministic effect, and symmetric on a logarithmic scale for a noise effect. If a
    noise effect is hardly significant, the interval of its variance is symmetric and may include zero.

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    effect_index : int
        Index of the effect.
    """
    value, error = effect_size(fit.effects[effect_index]), fit.size_standard_error(effect_index)
    if effect_index in fit.fixed_sizes:
        return ParameterInterval(value)
    if fit.effects[effect_index].name in SERIES_SIZE_PARAMETERS:
        return ParameterInterval(value, value - Z95 * error, value + Z95 * error)
    if not value > 0.0 or not np.isfinite(error):
        return ParameterInterval(value)
    half = Z95 * error / value  # of the logarithm; twice as large relative to the variance
    if half < MAX_LOG_HALF_WIDTH:
        ends = value * exp(-half), value * exp(half)
    else:
        ends = 0.0, value * sqrt(1.0 + 2.0 * half)
    effect = fit.effects[effect_index]
    if isinstance(effect, CommonVibration) and effect.gain < 0.0:
        return ParameterInterval(-value, -ends[1], -ends[0])
    return ParameterInterval(value, *ends)


def with_shape(effect: Effect, name: str, value: float) -> Effect:
    """Return a copy of an effect with a new shape parameter, limited to the largest allowed value.

    Parameters
    ----------
    effect : Effect
        Effect to copy.
    name : str
        Name of the shape parameter.
    value : float
        New value, in the unit of the parameter.
    """
    largest = next(f.metadata["most"] for f in fields(effect) if f.name == name)  # type: ignore[arg-type]
    changed: Effect = replace(effect, **{name: min(value, largest)})  # type: ignore[type-var]
    return changed


def compute_shape_interval(fit: AxisFit, effect_index: int, parameter_name: str) -> ParameterInterval:
    """Compute the 95 % interval of a shape parameter from the profile likelihood.

    The likelihood of the time t of a step is not smooth. Its logarithm falls on both sides of the maximum like a random
    walk with a drift, so P(loss at the true time < x) = (1 − exp(−x))² (Hinkley, Biometrika 57 (1970) 1).

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    effect_index : int
        Index of the effect.
    parameter_name : str
        Name of the shape parameter.
    """
    effects, effect = fit.effects, fit.effects[effect_index]
    value = float(getattr(effect, parameter_name))
    limit_nats = STEP_TIME_95_NATS if isinstance(effect, BiasStep) else HALF_CHI2_95

    def log_likelihood_of_shape(log_factor: float) -> float:
        shaped = with_shape(effect, parameter_name, value * exp(log_factor))
        changed = (*effects[:effect_index], shaped, *effects[effect_index + 1 :])
        return fit.axis.fit(changed, fit.fixed_sizes).log_likelihood

    def is_likely(log_factor: float) -> bool:
        shaped = fit.axis.evaluate_candidate(effect.name, lambda: log_likelihood_of_shape(log_factor), -inf)
        return fit.log_likelihood - shaped < limit_nats

    ends = []
    for sign in (-1.0, 1.0):
        step = MIN_INTERVAL_LOG
        while step < MAX_INTERVAL_LOG and is_likely(sign * step):
            step *= 2.0
        lo, hi = 0.5 * step, step
        for _ in range(8):
            middle = 0.5 * (lo + hi)
            lo, hi = (middle, hi) if is_likely(sign * middle) else (lo, middle)
        ends.append(float(getattr(with_shape(effect, parameter_name, value * exp(sign * hi)), parameter_name)))
    return ParameterInterval(value, ends[0], ends[1])
