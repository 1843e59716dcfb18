"""Effects of a noise model. Each effect has its own module, and the module name is the name in model files."""

from typing import Final

from monitor.noise.effect import Effect, Transform
from monitor.noise.effects.biases.bias import ConstantBias as ConstantBias
from monitor.noise.effects.biases.bias_curve import BiasCurve as BiasCurve
from monitor.noise.effects.biases.bias_step import BiasStep as BiasStep
from monitor.noise.effects.biases.temperature_bias import TemperatureBias as TemperatureBias
from monitor.noise.effects.biases.temperature_hysteresis import TemperatureHysteresis as TemperatureHysteresis
from monitor.noise.effects.biases.temperature_lag import TemperatureLag as TemperatureLag
from monitor.noise.effects.biases.turn_on_transient import TurnOnTransient as TurnOnTransient
from monitor.noise.effects.coupling.axis_permutation import AxisPermutation as AxisPermutation
from monitor.noise.effects.coupling.cross_axis import CrossAxis as CrossAxis
from monitor.noise.effects.coupling.g_sensitivity import GSensitivity as GSensitivity
from monitor.noise.effects.disturbances.common_vibration import CommonVibration as CommonVibration
from monitor.noise.effects.disturbances.heavy_tails import HeavyTails as HeavyTails
from monitor.noise.effects.disturbances.narrowband import Narrowband as Narrowband
from monitor.noise.effects.disturbances.noise_step import NoiseStep as NoiseStep
from monitor.noise.effects.disturbances.outliers import Outliers as Outliers
from monitor.noise.effects.disturbances.poisson_steps import PoissonSteps as PoissonSteps
from monitor.noise.effects.disturbances.power_law import PowerLaw as PowerLaw
from monitor.noise.effects.disturbances.pulse_train import PulseTrain as PulseTrain
from monitor.noise.effects.disturbances.random_telegraph import RandomTelegraph as RandomTelegraph
from monitor.noise.effects.disturbances.variance_modulation import VarianceModulation as VarianceModulation
from monitor.noise.effects.disturbances.wandering_line import WanderingLine as WanderingLine
from monitor.noise.effects.disturbances.wandering_variance import WanderingVariance as WanderingVariance
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk as AngleRandomWalk
from monitor.noise.effects.ieee952.bias_instability import BiasInstability as BiasInstability
from monitor.noise.effects.ieee952.exponentially_correlated import ExponentiallyCorrelated as ExponentiallyCorrelated
from monitor.noise.effects.ieee952.quantization_noise import QuantizationNoise as QuantizationNoise
from monitor.noise.effects.ieee952.rate_ramp import RateRamp as RateRamp
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk as RateRandomWalk
from monitor.noise.effects.ieee952.sinusoidal import Sinusoidal as Sinusoidal
from monitor.noise.effects.signal_chain.bandwidth_limit import BandwidthLimit as BandwidthLimit
from monitor.noise.effects.signal_chain.resolution import Resolution as Resolution
from monitor.noise.effects.signal_chain.sample_hold import RandomSampleHold as RandomSampleHold
from monitor.noise.effects.signal_chain.sample_rate_error import SampleRateError as SampleRateError
from monitor.noise.effects.signal_chain.saturation import Saturation as Saturation
from monitor.noise.effects.signal_chain.scale_factor import ScaleFactor as ScaleFactor
from monitor.noise.effects.signal_chain.unit_error import UnitError as UnitError

TRANSFORM_ORDER: Final[tuple[type[Transform], ...]] = (
    BandwidthLimit,
    ScaleFactor,
    SampleRateError,
    Saturation,
    Resolution,
    RandomSampleHold,
    UnitError,
)
"""Order in which transforms are applied.

Transforms of the same kind are applied in the order of the model.
"""

EFFECTS: Final[dict[str, type[Effect]]] = {
    kind.name: kind
    for kind in tuple(vars().values())
    if isinstance(kind, type) and issubclass(kind, Effect) and kind not in (Effect, Transform)
}
"""Class of each effect, by its name in model files."""
