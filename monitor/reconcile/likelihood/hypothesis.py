"""Hypotheses about one axis: effects of a noise model, some with a new size, and added effects.

A noise effect of the model is resized only if the log-likelihood gain exceeds ``RESIZE_PENALTY_NATS``. The sizes of
added effects and of deterministic effects are always fitted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from monitor.common.distributions import HALF_CHI2_95, Z95
from monitor.noise.effect import Effect
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import DETERMINISTIC_SIZE_PARAMETERS, NOISE_SIZE_PARAMETERS, effect_size
from monitor.reconcile.result import ParameterInterval

RESIZE_PENALTY_NATS: Final = 5.0
"""Smallest log-likelihood gain, in nats, for a new size of a noise effect of the model."""
GOLDEN: Final = 0.6180339887498949
SHAPE_ITERATIONS: Final = 12


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
    def given_count(self) -> int:
        """Number of effects in the original noise model."""
        return len(self.model)

    @property
    def added(self) -> Effects:
        """Effects that were added to the noise model."""
        return self.fit.effects[self.given_count :]

    @property
    def effects(self) -> Effects:
        """All fitted effects: the effects of the noise model, then the added effects."""
        return self.fit.effects

    @property
    def refitted_size_count(self) -> int:
        """Number of noise effects of the model with a fitted size."""
        return sum(at < self.given_count for at in self.fit.fitted_noise)

    @property
    def resize_penalty(self) -> float:
        """Penalty in nats for the fitted sizes of the noise model."""
        return RESIZE_PENALTY_NATS * self.refitted_size_count

    @property
    def penalised_log_likelihood(self) -> float:
        """Log-likelihood less the penalty for fitted sizes of the noise model, in nats."""
        return self.fit.log_likelihood - self.resize_penalty

    def refit_with_added_effects(self, added: Sequence[Effect]) -> "Hypothesis":
        """Fit the same noise model with another set of added effects."""
        return fit_with_fewest_changes(self.axis, added, self.model)


def fit_with_fixed_noise(axis: Axis, model: Effects) -> Hypothesis:
    """Fit the deterministic effects of a noise model and keep the sizes of the noise effects.

    The sizes of deterministic effects differ between recordings.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    return Hypothesis(model, axis.fit(model, noise_effect_indices(model)))


def fit_with_fewest_changes(axis: Axis, added: Sequence[Effect], model: Effects) -> Hypothesis:
    """Fit added effects together with a noise model, and change as few sizes of the model as possible.

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
    fixed_noise = noise_effect_indices(model)
    best = Hypothesis(model, axis.fit(effects, fixed_noise))
    if not fixed_noise:
        return best
    free = Hypothesis(model, axis.fit(effects))
    if free.fit.log_likelihood - best.fit.log_likelihood < RESIZE_PENALTY_NATS:
        return best
    while fixed_noise:
        trials = [Hypothesis(model, axis.fit(effects, fixed_noise - {at})) for at in sorted(fixed_noise)]
        better = max(trials, key=lambda one: one.penalised_log_likelihood)
        if better.penalised_log_likelihood <= best.penalised_log_likelihood:
            break
        best, fixed_noise = better, better.fit.fixed_noise
    # the loop fits one more size at a time and cannot find two sizes that improve the fit only together
    return free if free.penalised_log_likelihood > best.penalised_log_likelihood else best


def noise_effect_indices(effects: Sequence[Effect]) -> frozenset[int]:
    """Return the indices of the noise effects."""
    return frozenset(at for at, effect in enumerate(effects) if type(effect) in NOISE_SIZE_PARAMETERS)


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
        changed: Effect = replace(effect, **{parameter_name: exp(log_value)})  # type: ignore[type-var]
        return changed

    middle, width = log(getattr(effect, parameter_name)), log(search_factor)
    best = find_maximum_by_golden_section(
        lambda x: axis.fit((*other_effects, with_shape_parameter(x))).log_likelihood,
        middle - width,
        middle + width,
        SHAPE_ITERATIONS,
    )
    return with_shape_parameter(best)


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
    """Compute the 95 % interval of the size of an effect.

    The interval is symmetric for a deterministic effect, and symmetric on a logarithmic scale for a noise effect.

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    effect_index : int
        Index of the effect.
    """
    value, error = effect_size(fit.effects[effect_index]), fit.size_standard_error(effect_index)
    if type(fit.effects[effect_index]) in DETERMINISTIC_SIZE_PARAMETERS:
        return ParameterInterval(value, value - Z95 * error, value + Z95 * error)
    if not value > 0.0 or not np.isfinite(error):
        return ParameterInterval(value)
    return ParameterInterval(value, value * exp(-Z95 * error / value), value * exp(Z95 * error / value))


def _with_shape(effects: Effects, index: int, name: str, value: float) -> Effects:
    changed: Any = replace(effects[index], **{name: value})  # type: ignore[type-var]
    return (*effects[:index], changed, *effects[index + 1 :])


def compute_shape_interval(fit: AxisFit, effect_index: int, parameter_name: str) -> ParameterInterval:
    """Compute the 95 % interval of a shape parameter from the profile likelihood.

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    effect_index : int
        Index of the effect.
    parameter_name : str
        Name of the shape parameter.
    """
    value = float(getattr(fit.effects[effect_index], parameter_name))

    def log_likelihood_loss(factor: float) -> float:
        changed = _with_shape(fit.effects, effect_index, parameter_name, value * factor)
        return fit.log_likelihood - fit.axis.fit(changed, fit.fixed_noise).log_likelihood

    ends = []
    for sign in (-1.0, 1.0):
        step = 1e-6
        while step < 2.0 and log_likelihood_loss(exp(sign * step)) < HALF_CHI2_95:
            step *= 2.0
        lo, hi = 0.5 * step, step
        for _ in range(8):
            middle = 0.5 * (lo + hi)
            lo, hi = (middle, hi) if log_likelihood_loss(exp(sign * middle)) < HALF_CHI2_95 else (lo, middle)
        ends.append(value * exp(sign * hi))
    return ParameterInterval(value, ends[0], ends[1])
