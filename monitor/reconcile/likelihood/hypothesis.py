"""Hypotheses about one axis: effects of the model, some of them with another size, and effects that were found.

The sizes in a model are kept unless the data contradict them. The size of a noise effect is fitted only if this gains
more than ``RESIZE_PENALTY_NATS`` of log-likelihood. A model whose N is 5 % wrong thus gets another N and no new effect.
A correct K keeps its size although other effects may look like a random walk. The sizes of new effects and of all
deterministic effects (lines, slopes, temperature dependence) are always fitted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any, Final

import numpy as np

from monitor.common.distributions import HALF_CHI2_95, Z95
from monitor.noise.effect import Effect
from monitor.reconcile.likelihood.axis import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.effect_terms import DETERMINISTIC_SIZE_PARAMETERS, NOISE_SIZE_PARAMETERS, size
from monitor.reconcile.result import ParameterInterval

RESIZE_PENALTY_NATS: Final = 5.0
"""Log-likelihood gain in nats that justifies another size of a noise effect of the model."""
GOLDEN: Final = 0.6180339887498949
"""Inverse of the golden ratio."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Fitted effects of one axis."""

    model: Effects  # effects of the model under test with their original sizes; they come first in ``effects``
    fit: AxisFit

    @property
    def axis(self) -> Axis:
        """Axis to which the effects are fitted."""
        return self.fit.axis

    @property
    def given_count(self) -> int:
        """Number of effects in the model under test."""
        return len(self.model)

    @property
    def added(self) -> Effects:
        """Effects that are not in the model under test."""
        return self.fit.effects[self.given_count :]

    @property
    def effects(self) -> Effects:
        """All effects with fitted sizes."""
        return self.fit.effects

    @property
    def refitted_size_count(self) -> int:
        """Number of noise effects of the model whose size was fitted."""
        return sum(at < self.given_count for at in self.fit.fitted_noise)

    @property
    def score(self) -> float:
        """Log-likelihood less the penalty for the fitted sizes of the model, in nats."""
        return self.fit.log_likelihood - RESIZE_PENALTY_NATS * self.refitted_size_count

    def refit_with_added_effects(self, added: Sequence[Effect]) -> "Hypothesis":
        """Return the same model with other effects added, as ``fit_with_fewest_changes`` fits them."""
        return fit_with_fewest_changes(self.axis, added, self.model)


def fit_with_fixed_noise(axis: Axis, model: Effects) -> Hypothesis:
    """Fit the deterministic effects of a model and keep the sizes of its noise effects.

    The sizes of deterministic effects differ from recording to recording.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    model : tuple of Effect
        Effects of the axis in the model under test.
    """
    return Hypothesis(model, axis.fit(model, noise_indices(model)))


