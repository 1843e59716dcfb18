"""Check for a wrong unit or a wrong full scale of the three axes of a triad.

A unit error multiplies the values of all three axes by one of a few known factors. The factor is estimated from the
noise of the three axes relative to the model. Accelerometers at rest also measure gravity, which confirms or excludes
a factor. If the model contains quantization steps, the steps of the recording do the same. A common factor that is not
near a known factor is not reported.

Without a model, only gravity is tested.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import Z95
from monitor.noise.effects import ConstantBias, Resolution
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.axis_permutation import TriadOrder
from monitor.reconcile.result import ParameterInterval, RecordingFinding

GRAVITY: Final = 9.80665
"""Standard gravity, m/s² (CGPM 1901)."""
CONVERSIONS: Final = {
    "π/180": np.pi / 180.0,
    "180/π": 180.0 / np.pi,
    "9.80665": GRAVITY,
    "1/9.80665": 1.0 / GRAVITY,
    "1000": 1000.0,
    "1/1000": 0.001,
    "1000·180/π": 180_000.0 / np.pi,
    "1000/9.80665": 1000.0 / GRAVITY,
}
"""Factors of wrong unit conversions, by name."""
FULL_SCALES: Final = {**{f"{2**k}": 2.0**k for k in range(1, 5)}, **{f"1/{2**k}": 2.0**-k for k in range(1, 5)}}
"""Factors of a wrong full scale, by name."""
GYRO_CONVERSIONS: Final = ("π/180", "180/π", "1000", "1/1000", "1000·180/π")
"""Likely conversion errors of gyroscopes."""
ACCELEROMETER_CONVERSIONS: Final = ("9.80665", "1/9.80665", "1000", "1/1000", "1000/9.80665")
"""Likely conversion errors of accelerometers."""
FACTORS_FROM_GRAVITY_ALONE: Final = ("1/9.80665", "1000/9.80665", "1000", "2", "1/2", "4", "1/4")
"""Factors that are detected from gravity without a model."""
UNLIKELY_PENALTY: Final = 0.15
"""Penalty for an unlikely factor, added to the logarithmic distance."""
MAX_DISTANCE: Final = log(1.35)
"""Largest logarithmic distance between the common factor and a conversion factor. Noise varies from run to run."""
MAX_SPREAD: Final = log(1.8)
"""Largest logarithm of the ratio between the factors of two axes."""
MAX_FULL_SCALE_DISTANCE: Final = log(1.12)
"""Largest logarithmic distance between the common factor and a power of two.

Vibration of the surroundings may also double the noise.
"""
MAX_FULL_SCALE_SPREAD: Final = log(1.12)
"""Largest logarithm of the ratio between the factors of two axes at which a wrong full scale is reported."""
MAX_SUPPORTED_DISTANCE: Final = log(1.8)
"""Largest logarithmic distance between the common factor and the factor found from gravity or quantization steps."""
MAX_GRAVITY_DISTANCE: Final = log(1.12)
"""Largest logarithmic distance between the measured gravity ratio and a known factor.

