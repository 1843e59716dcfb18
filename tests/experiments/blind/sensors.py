"""Sensors, drawn anew for each case, and what an effect needs of one to be identifiable at all.

Sizes of the terms lie about those of a small MEMS IMU; some axes have quantization noise, some ten times the random
walk; gravity stands on one axis, small biases on all; every third sensor has a thermometer that nothing need follow.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from tests.experiments.blind.recipes import log_uniform, sign, uniform
from tests.experiments.blind.world import AXES, Climate, Effect, World

SMALL: Final = ("angle_random_walk", "bias_instability", "rate_random_walk")
OFF: Final = 0.05  # how far N, B and K are off in an "off" baseline


def sensor(rng: np.random.Generator, seconds: float, rate: float, axes: tuple[str, ...]) -> World:
    """Six axes, or fewer, with their noise; nothing hidden."""
    baseline: list[Effect] = []
    bias = {}
    for axis in axes:
        gyro = axis in AXES[:3]
        N, B, K, Q = (1.5e-4, 4e-5, 2e-6, 2e-6) if gyro else (1e-3, 3e-4, 2e-5, 1e-5)
        many = log_uniform(rng, 0.6, 1.6)
        walks = 10.0 if rng.random() < 0.15 else 1.0
        baseline += [
            Effect(axis, "angle_random_walk", {"N": N * many}),
            Effect(axis, "bias_instability", {"B": B * many * log_uniform(rng, 0.6, 1.6)}),
            Effect(axis, "rate_random_walk", {"K": K * many * walks * log_uniform(rng, 0.6, 1.6)}),
        ]
        if rng.random() < 0.3:
            baseline.append(Effect(axis, "quantization_noise", {"Q": Q * many}))
        bias[axis] = uniform(rng, -5e-3, 5e-3) if gyro else uniform(rng, -0.1, 0.1) + (9.81 if axis == "az" else 0.0)
    weather = climate(rng, seconds) if rng.random() < 0.3 else None
    return World(int(rng.integers(2**32)), seconds, rate, axes, tuple(baseline), bias, climate=weather)


def climate(rng: np.random.Generator, seconds: float) -> Climate:
    """One that warms up, or one that swings; both wander."""
    warms = rng.random() < 0.5
    return Climate(
        warm_c=uniform(rng, 3.0, 8.0) if warms else 0.0,
        warm_time_s=log_uniform(rng, seconds / 12.0, seconds / 4.0),
        swing_c=uniform(rng, 0.2, 0.6) if warms else uniform(rng, 1.0, 3.0),
        period_s=log_uniform(rng, seconds / 8.0, seconds / 2.0),
        wander_c=uniform(rng, 0.2, 0.5),
        wander_time_s=log_uniform(rng, seconds / 30.0, seconds / 8.0),
    )


def off(baseline: tuple[Effect, ...], rng: np.random.Generator) -> tuple[Effect, ...]:
    """N, B and K each too large or too small, at random."""
    told = []
    for effect in baseline:
        if effect.name in SMALL:
            effect = effect.sized(**{k: v * (1.0 + sign(rng) * OFF) for k, v in effect.parameters.items()})
        told.append(effect)
    return tuple(told)


def with_temperature(world: World, rng: np.random.Generator) -> World:
    """A recorded temperature, where there is none."""
    return world if world.climate is not None else replace(world, climate=climate(rng, world.seconds))


def with_lines(world: World, rng: np.random.Generator) -> World:
    """A vibration that the model knows, felt on three axes: a clock error displaces all of it."""
    felt = [str(axis) for axis in rng.permutation(world.axes)[:3]]
    frequency = uniform(rng, 0.08, 0.2) * world.rate_hz
    lines = []
    for axis, harmonic in zip(felt, (1, 2, 1), strict=False):
        phase = uniform(rng, 0.0, 2.0 * np.pi)
        amplitude = world.noise(axis)  # until levels.size_lines sets it
        shape = {"amplitude": amplitude, "frequency": frequency * harmonic, "phase": phase}
        lines.append(Effect(axis, "sinusoidal", shape))
    return replace(world, baseline=(*world.baseline, *lines))


def without_term(world: World, axis: str, term: str) -> World:
    """The sensor's own term is what will be hidden, so the baseline has none there."""
    kept = [one for one in world.baseline if (one.axis, one.name) != (axis, term)]
    if term == "angle_random_walk":  # something must remain at high frequencies: much quantization noise
        kept = [one for one in kept if (one.axis, one.name) != (axis, "quantization_noise")]
        kept.append(Effect(axis, "quantization_noise", {"Q": 2e-5 if axis in AXES[:3] else 1.4e-4}))
    return replace(world, baseline=tuple(kept))


def with_shaking(world: World, rng: np.random.Generator, axis: str) -> World:
    """An axis that shakes by itself, as its model says: so what leaks from it has a direction."""
    shape = {
        "sigma": 3.0 * world.noise(axis),
        "frequency": uniform(rng, 0.1, 0.4) * world.rate_hz,
        "bandwidth": log_uniform(rng, 1.0, 5.0),
    }
    return replace(world, baseline=(*world.baseline, Effect(axis, "narrowband", shape)))
