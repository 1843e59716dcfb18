"""Check whether the three axes of a triad are recorded in another unit or with another full scale.

The first evidence is the noise of the three axes relative to the model. A unit error multiplies the noise of all three
axes by one factor, which is one of a short list. The second evidence is gravity, which every accelerometer triad at
rest measures. The third evidence is the quantization step of each axis, if the model has one. A common factor that is
not near the list is the scale factor of another sensor and no unit error.

Without a model, only gravity is tested.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.distributions import Z95
from monitor.noise.effects import Bias, Resolution
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
"""Factors of wrong conversions of units, by their text."""
FULL_SCALES: Final = {**{f"{2**k}": 2.0**k for k in range(1, 5)}, **{f"1/{2**k}": 2.0**-k for k in range(1, 5)}}
"""Factors of a wrong setting of the full scale, by their text."""
GYRO_CONVERSIONS: Final = ("π/180", "180/π", "1000", "1/1000", "1000·180/π")
"""Conversions that occur on gyroscopes. Other conversions are less likely there."""
ACCELEROMETER_CONVERSIONS: Final = ("9.80665", "1/9.80665", "1000", "1/1000", "1000/9.80665")
"""Conversions that occur on accelerometers. Other conversions are less likely there."""
LIKELY_BY_GRAVITY: Final = ("1/9.80665", "1000/9.80665", "1000", "2", "1/2", "4", "1/4")
"""Factors that gravity alone may show, without a model."""
UNLIKELY_PENALTY: Final = 0.15
"""Distance that is added to the logarithm of an unlikely factor when the nearest factor is chosen."""
MAX_DISTANCE: Final = log(1.35)
"""Largest distance of the common factor from a conversion, as a logarithm. Noise changes from run to run."""
MAX_SPREAD: Final = log(1.8)
"""Largest ratio of the factors of the three axes, as a logarithm."""
MAX_FULL_SCALE_DISTANCE: Final = log(1.12)
"""Largest distance from a power of two. The powers are near each other, and surroundings may double the noise."""
MAX_FULL_SCALE_SPREAD: Final = log(1.12)
"""Largest ratio of the factors of three axes for a wrong full scale, as a logarithm."""
MAX_SUPPORTED_DISTANCE: Final = log(1.8)
"""Largest distance of the common factor from a factor that gravity or the quantization steps show."""
MAX_GRAVITY_DISTANCE: Final = log(1.12)
"""Largest distance of gravity from a conversion. The bias and scale factor of a MEMS accelerometer may reach 10 %."""
GRID_SAMPLES: Final = 4096
"""Number of samples that are compared with the quantization steps."""
GRID_TOLERANCE: Final = 0.05
"""Largest distance of a value from the grid in steps."""
MIN_LEVELS: Final = 3
"""Smallest number of different levels that show a grid."""
MIN_ALONE_GRAVITY: Final = 0.5
"""Smallest norm of the mean specific force, m/s², that is taken for gravity without a model."""


@dataclass(frozen=True, slots=True)
class TriadEvidence:
    """Ratios of the recording to the model for one triad; each is None if it is not known."""

    noise: TriadOrder | None
    gravity: float | None  # norm of the mean specific force relative to the expected norm
    step: float | None  # quantization step relative to the model; None if the axes do not agree


def triad_evidence(
    values: Mapping[str, Floats], triad: Sequence[str], model: NoiseModel | None, order: TriadOrder | None
) -> TriadEvidence:
    """Collect the evidence for a unit error.

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
    """Return the factor of a unit error with its finding, or None.

    Parameters
    ----------
    triad : sequence of str
        Names of the three axes.
    evidence : TriadEvidence
        Ratios of the recording to the model.
    """
    name = _of_gravity(triad, evidence) if evidence.noise is None else _of_noise(triad, evidence)
    if name is None or (evidence.noise is None and name not in LIKELY_BY_GRAVITY):
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
        _evidence_numbers(evidence, factor),
        corrected=True,
    )


