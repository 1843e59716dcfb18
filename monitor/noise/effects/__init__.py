"""Effects of a noise model, one per file. An effect has the name of its file, in model files too."""

from typing import Final

from monitor.noise.effect import Effect, Transform
from monitor.noise.effects.angle_random_walk import AngleRandomWalk as AngleRandomWalk
from monitor.noise.effects.bandwidth_limit import BandwidthLimit as BandwidthLimit
from monitor.noise.effects.bias import Bias as Bias
from monitor.noise.effects.bias_instability import BiasInstability as BiasInstability
from monitor.noise.effects.bias_step import BiasStep as BiasStep
from monitor.noise.effects.cross_axis import CrossAxis as CrossAxis
from monitor.noise.effects.exponentially_correlated import ExponentiallyCorrelated as ExponentiallyCorrelated
from monitor.noise.effects.g_sensitivity import GSensitivity as GSensitivity
from monitor.noise.effects.narrowband import Narrowband as Narrowband
from monitor.noise.effects.noise_step import NoiseStep as NoiseStep
from monitor.noise.effects.outliers import Outliers as Outliers
from monitor.noise.effects.poisson_steps import PoissonSteps as PoissonSteps
from monitor.noise.effects.quantization_noise import QuantizationNoise as QuantizationNoise
from monitor.noise.effects.random_telegraph import RandomTelegraph as RandomTelegraph
from monitor.noise.effects.rate_ramp import RateRamp as RateRamp
from monitor.noise.effects.rate_random_walk import RateRandomWalk as RateRandomWalk
from monitor.noise.effects.resolution import Resolution as Resolution
from monitor.noise.effects.sample_hold import SampleHold as SampleHold
from monitor.noise.effects.sample_rate_error import SampleRateError as SampleRateError
from monitor.noise.effects.saturation import Saturation as Saturation
from monitor.noise.effects.scale_factor import ScaleFactor as ScaleFactor
from monitor.noise.effects.sinusoidal import Sinusoidal as Sinusoidal
from monitor.noise.effects.temperature_bias import TemperatureBias as TemperatureBias
from monitor.noise.effects.temperature_lag import TemperatureLag as TemperatureLag
from monitor.noise.effects.turn_on_transient import TurnOnTransient as TurnOnTransient

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
