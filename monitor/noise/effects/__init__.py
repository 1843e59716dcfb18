"""One effect a file; ``EFFECTS`` lists them by the name that model files use."""

from typing import Final

from monitor.noise.effect import Source
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.bias import Bias
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.quantization_noise import QuantizationNoise
from monitor.noise.effects.rate_ramp import RateRamp
from monitor.noise.effects.rate_random_walk import RateRandomWalk

EFFECTS: Final[dict[str, type[Source]]] = {
    effect.name: effect
    for effect in (
        Bias,
        QuantizationNoise,
        AngleRandomWalk,
        BiasInstability,
        RateRandomWalk,
        RateRamp,
    )
}
