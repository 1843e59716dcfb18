"""Model and simulated recordings for the tests of the recording checks."""

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.noise.effects import AngleRandomWalk, BiasInstability, ConstantBias, Narrowband, Resolution
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import RecordedAxes

RATE_HZ = 100.0
SAMPLES = 16_000
GRAVITY = (0.3, -0.2, 9.8)
"""Mean specific force of the axes, m/s²."""


def make_model(gravity: bool = False, step: float = 0.0) -> NoiseModel:
    """Return a model of six axes with different noise and one resonance each."""
    effects = {}
    for k, axis in enumerate(AXES):
        scale = (1e-4 if k < 3 else 1e-3) * (1.0, 1.5, 2.5)[k % 3]
        of = [
            AngleRandomWalk(N=scale),
            BiasInstability(B=0.3 * scale),
            Narrowband(sigma=5.0 * scale, frequency=(11.3, 17.9, 23.1)[k % 3], bandwidth=0.3),
        ]
        if gravity and k >= 3:
            of.append(ConstantBias(value=GRAVITY[k - 3]))
        if step:
            of.append(Resolution(step=step * scale))
        effects[axis] = tuple(of)
    return NoiseModel(effects, RATE_HZ)


def draw(model: NoiseModel, seed: int, samples: int = SAMPLES) -> RecordedAxes:
    """Simulate a recording of six axes."""
    drawn = model.simulate(samples, RATE_HZ, seed)
    return RecordedAxes({axis: np.ascontiguousarray(drawn[:, k]) for k, axis in enumerate(AXES)}, RATE_HZ)


def changed(recording: RecordedAxes, **values: Floats) -> RecordedAxes:
    """Return the recording with other values on some axes."""
    return RecordedAxes({**recording.values, **values}, recording.rate_hz, recording.temperature_c)
