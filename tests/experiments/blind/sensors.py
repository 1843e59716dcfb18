"""Random sensors of the blind trials, and the properties that a sensor needs so that an effect can be identified.

The sizes of the terms are similar to those of a small MEMS IMU. Some axes have quantization noise, and some have ten
times the random walk. One axis measures gravity, and all axes have a small bias. Every third sensor has a thermometer.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from tests.experiments.blind.recipes import log_uniform, sign, uniform
from tests.experiments.blind.world import AXES, Effect, TemperatureProfile, World

PERTURBED_TERMS: Final = ("angle_random_walk", "bias_instability", "rate_random_walk")
BASELINE_ERROR: Final = 0.05  # relative error of N, B and K in the baseline "off"


def draw_sensor(rng: np.random.Generator, seconds: float, rate: float, axes: tuple[str, ...]) -> World:
    """Draw a sensor without hidden effects."""
    baseline: list[Effect] = []
    bias = {}
    for axis in axes:
        gyro = axis in AXES[:3]
        N, B, K, Q = (1.5e-4, 4e-5, 2e-6, 2e-6) if gyro else (1e-3, 3e-4, 2e-5, 1e-5)
        noise_factor = log_uniform(rng, 0.6, 1.6)
        walk_factor = 10.0 if rng.random() < 0.15 else 1.0
        baseline += [
            Effect(axis, "angle_random_walk", {"N": N * noise_factor}),
            Effect(axis, "bias_instability", {"B": B * noise_factor * log_uniform(rng, 0.6, 1.6)}),
            Effect(axis, "rate_random_walk", {"K": K * noise_factor * walk_factor * log_uniform(rng, 0.6, 1.6)}),
        ]
        if rng.random() < 0.3:
            baseline.append(Effect(axis, "quantization_noise", {"Q": Q * noise_factor}))
        bias[axis] = uniform(rng, -5e-3, 5e-3) if gyro else uniform(rng, -0.1, 0.1) + (9.81 if axis == "az" else 0.0)
    profile = draw_temperature_profile(rng, seconds) if rng.random() < 0.3 else None
    return World(int(rng.integers(2**32)), seconds, rate, axes, tuple(baseline), bias, temperature_profile=profile)


def draw_temperature_profile(rng: np.random.Generator, seconds: float) -> TemperatureProfile:
    """Draw a temperature profile with a warm-up or a large sine, and with correlated noise."""
    warms_up = rng.random() < 0.5
    return TemperatureProfile(
        warm_up_c=uniform(rng, 3.0, 8.0) if warms_up else 0.0,
        warm_up_time_s=log_uniform(rng, seconds / 12.0, seconds / 4.0),
        swing_c=uniform(rng, 0.2, 0.6) if warms_up else uniform(rng, 1.0, 3.0),
        period_s=log_uniform(rng, seconds / 8.0, seconds / 2.0),
        wander_c=uniform(rng, 0.2, 0.5),
        wander_time_s=log_uniform(rng, seconds / 30.0, seconds / 8.0),
    )


def perturb_baseline(baseline: tuple[Effect, ...], rng: np.random.Generator) -> tuple[Effect, ...]:
    """Return a baseline in which each N, B and K is randomly too large or too small."""
    perturbed = []
    for effect in baseline:
        if effect.name in PERTURBED_TERMS:
            effect = effect.sized(**{k: v * (1.0 + sign(rng) * BASELINE_ERROR) for k, v in effect.parameters.items()})
        perturbed.append(effect)
    return tuple(perturbed)


def with_temperature(world: World, rng: np.random.Generator) -> World:
    """Return the sensor with a recorded temperature."""
    return (
        world
        if world.temperature_profile is not None
        else replace(world, temperature_profile=draw_temperature_profile(rng, world.seconds))
    )


def with_lines(world: World, rng: np.random.Generator) -> World:
    """Return the sensor with a vibration on three axes, which the model contains and a clock error shifts."""
    axes = [str(axis) for axis in rng.permutation(world.axes)[:3]]
    frequency = uniform(rng, 0.08, 0.2) * world.rate_hz
    lines = []
    for axis, harmonic in zip(axes, (1, 2, 1), strict=False):
        phase = uniform(rng, 0.0, 2.0 * np.pi)
        amplitude = world.noise(axis)  # replaced later by levels.set_line_amplitudes
        shape = {"amplitude": amplitude, "frequency": frequency * harmonic, "phase": phase}
        lines.append(Effect(axis, "sinusoidal", shape))
    return replace(world, baseline=(*world.baseline, *lines))


def without_term(world: World, axis: str, term: str) -> World:
    """Return the sensor without a term of the baseline, because this term will be hidden."""
    terms = [one for one in world.baseline if (one.axis, one.name) != (axis, term)]
    if term == "angle_random_walk":  # the axis needs noise at high frequencies, which is strong quantization noise
        terms = [one for one in terms if (one.axis, one.name) != (axis, "quantization_noise")]
        terms.append(Effect(axis, "quantization_noise", {"Q": 2e-5 if axis in AXES[:3] else 1.4e-4}))
    return replace(world, baseline=tuple(terms))


def with_vibration(world: World, rng: np.random.Generator, axis: str) -> World:
    """Return the sensor with a vibration on one axis, which the model contains, so that a leak has a direction."""
    shape = {
        "sigma": 3.0 * world.noise(axis),
        "frequency": uniform(rng, 0.1, 0.4) * world.rate_hz,
        "bandwidth": log_uniform(rng, 1.0, 5.0),
    }
    return replace(world, baseline=(*world.baseline, Effect(axis, "narrowband", shape)))