The errors of the bias and scale factor of a MEMS accelerometer may reach 10 %.
"""
GRID_SAMPLES: Final = 4096
"""Number of samples that are compared with the quantization steps."""
GRID_TOLERANCE: Final = 0.05
"""Largest distance of a value from a quantization level, in steps."""
MIN_LEVELS: Final = 3
"""Smallest number of different quantization levels."""
MIN_GRAVITY_M_S2: Final = 0.5
"""Smallest norm of the mean specific force, in m/s², that is regarded as gravity."""


@dataclass(frozen=True, slots=True)
class TriadEvidence:
    """Ratios of the recording to the model for one triad. An unknown ratio is None."""

    noise: TriadOrder | None
    gravity: float | None  # norm of the mean specific force relative to the expected norm
    step: float | None  # quantization step relative to the model; None if the axes do not agree


def collect_triad_evidence(
    values: Mapping[str, Floats], triad: Sequence[str], model: NoiseModel | None, order: TriadOrder | None
) -> TriadEvidence:
    """Collect the evidence for a unit error of one triad.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of the axes in the order of the model.
    triad : sequence of str
        Names of the three axes.
    model : NoiseModel or None
        Model under test.
    order : TriadOrder or None
        Noise of the axes relative to the model.
    """
    steps = [] if model is None else [_step_ratio(values[axis], axis, model) for axis in triad]
    known = {one for one in steps if one is not None}
    return TriadEvidence(order, _gravity_ratio(values, triad, model), known.pop() if len(known) == 1 else None)


def find_unit_error(triad: Sequence[str], evidence: TriadEvidence) -> tuple[float, RecordingFinding] | None:
    """Find a unit error, and return the factor with the finding, or None.

    Parameters
    ----------
    triad : sequence of str
        Names of the three axes.
    evidence : TriadEvidence
        Ratios of the recording to the model.
    """
    name = _factor_from_gravity(triad, evidence) if evidence.noise is None else _factor_from_noise(triad, evidence)
    if name is None or (evidence.noise is None and name not in FACTORS_FROM_GRAVITY_ALONE):
        return None
    factor = {**CONVERSIONS, **FULL_SCALES}[name]
    found = _measured_factor(evidence, name)
    what = "full-scale error" if name in FULL_SCALES else "unit error"
    seen = "gravity" if evidence.noise is None else "noise"
    return factor, RecordingFinding(
        "unit_error",
        tuple(triad),
        f"The {seen} of {', '.join(triad[:2])} and {triad[2]} is {found.value:.5g} times the expected {seen}. "
        f"The nearest {what} is {name} = {factor:.5g}. The values were divided by {factor:.5g}.",
        {"factor": found},
        _evidence_by_name(evidence, factor),
        corrected=True,
    )


def _factor_from_gravity(triad: Sequence[str], evidence: TriadEvidence) -> str | None:
    if evidence.gravity is None or abs(log(evidence.gravity)) < MAX_GRAVITY_DISTANCE:
        return None
    factors = {**{k: CONVERSIONS[k] for k in ACCELEROMETER_CONVERSIONS}, **FULL_SCALES}
    name, distance = _find_nearest_factor(log(evidence.gravity), factors, triad)
    return name if distance < MAX_GRAVITY_DISTANCE else None


def _factor_from_noise(triad: Sequence[str], evidence: TriadEvidence) -> str | None:
    """Return the factor of the noise, or None if gravity or the quantization steps contradict the factor."""
    assert evidence.noise is not None
    common, spread = float(np.median(evidence.noise.log_ratios)), float(np.ptp(evidence.noise.log_ratios))
    confirmed = _factor_from_steps(evidence) or _factor_from_gravity(triad, evidence)
    if confirmed is not None and spread < MAX_SPREAD:
        # The noise of the model may be wrong, so the noise ratio only has to be closer to the factor than to 1.
        factor = log({**CONVERSIONS, **FULL_SCALES}[confirmed])
        if abs(common - factor) < min(abs(common), MAX_SUPPORTED_DISTANCE):
            return confirmed
    if evidence.gravity is not None and abs(log(evidence.gravity)) < MAX_GRAVITY_DISTANCE:
        return None  # The unit is right, and only the noise differs.
    name, distance = _find_nearest_factor(common, CONVERSIONS, triad)
    scale, scale_distance = _find_nearest_factor(common, FULL_SCALES, triad)
    if scale_distance < min(MAX_FULL_SCALE_DISTANCE, distance) and spread < MAX_FULL_SCALE_SPREAD:
        return scale
    return name if distance < MAX_DISTANCE and spread < MAX_SPREAD else None


def _factor_from_steps(evidence: TriadEvidence) -> str | None:
    return next((name for name, f in {**CONVERSIONS, **FULL_SCALES}.items() if f == evidence.step), None)


def _find_nearest_factor(x: float, factors: Mapping[str, float], triad: Sequence[str]) -> tuple[str, float]:
    """Return the name of the factor nearest to exp(x), and the logarithmic distance."""
    likely = (*(GYRO_CONVERSIONS if triad[0].startswith("g") else ACCELEROMETER_CONVERSIONS), *FULL_SCALES)
    name = min(factors, key=lambda k: abs(x - log(factors[k])) + UNLIKELY_PENALTY * (k not in likely))
    return name, abs(x - log(factors[name]))


def _measured_factor(evidence: TriadEvidence, name: str) -> ParameterInterval:
    if evidence.noise is None:
        assert evidence.gravity is not None
        error = 0.5 * MAX_GRAVITY_DISTANCE
        return ParameterInterval(evidence.gravity, evidence.gravity * exp(-error), evidence.gravity * exp(error))
    x, error = float(np.median(evidence.noise.log_ratios)), Z95 * evidence.noise.error
    return ParameterInterval(exp(x), exp(x - error), exp(x + error))


def _evidence_by_name(evidence: TriadEvidence, factor: float) -> dict[str, float]:
    found: dict[str, float] = {"nearest_factor": factor}
    if evidence.noise is not None:
        found["noise_ratio"] = exp(float(np.median(evidence.noise.log_ratios)))
        found["largest_ratio_of_axes"] = exp(float(np.ptp(evidence.noise.log_ratios)))
    if evidence.gravity is not None:
        found["gravity_ratio"] = evidence.gravity
    if evidence.step is not None:
        found["step_ratio"] = evidence.step
    return found


def _gravity_ratio(values: Mapping[str, Floats], triad: Sequence[str], model: NoiseModel | None) -> float | None:
    """Return the norm of the mean specific force relative to gravity, or None if the axes do not measure gravity."""
    if triad[0].startswith("g"):
        return None
    means = [float(np.nanmedian(values[axis])) if np.isfinite(values[axis]).any() else np.nan for axis in triad]
    norm = float(np.linalg.norm(means))
    if not norm > MIN_GRAVITY_M_S2:
        return None
    biases = (
        []
        if model is None
        else [e.value for a in triad for e in model.effects.get(a, ()) if isinstance(e, ConstantBias)]
    )
    expected = float(np.linalg.norm(biases))
    return norm / (expected if expected > MIN_GRAVITY_M_S2 else GRAVITY)


def _step_ratio(y: Floats, axis: str, model: NoiseModel) -> float | None:
    """Return the ratio of the quantization step in the recording to the step in the model, or None.

    The largest known ratio that fits is returned, because multiples of the true step are also multiples of its
    fractions.
    """
    step = next((effect.step for effect in model.effects.get(axis, ()) if isinstance(effect, Resolution)), None)
    values = y[np.isfinite(y)]
    if step is None or not values.size:
        return None
    some = values[np.linspace(0, values.size - 1, min(GRID_SAMPLES, values.size)).astype(np.int64)]
    away = some - some[0]
    for factor in sorted({1.0, *CONVERSIONS.values(), *FULL_SCALES.values()}, reverse=True):
        steps = away / (factor * step)
        levels = np.rint(steps)
        if np.unique(levels).size >= MIN_LEVELS and np.abs(steps - levels).max() < GRID_TOLERANCE:
            return factor
    return None