def fit_with_fewest_changes(axis: Axis, added: Sequence[Effect], model: Effects) -> Hypothesis:
    """Fit new effects together with a model and change as few sizes of the model as the data require.

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
    fixed_noise = noise_indices(model)
    best = Hypothesis(model, axis.fit(effects, fixed_noise))
    if not fixed_noise:
        return best
    free = Hypothesis(model, axis.fit(effects))
    if free.fit.log_likelihood - best.fit.log_likelihood < RESIZE_PENALTY_NATS:
        return best
    while fixed_noise:
        trials = [Hypothesis(model, axis.fit(effects, fixed_noise - {at})) for at in sorted(fixed_noise)]
        better = max(trials, key=lambda one: one.score)
        if better.score <= best.score:
            break
        best, fixed_noise = better, better.fit.fixed_noise
    # The loop misses the case that two sizes are wrong together.
    return free if free.score > best.score else best


def noise_indices(effects: Sequence[Effect]) -> frozenset[int]:
    """Return the indices of the noise effects."""
    return frozenset(at for at, effect in enumerate(effects) if type(effect) in NOISE_SIZE_PARAMETERS)


def refine_shape(axis: Axis, effects: Effects, index: int, names: Sequence[str], reach: float = 1.5) -> Effects:
    """Maximise the likelihood over shape parameters of one effect with all sizes free.

    The parameters are varied in turn, by golden-section search in their logarithm.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    effects : tuple of Effect
        Effects of the axis.
    index : int
        Index of the effect whose shape is varied. A negative index counts from the end.
    names : sequence of str
        Names of the shape parameters.
    reach : float, optional
        Factor by which the first search extends up and down.

    Returns
    -------
    tuple of Effect
        Effects with the best shape. Sizes are not changed.
    """
    found = effects
    for turn in range(1 if len(names) == 1 else 3):
        for name in names:
            width = log(reach) / (turn + 1)
            middle = log(getattr(found[index], name))
            best = _find_best_shape(axis, found, index, name, middle - width, middle + width)
            found = _with_shape(found, index, name, exp(best))
    return found


def _with_shape(effects: Effects, index: int, name: str, value: float) -> Effects:
    """Return the effects with another value of one parameter of the effect with the given index."""
    index %= len(effects)
    changed: Any = replace(effects[index], **{name: value})  # type: ignore[type-var]
    return (*effects[:index], changed, *effects[index + 1 :])


def find_maximum_by_golden_section(function: Callable[[float], float], lo: float, hi: float, iterations: int) -> float:
    """Return the position of the maximum of a function with one maximum, by golden-section search.

    Parameters
    ----------
    function : callable
        Function to maximise.
    lo, hi : float
        Ends of the interval to search.
    iterations : int
        Number of iterations. Each one shortens the interval by the golden ratio.
    """
    for _ in range(iterations):
        a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
        lo, hi = (lo, b) if function(a) > function(b) else (a, hi)
    return 0.5 * (lo + hi)


def _find_best_shape(axis: Axis, effects: Effects, index: int, name: str, lo: float, hi: float) -> float:
    """Return the logarithm of the shape parameter with the largest likelihood within an interval.

    Unlike ``find_maximum_by_golden_section``, this search evaluates the likelihood once per iteration.
    """

    def value(x: float) -> float:
        return axis.fit(_with_shape(effects, index, name, exp(x))).log_likelihood

    a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
    at_a, at_b = value(a), value(b)
    for _ in range(12):
        if at_a > at_b:
            hi, b, at_b = b, a, at_a
            a = hi - GOLDEN * (hi - lo)
            at_a = value(a)
        else:
            lo, a, at_a = a, b, at_b
            b = lo + GOLDEN * (hi - lo)
            at_b = value(b)
    return 0.5 * (lo + hi)


def size_interval(fit: AxisFit, index: int) -> ParameterInterval:
    """Return the size of an effect with its 95 % interval.

    The logarithm of a standard deviation, and the value of a signed size, is taken as Gaussian.

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    index : int
        Index of the effect.
    """
    value, error = size(fit.effects[index]), fit.size_error(index)
    if type(fit.effects[index]) in DETERMINISTIC_SIZE_PARAMETERS:
        return ParameterInterval(value, value - Z95 * error, value + Z95 * error)
    if not value > 0.0 or not np.isfinite(error):
        return ParameterInterval(value)
    return ParameterInterval(value, value * exp(-Z95 * error / value), value * exp(Z95 * error / value))


def shape_interval(fit: AxisFit, index: int, name: str) -> ParameterInterval:
    """Return a shape parameter with its 95 % interval from the profile likelihood.

    Each end of the interval is the value at which the log-likelihood has fallen by ``HALF_CHI2_95``.

    Parameters
    ----------
    fit : AxisFit
        Fit that contains the effect.
    index : int
        Index of the effect.
    name : str
        Name of the shape parameter.
    """
    value = float(getattr(fit.effects[index], name))

    def fall(factor: float) -> float:
        changed = _with_shape(fit.effects, index, name, value * factor)
        return fit.log_likelihood - fit.axis.fit(changed, fit.fixed_noise).log_likelihood

    ends = []
    for sign in (-1.0, 1.0):
        step = 1e-6
        while step < 2.0 and fall(exp(sign * step)) < HALF_CHI2_95:
            step *= 2.0
        lo, hi = 0.5 * step, step
        for _ in range(8):
            middle = 0.5 * (lo + hi)
            lo, hi = (middle, hi) if fall(exp(sign * middle)) < HALF_CHI2_95 else (lo, middle)
        ends.append(value * exp(sign * hi))
    return ParameterInterval(value, ends[0], ends[1])
