"""What each effect looks like when it is hidden: shape parameters drawn at random, and one size that is searched for.

A recipe also says what the sensor must have for its effect to be identifiable: a temperature, lines that a wrong
clock can displace, a source axis that shakes by itself, an axis whose model lacks the very term. Where levels are
exact (see the package), ``fixed`` gives the size of each level:

| effect | plain | faint |
| --- | --- | --- |
| `resolution` | step of 0.5–2 deviations of the white noise | 0.05–0.2 |
| `sample_hold` | 0.5–3 % of the samples | 0.02–0.1 % |
| `saturation` | 0.2–1 % of the samples clipped | 0.01–0.04 % |
| `heavy_tails` | 4–25 degrees of freedom | 60–90 |
| `bandwidth_limit` | cutoff of 10–35 % of the sample rate | 42–48 % |
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import ndtr, ndtri

from tests.experiments.blind.world import AXES, Effect, World

Draw = Callable[[np.random.Generator, World, str], dict[str, Any]]


@dataclass(frozen=True)
class Recipe:
    """How an effect is hidden."""

    draw: Draw  # parameters without the size
    size: str  # the parameter that is searched for
    guess: Callable[[World, str], float]  # a size to begin at, SI
    needs: str = ""  # of the sensor: "temperature", "lines", "shaking source" or the name of a term to leave out
    gyros_only: bool = False
    least: float = 0.0  # size below which nothing is tried
    fixed: Callable[[np.random.Generator, World, str, str], float | None] = lambda *_: None  # (…, axis, level)


def log_uniform(rng: np.random.Generator, lo: float, hi: float) -> float:
    """Each factor of ten alike."""
    return float(np.exp(rng.uniform(np.log(lo), np.log(hi))))


def uniform(rng: np.random.Generator, lo: float, hi: float) -> float:
    """A bare float, for model files."""
    return float(rng.uniform(lo, hi))


def sign(rng: np.random.Generator) -> float:
    """Either."""
    return float(rng.choice((-1.0, 1.0)))


def _nothing(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {}


def _noise(share: float) -> Callable[[World, str], float]:
    return lambda world, axis: share * world.noise(axis)


def _walk(world: World, axis: str) -> float:
    """What white noise and random walk differ by over the recording."""
    return world.noise(axis) / world.seconds


def _correlated(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"correlation_time": log_uniform(rng, 1.0, world.seconds / 80.0)}


def _line(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"frequency": log_uniform(rng, 0.3, 0.45 * world.rate_hz), "phase": uniform(rng, 0.0, 2.0 * np.pi)}


def _resonance(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"frequency": uniform(rng, 0.03, 0.42) * world.rate_hz, "bandwidth": log_uniform(rng, 0.2, 3.0)}


def _wandering(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {
        "frequency": uniform(rng, 0.03, 0.42) * world.rate_hz,
        "frequency_deviation": log_uniform(rng, 0.05, 0.5),
        "correlation_time": log_uniform(rng, 20.0, world.seconds / 10.0),
        "phase": uniform(rng, 0.0, 2.0 * np.pi),
    }


def _warmth(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"reference": 25.0}


def _late(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"reference": 25.0, "time_constant": log_uniform(rng, world.seconds / 60.0, world.seconds / 8.0)}


def _loop(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    temperature_c = world.clock().temperature_c
    assert temperature_c is not None
    return {"reversal": log_uniform(rng, 0.05, 0.4) * float(np.ptp(temperature_c))}


def _pulses(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    period = float(rng.choice((1.0, log_uniform(rng, 0.2, 20.0))))
    width = max(period * log_uniform(rng, 0.01, 0.3), 2.0 / world.rate_hz)
    return {"period": period, "width": width, "delay": uniform(rng, 0.0, 1.0) * period}


def _curve(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    # the slope alone must stay below the target, or no curvature is the smallest one that reaches the target
    return {"slope": 0.02 * uniform(rng, -1.0, 1.0) * world.noise(axis) / world.seconds}


def _breath(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"period": log_uniform(rng, 5.0, world.seconds / 6.0), "phase": uniform(rng, 0.0, 2.0 * np.pi)}


def _restless(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"correlation_time": log_uniform(rng, 200.0 / world.rate_hz, world.seconds / 20.0)}


def _transient(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"time_constant": log_uniform(rng, world.seconds / 60.0, world.seconds / 6.0)}


def _moment(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"time": uniform(rng, 0.15, 0.85) * world.seconds}


def _popcorn(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"dwell_time": log_uniform(rng, world.seconds / 300.0, world.seconds / 40.0)}


def _jumps(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"rate": uniform(rng, 12.0, 30.0) / world.seconds}


def _wild(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"fraction": log_uniform(rng, 3e-5, 1e-3)}


def _from_accelerometer(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    return {"source": str(rng.choice(AXES[3:]))}


def _from_neighbour(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    kind = AXES[:3] if axis in AXES[:3] else AXES[3:]
    return {"source": str(rng.choice([other for other in kind if other != axis]))}


def _low_pass(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    filtered = {"order": int(rng.integers(1, 4))}
    if rng.random() < 0.5:
        return filtered
    return {**filtered, "floor": log_uniform(rng, 0.05, 0.5) * world.term(axis, "angle_random_walk", "N")}


def _between_classics(rng: np.random.Generator, world: World, axis: str) -> dict[str, Any]:
    lo, hi = ((0.4, 0.7), (1.3, 1.7), (2.3, 2.6))[rng.integers(3)]
    return {"exponent": uniform(rng, lo, hi)}


def _by_level(plain: tuple[float, float], faint: tuple[float, float]) -> Callable[..., float]:
    def size(rng: np.random.Generator, world: World, axis: str, level: str) -> float:
        return log_uniform(rng, *(plain if level == "plain" else faint))

    return size


def _step(rng: np.random.Generator, world: World, axis: str, level: str) -> float:
    return world.noise(axis) * _by_level((0.5, 2.0), (0.05, 0.2))(rng, world, axis, level)


def _limit(rng: np.random.Generator, world: World, axis: str, level: str) -> float:
    share = _by_level((2e-3, 1e-2), (1e-4, 4e-4))(rng, world, axis, level)
    return abs(world.bias[axis]) - float(ndtri(share)) * world.noise(axis)


def _tails(rng: np.random.Generator, world: World, axis: str, level: str) -> float:
    return _by_level((4.0, 25.0), (60.0, 90.0))(rng, world, axis, level)


def _cutoff(rng: np.random.Generator, world: World, axis: str, level: str) -> float:
    return world.rate_hz * _by_level((0.1, 0.35), (0.42, 0.48))(rng, world, axis, level)


RECIPES: Final[Mapping[str, Recipe]] = {
    "quantization_noise": Recipe(
        _nothing, "Q", lambda world, axis: 0.1 * world.noise(axis) / world.rate_hz, "quantization_noise"
    ),
    "angle_random_walk": Recipe(
        _nothing, "N", lambda world, axis: 3e-5 if axis in AXES[:3] else 2e-4, "angle_random_walk"
    ),
    "bias_instability": Recipe(_nothing, "B", _noise(0.03), "bias_instability"),
    "rate_random_walk": Recipe(_nothing, "K", _noise(1e-3), "rate_random_walk"),
    "rate_ramp": Recipe(_nothing, "R", _walk),
    "exponentially_correlated": Recipe(_correlated, "sigma", _noise(0.05)),
    "sinusoidal": Recipe(_line, "amplitude", _noise(0.03)),
    "narrowband": Recipe(_resonance, "sigma", _noise(0.05)),
    "wandering_line": Recipe(_wandering, "amplitude", _noise(0.1)),
    "temperature_bias": Recipe(_warmth, "coefficient", _noise(0.05), "temperature"),
    "temperature_lag": Recipe(_late, "coefficient", _noise(0.05), "temperature"),
    "temperature_hysteresis": Recipe(_loop, "height", _noise(0.1), "temperature"),
    "turn_on_transient": Recipe(_transient, "amplitude", _noise(0.3)),
    "bias_step": Recipe(_moment, "height", _noise(0.1)),
    "bias_curve": Recipe(_curve, "curvature", lambda world, axis: world.noise(axis) / world.seconds**2),
    "random_telegraph": Recipe(_popcorn, "amplitude", _noise(0.1)),
    "poisson_steps": Recipe(_jumps, "height", _noise(0.1)),
    "outliers": Recipe(_wild, "scale", _noise(4.0)),
    "pulse_train": Recipe(_pulses, "height", _noise(0.1)),
    "noise_step": Recipe(_moment, "ratio", lambda world, axis: 0.02),
    "variance_modulation": Recipe(_breath, "depth", lambda world, axis: 0.02),
    "wandering_variance": Recipe(_restless, "deviation", lambda world, axis: 0.05),
    "heavy_tails": Recipe(_nothing, "nu", lambda world, axis: 10.0, fixed=_tails),
    "g_sensitivity": Recipe(
        _from_accelerometer, "coefficient", lambda world, axis: 1e-4, "shaking source", gyros_only=True
    ),
    "cross_axis": Recipe(_from_neighbour, "coefficient", lambda world, axis: 5e-3, "shaking source"),
    "power_law": Recipe(
        _between_classics, "density", lambda world, axis: 0.01 * world.noise(axis) / world.rate_hz**0.5
    ),
    "scale_factor": Recipe(_nothing, "factor", lambda world, axis: 0.2, least=0.1),
    "bandwidth_limit": Recipe(_low_pass, "cutoff", _noise(0.0), fixed=_cutoff),
    "sample_rate_error": Recipe(_nothing, "ratio", _noise(0.03), "lines"),
    "saturation": Recipe(_nothing, "limit", _noise(3.0), fixed=_limit),
    "resolution": Recipe(_nothing, "step", _noise(1.0), fixed=_step),
    "sample_hold": Recipe(_nothing, "fraction", lambda world, axis: 0.01, fixed=_by_level((5e-3, 3e-2), (2e-4, 1e-3))),
}

SIGNED: Final = ("coefficient", "amplitude", "height", "curvature")
UNSIGNED_AMPLITUDES: Final = ("sinusoidal", "wandering_line", "random_telegraph", "poisson_steps")


def sized(effect: Effect, size: float, sense: float) -> Effect:
    """The effect with a size, zero for none; ``sense`` is ±1 and used where a size has a sign."""
    parameter = RECIPES[effect.name].size
    if parameter in ("ratio", "factor"):
        value = (1.0 + size) ** sense
    elif parameter in SIGNED and effect.name not in UNSIGNED_AMPLITUDES:
        value = sense * size
    else:
        value = size
    return effect.sized(**{parameter: float(value)})


def scaled(effect: Effect, world: World, factor: float) -> Effect:
    """The effect at a multiple of its size; of a limit the clipped share, of a low-pass the band that is cut off."""
    parameter = RECIPES[effect.name].size
    value = float(effect.parameters[parameter])
    if parameter in ("ratio", "factor"):
        value = value**factor
    elif parameter == "cutoff":
        value = max(0.5 * world.rate_hz - factor * (0.5 * world.rate_hz - value), 0.02 * world.rate_hz)
    elif parameter == "nu":  # fewer degrees of freedom are heavier tails
        value = value / factor
    elif parameter == "limit":
        noise, bias = world.noise(effect.axis), abs(world.bias[effect.axis])
        value = bias - float(ndtri(factor * ndtr((bias - value) / noise))) * noise
    else:
        value = factor * value
    return effect.sized(**{parameter: value})
