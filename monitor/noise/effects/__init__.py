"""Effects of a noise model, one per file.

``EFFECTS`` lists them by their name in model files. ``TRANSFORM_ORDER`` is the order in which transforms act.
"""

from typing import Final

from monitor.noise.effect import Effect, Transform
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.bandwidth_limit import BandwidthLimit
from monitor.noise.effects.bias import Bias
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.bias_step import BiasStep
from monitor.noise.effects.cross_axis import CrossAxis
from monitor.noise.effects.exponentially_correlated import ExponentiallyCorrelated
from monitor.noise.effects.g_sensitivity import GSensitivity
from monitor.noise.effects.narrowband import Narrowband
from monitor.noise.effects.noise_step import NoiseStep
from monitor.noise.effects.outliers import Outliers
from monitor.noise.effects.poisson_steps import PoissonSteps
from monitor.noise.effects.quantization_noise import QuantizationNoise
from monitor.noise.effects.random_telegraph import RandomTelegraph
from monitor.noise.effects.rate_ramp import RateRamp
from monitor.noise.effects.rate_random_walk import RateRandomWalk
from monitor.noise.effects.resolution import Resolution
from monitor.noise.effects.sample_hold import SampleHold
from monitor.noise.effects.sample_rate_error import SampleRateError
from monitor.noise.effects.saturation import Saturation
from monitor.noise.effects.scale_factor import ScaleFactor
from monitor.noise.effects.sinusoidal import Sinusoidal
from monitor.noise.effects.temperature_bias import TemperatureBias
from monitor.noise.effects.temperature_lag import TemperatureLag
from monitor.noise.effects.turn_on_transient import TurnOnTransient

TRANSFORM_ORDER: Final[tuple[type[Transform], ...]] = (
    ScaleFactor,
    BandwidthLimit,
    SampleRateError,
    Saturation,
    Resolution,
    SampleHold,
)
"""Order in which transforms act, whatever their order in the model. Two transforms of one kind act in the order of the
model."""

_ALL: Final[tuple[type[Effect], ...]] = (
    Bias,
    QuantizationNoise,
    AngleRandomWalk,
    BiasInstability,
    RateRandomWalk,
    RateRamp,
    ExponentiallyCorrelated,
    Sinusoidal,
    Narrowband,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
    BiasStep,
    RandomTelegraph,
    PoissonSteps,
    Outliers,
    NoiseStep,
    GSensitivity,
    CrossAxis,
    *TRANSFORM_ORDER,
)
EFFECTS: Final[dict[str, type[Effect]]] = {effect.name: effect for effect in _ALL}
"""Name of an effect in model files -> its class."""

__all__ = [
    "EFFECTS",
    "TRANSFORM_ORDER",
    "AngleRandomWalk",
    "BandwidthLimit",
    "Bias",
    "BiasInstability",
    "BiasStep",
    "CrossAxis",
    "ExponentiallyCorrelated",
    "GSensitivity",
    "Narrowband",
    "NoiseStep",
    "Outliers",
    "PoissonSteps",
    "QuantizationNoise",
    "RandomTelegraph",
    "RateRamp",
    "RateRandomWalk",
    "Resolution",
    "SampleHold",
    "SampleRateError",
    "Saturation",
    "ScaleFactor",
    "Sinusoidal",
    "TemperatureBias",
    "TemperatureLag",
    "TurnOnTransient",
]
