"""Table of the effects that ``reconcile`` can find, and of how they differ in the fit and in the search."""

from typing import Final, Literal, NamedTuple


class EffectProperties(NamedTuple):
    """Properties of one effect in the fit and in the search."""

    penalty_nats: float
    diagnostic: str | None = None  # diagnostic that is most sensitive to the effect
    role: Literal["noise", "series", "other"] = "other"  # noise, a deterministic series, or another effect
    sizes: tuple[str, ...] = ()  # name of the size; for a series, then of further linear coefficients, possibly absent
    shapes: tuple[str, ...] = ()  # shape parameters that are reported with an interval
    identity: str = ""  # parameter that distinguishes two effects of the same name, such as a frequency
    tolerance: float = 0.0  # relative amount by which the interval of the identity is widened on both sides


EFFECT_PROPERTIES: Final = {
    "quantization_noise": EffectProperties(8.5, "psd", "noise", ("Q",)),
    "angle_random_walk": EffectProperties(8.5, "psd", "noise", ("N",)),
    "bias_instability": EffectProperties(8.5, "psd", "noise", ("B",)),
    "rate_random_walk": EffectProperties(8.5, "psd", "noise", ("K",)),
    "rate_ramp": EffectProperties(8.5, "level", "series", ("R",)),
    "exponentially_correlated": EffectProperties(
        10.0, "psd", "noise", ("sigma",), ("correlation_time",), "correlation_time", 1 / 3
    ),
    "sinusoidal": EffectProperties(23.0, "lines", "series", ("amplitude",), ("frequency",), "frequency", 0.005),
    "narrowband": EffectProperties(
        14.5 + 2.0, "psd", "noise", ("sigma",), ("frequency", "bandwidth"), "frequency", 0.05
    ),
    "wandering_line": EffectProperties(14.5 + 2.0 + 2.0, "psd", identity="frequency", tolerance=0.05),
    "common_vibration": EffectProperties(
        9.5 + 3.5, "other_axes", "noise", ("gain",), identity="source_number", tolerance=0.0
    ),
    "temperature_bias": EffectProperties(9.0, "temperature", "series", ("coefficient", "quadratic", "cubic")),
    "temperature_lag": EffectProperties(
        10.0, "temperature", "series", ("coefficient",), ("time_constant",), "time_constant", 1 / 3
    ),
    "turn_on_transient": EffectProperties(
        10.0, "level", "series", ("amplitude",), ("time_constant",), "time_constant", 1 / 3
    ),
    "bias_step": EffectProperties(15.0, "level", "series", ("height",), ("time",), "time", 0.01),
    "g_sensitivity": EffectProperties(9.5, "other_axes", "series", ("coefficient",), identity="source", tolerance=0.0),
    "cross_axis": EffectProperties(9.5, "other_axes", "series", ("coefficient",), identity="source", tolerance=0.0),
    "scale_factor": EffectProperties(8.5, "psd", shapes=("factor",)),
    "bandwidth_limit": EffectProperties(9.5 + 3.0, "psd", "noise", ("floor",), ("cutoff",), "cutoff", 0.1),
    "sample_hold": EffectProperties(12.0, "values"),
    "resolution": EffectProperties(12.0, "values"),
    "saturation": EffectProperties(12.0, "values"),
    "outliers": EffectProperties(14.0, "tails"),
    "heavy_tails": EffectProperties(13.0, "tails"),
    "noise_step": EffectProperties(14.5, "variance", identity="time", tolerance=0.01),
    "random_telegraph": EffectProperties(
        9.5 + 2.0, role="noise", sizes=("amplitude",), identity="dwell_time", tolerance=1 / 3
    ),
    "poisson_steps": EffectProperties(8.5 + 1.5, role="noise", sizes=("height",)),
    "temperature_hysteresis": EffectProperties(
        9.5 + 4.0, "temperature", "series", ("height",), ("reversal",), "reversal", 1 / 3
    ),
    "pulse_train": EffectProperties(23.0 + 7.0, "lines", "series", ("height",), identity="period", tolerance=0.005),
    "bias_curve": EffectProperties(9.5, "level", "series", ("slope", "curvature", "logarithmic"), ("time_constant",)),
    "variance_modulation": EffectProperties(18.0, "variance", identity="period", tolerance=0.05),
    "wandering_variance": EffectProperties(11.0, "variance"),
    "power_law": EffectProperties(9.5 + 2.0, "psd", "noise", ("density",), ("exponent",), "exponent", 0.1),
}
"""Properties of each effect, by name.

A low-pass filter is a noise effect if the parameter ``floor`` is present, even if the floor is 0. An effect without an
identity occurs at most once on an axis.

On an axis without the effect, the log-likelihood gain exceeds the penalty with a probability of about 4e-5. With six
axes and twenty effects, a wrong effect is then found in about one of 200 recordings for which the model is true. The
penalties come from simulations with a true model. For one fitted size without a location, the penalty is close to the
quantile of χ²₁/2.
"""
PENALTY_NATS: Final = {name: row.penalty_nats for name, row in EFFECT_PROPERTIES.items()}
"""Penalty of each effect in nats."""
MOST_DIRECT_DIAGNOSTIC: Final = {name: row.diagnostic for name, row in EFFECT_PROPERTIES.items() if row.diagnostic}
"""Diagnostic that is most sensitive to each effect."""
NOISE_SIZE_PARAMETERS: Final = {name: row.sizes[0] for name, row in EFFECT_PROPERTIES.items() if row.role == "noise"}
"""For each noise effect, the name of the size parameter."""
SERIES_SIZE_PARAMETERS: Final = {name: row.sizes[0] for name, row in EFFECT_PROPERTIES.items() if row.role == "series"}
"""For each deterministic effect, the name of the size parameter."""
SIZE_PARAMETERS: Final = NOISE_SIZE_PARAMETERS | SERIES_SIZE_PARAMETERS
"""For each effect with a size, the name of the size parameter."""
ONE_TIME_EFFECTS: Final = ("bias_step", "noise_step", "turn_on_transient", "bias_curve")
"""Names of the effects that happen at most once in a recording."""