def _of_gravity(triad: Sequence[str], evidence: TriadEvidence) -> str | None:
    """Return the factor that gravity shows, or None."""
    if evidence.gravity is None or abs(log(evidence.gravity)) < MAX_GRAVITY_DISTANCE:
        return None
    factors = {**{k: CONVERSIONS[k] for k in ACCELEROMETER_CONVERSIONS}, **FULL_SCALES}
    name, distance = _nearest(log(evidence.gravity), factors, triad)
    return name if distance < MAX_GRAVITY_DISTANCE else None


def _of_noise(triad: Sequence[str], evidence: TriadEvidence) -> str | None:
    """Return the factor that the noise shows and that the other evidence does not contradict, or None."""
    assert evidence.noise is not None
    common, spread = float(np.median(evidence.noise.log_ratios)), float(np.ptp(evidence.noise.log_ratios))
    certain = _of_steps(evidence) or _of_gravity(triad, evidence)
    if certain is not None and spread < MAX_SPREAD:
        # the model may state a wrong noise, so the noise must only be nearer to the factor than to one
        factor = log({**CONVERSIONS, **FULL_SCALES}[certain])
        if abs(common - factor) < min(abs(common), MAX_SUPPORTED_DISTANCE):
            return certain
    if evidence.gravity is not None and abs(log(evidence.gravity)) < MAX_GRAVITY_DISTANCE:
        return None  # the accelerometers are in m/s², and the surroundings or the noise differ
    name, distance = _nearest(common, CONVERSIONS, triad)
    scale, scale_distance = _nearest(common, FULL_SCALES, triad)
    if scale_distance < min(MAX_FULL_SCALE_DISTANCE, distance) and spread < MAX_FULL_SCALE_SPREAD:
        return scale
    return name if distance < MAX_DISTANCE and spread < MAX_SPREAD else None


def _of_steps(evidence: TriadEvidence) -> str | None:
    """Return the factor that the quantization steps show, or None."""
    return next((name for name, f in {**CONVERSIONS, **FULL_SCALES}.items() if f == evidence.step), None)


def _nearest(x: float, factors: Mapping[str, float], triad: Sequence[str]) -> tuple[str, float]:
    """Return the factor nearest to exp(x) and the distance of its logarithm from x."""
    likely = (*(GYRO_CONVERSIONS if triad[0].startswith("g") else ACCELEROMETER_CONVERSIONS), *FULL_SCALES)
    name = min(factors, key=lambda k: abs(x - log(factors[k])) + UNLIKELY_PENALTY * (k not in likely))
    return name, abs(x - log(factors[name]))


def _measured_factor(evidence: TriadEvidence, name: str) -> ParameterInterval:
    """Return the measured factor with its 95 % interval."""
    if evidence.noise is None:
        assert evidence.gravity is not None
        error = 0.5 * MAX_GRAVITY_DISTANCE
        return ParameterInterval(evidence.gravity, evidence.gravity * exp(-error), evidence.gravity * exp(error))
    x, error = float(np.median(evidence.noise.log_ratios)), Z95 * evidence.noise.error
    return ParameterInterval(exp(x), exp(x - error), exp(x + error))


def _evidence_numbers(evidence: TriadEvidence, factor: float) -> dict[str, float]:
    """Return the evidence as numbers."""
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
    """Return the norm of the mean specific force relative to gravity, or None for gyroscopes and without gravity."""
    if triad[0].startswith("g"):
        return None
    means = [float(np.nanmedian(values[axis])) if np.isfinite(values[axis]).any() else np.nan for axis in triad]
    norm = float(np.linalg.norm(means))
    if not norm > MIN_ALONE_GRAVITY:
        return None
    biases = [] if model is None else [e.value for a in triad for e in model.effects.get(a, ()) if isinstance(e, Bias)]
    expected = float(np.linalg.norm(biases))
    return norm / (expected if expected > MIN_ALONE_GRAVITY else GRAVITY)


def _step_ratio(y: Floats, axis: str, model: NoiseModel) -> float | None:
    """Return the factor of the list, or one, by which the quantization step of the model must be multiplied.

    All values then lie on steps. A coarser grid that fits is preferred, because finer grids may contain the true one.
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
