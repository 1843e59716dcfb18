"""Inference of the units that neither a file nor the user states, from the numbers themselves.

The numbers of a MEMS IMU at rest are constrained by physics: the accelerometers measure gravity, the noise densities
and the bias of a gyroscope lie in known ranges, and the sample rate lies between 1 Hz and 32 kHz. If the sensor turns,
the change of the direction of gravity gives the scale of the angular rates. Each combination of units has a score,
which is the sum of the log likelihoods of these quantities and of prior knowledge about the names. A unit is certain if
every combination with another unit has a score that is lower by MIN_MARGIN.

The distributions are empirical: they cover the data sheets of consumer and industrial sensors.
"""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, log, log10, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Times
from drivers.impossible_units import measure_rotation
from drivers.recordings.column_names import ACCELEROMETER as ACCEL
from drivers.recordings.column_names import GYRO, KIND_OF, KINDS, TIME, UNSCALED, names_sample_time_fine
from drivers.recordings.table import NO_TIME_NS, TIME_NS
from drivers.units import DEGREE, G0, acceleration_factor, angular_rate_factor, time_factor

MIN_MARGIN: Final = 5.0
"""Difference of the log likelihoods from which the better hypothesis is certain."""
MAX_ALTERNATIVES: Final = 4
"""Number of units that are described in a message."""
MIN_SAMPLES: Final = 100
BLOCKS: Final = 16
BLOCK_ROWS: Final = 1024
"""Number and length of the parts of a recording that are examined."""
TIME_UNITS: Final = ("s", "ms", "us", "ns")
ROW_NUMBER: Final = "row number"
"""Hypothesis that a column counts the rows instead of a time."""
GYRO_UNITS: Final = {"rad/s": 0.0, "deg/s": 0.0, "mdps": -3.0, "mrad/s": -8.0}
GYRO_COUNTS: Final = {
    "rad/s": -8.0, "deg/s": -6.0, "mdps": -2.0,
    **{f"deg/s/{n}": -2.0 for n in (131, 65.5, 32.8, 16.4, 114.286, 57.143, 28.571, 14.286)},
}  # fmt: skip
ACCEL_UNITS: Final = {"m/s²": 0.0, "g": 0.0, "mg": -2.0, "mm/s²": -3.0}
ACCEL_COUNTS: Final = {"m/s²": -8.0, "g": -8.0, "mg": 0.0, "mm/s²": -2.0, **{f"g/{2**k}": -1.0 for k in range(8, 16)}}
"""Units of fractional numbers and of integers, each with the logarithm of its prior probability."""
OWN_NAME: Final = 12.0
"""Log prior of SI units for the column names of this program, whose units the documentation states."""
OWN_TIME: Final = 16.0
"""Log prior of s for fractional times in the column ``t``."""
MAX_RATE_HZ: Final = 33_000.0
MIN_POSSIBLE: Final = -8.0
"""Log likelihood below which rates in rad/s are impossible: a bias above about 16 °/s at rest, or above full scale."""
MAX_RATE_RAD_S: Final = 4500.0 * DEGREE
"""Angular rate beyond the full scale of MEMS gyroscopes."""


@dataclass(frozen=True, slots=True)
class InferredUnits:
    """Units of the quantities whose unit nothing states."""

    units: dict[str, str]  # most likely unit of each quantity
    likeliest: dict[str, str]  # most likely unit of each kind of quantity
    reasons: dict[str, str]  # for the name of each kind of quantity: unit, and why it is the most likely one
    alternatives: dict[str, list[str]]  # units of each doubtful kind with their meaning, likeliest first


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Numbers without units that constrain the units."""

    step: float | None  # typical step of the times
    first_time: float
    constant_step: bool
    rate_hz: float | None  # sample rate of a table that states it
    gyro_noise: float | None  # standard deviation of white noise at rest
    gyro_bias: float | None  # mean rate at rest, horizontal if gravity is known
    gyro_peak: float
    gravity: float | None  # magnitude of the specific force
    gravity_sigma: float  # uncertainty of its logarithm
    accel_noise: float | None
    temperature_step_c: float  # mean change of the temperature between two samples; 0 if it is not measured
    rotation: float | None  # angle in rad per unit of angular rate and sample, from the direction of gravity


def infer_units(
    columns: Mapping[str, Times], names: Mapping[str, str], stated: Mapping[str, str], rate_hz: float | None
) -> InferredUnits:
    """Infer the units of columns.

    Parameters
    ----------
    columns
        Arrays [n] as in the file, by quantity.
    names
        Name of the column in the file for each quantity.
    stated
        Unit of each quantity that the file or the user states. A unit such as "lsb" states that the numbers are counts.
    rate_hz
        Sample rate in Hz of a table without times. None if unknown.
    """
    unknown = {
        kind.name: members
        for kind in (TIME, GYRO, ACCEL)
        if (members := [q for q in kind.quantities if q in columns and stated.get(q, "lsb").lower() in UNSCALED])
    }
    n = min(column.size for column in columns.values())
    result = InferredUnits({}, {}, {}, {})
    if not unknown or n < MIN_SAMPLES:
        return result
    blocks = _split_blocks(n)
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # a part may contain no values
        evidence = _collect_evidence(columns, blocks, rate_hz)
    candidates = {
        kind.name: _list_candidates(kind.name, unknown, columns, names, stated, blocks, evidence)
        for kind in (TIME, GYRO, ACCEL)
    }
    scores = _score(candidates, evidence)
    best = max((one for one in scores if one[0] != ROW_NUMBER), key=lambda one: scores[one])
    for position, kind in enumerate((TIME, GYRO, ACCEL)):
        if kind.name not in unknown:
            continue
        marginal: dict[str, float] = {}
        for combination, score in scores.items():
            marginal[combination[position]] = max(score, marginal.get(combination[position], -np.inf))
        likely = [unit for unit in marginal if marginal[unit] > scores[best] - MIN_MARGIN]
        likely = likely or [best[position]]  # numbers beyond all limits fit no unit
        likely.sort(key=lambda unit: (unit != best[position], -marginal[unit]))
        result.units.update(dict.fromkeys(unknown[kind.name], best[position]))
        result.likeliest[kind.name] = best[position]
        described = {unit: _describe(kind.name, unit, best, evidence) for unit in likely[:MAX_ALTERNATIVES]}
        result.reasons[kind.name] = f"{best[position]} ({described[best[position]]})"
        if len(likely) > 1:
            result.alternatives[kind.name] = [f"{unit} ({meaning})" for unit, meaning in described.items()]
    return result


def _split_blocks(n: int) -> list[slice]:
    """Return the rows of the parts to examine."""
    size = min(BLOCK_ROWS, max(n // 4, MIN_SAMPLES))
    starts = np.linspace(0, n - size, min(BLOCKS, n // size)).astype(int).tolist()
    return [slice(start, start + size) for start in starts]


def _collect_evidence(columns: Mapping[str, Times], blocks: Sequence[slice], rate_hz: float | None) -> _Evidence:
    gyro, accel = (_stack(columns, kind.quantities, blocks) for kind in (GYRO, ACCEL))
    step, first, constant = _measure_steps(columns.get("t"), blocks)
    force = np.linalg.norm(accel, axis=2) if accel is not None else None
    axes = 0 if accel is None else accel.shape[2]
    quiet = np.ones(len(blocks), np.bool_)
    gravity, gravity_sigma = None, 0.04
    if force is not None and axes == 3 and np.nanmedian(force) > 0.0:
        gravity = float(np.nanmedian(force))
        quiet = np.nanstd(force, axis=1) < 0.03 * gravity
        gravity_sigma = 0.04 if np.any(quiet) else 0.35
        if np.any(quiet):
            gravity = float(np.nanmedian(force[quiet]))
    if gyro is not None:
        quiet &= np.all(np.nanstd(gyro, axis=1) < 2.5 * np.maximum(_noise(gyro), 1e-30), axis=1)
    at_rest = bool(np.mean(quiet) >= 0.25)
    bias = None
    if at_rest and gyro is not None:
        means = np.nan_to_num(np.nanmedian(gyro[quiet], axis=1))
        if gravity is not None and accel is not None and gyro.shape[2] == 3:
            up = np.nan_to_num(np.nanmean(accel[quiet], axis=1))
            up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-30)
            means = means - up * np.sum(means * up, axis=1, keepdims=True)
        bias = float(np.median(np.linalg.norm(means, axis=1)))
    return _Evidence(
        step, first, constant, rate_hz,
        _smallest_noise(gyro, quiet) if at_rest else None, bias,
        0.0 if gyro is None else float(np.nanmax(np.abs(gyro), initial=0.0)),
        gravity, gravity_sigma, _smallest_noise(accel, quiet) if at_rest else None,
        _measure_warming(columns.get("temperature")), measure_rotation(gyro, accel),
    )  # fmt: skip


def _stack(columns: Mapping[str, Times], quantities: Sequence[str], blocks: Sequence[slice]) -> Floats | None:
    """Return the parts of a triad [blocks, rows, axes] without constant axes. Shorter parts end with NaN."""
    measured = [columns[q] for q in quantities if q in columns]
    stacked = np.full((len(blocks), max(one.stop - one.start for one in blocks), len(measured)), np.nan)
    for i, block in enumerate(blocks):
        for k, column in enumerate(measured):
            stacked[i, : block.stop - block.start, k] = column[block]
    stacked[~(np.abs(stacked) < 1e30)] = np.nan
    varying = [k for k in range(len(measured)) if np.unique(stacked[:, :, k][np.isfinite(stacked[:, :, k])]).size > 1]
    return stacked[:, :, varying] if varying else None


def _noise(values: Floats) -> Floats:
    """Return the standard deviation of white noise [blocks, axes] from the differences of consecutive samples."""
    return np.asarray(np.nanstd(np.diff(values, axis=1), axis=1) / sqrt(2.0))


def _smallest_noise(values: Floats | None, quiet: NDArray[np.bool_]) -> float | None:
    if values is None:
        return None
    sigma = np.nanmedian(_noise(values[quiet]), axis=0)
    return float(np.median(sigma)) or None


def _measure_steps(times: Times | None, blocks: Sequence[slice]) -> tuple[float | None, float, bool]:
    """Return the typical step of times, the first time, and True if all steps are equal."""
    if times is None:
        return None, 0.0, False
    parts = [times[block] for block in blocks]
    if times.dtype.kind == "i":
        parts = [part[part != NO_TIME_NS] for part in parts]
    steps = np.concatenate([np.diff(part) for part in parts]).astype(np.float64)
    steps = steps[np.isfinite(steps)]
    first = next((float(part[0]) for part in parts if part.size), 0.0)
    if not steps.size:
        return None, first, False
    typical = float(np.median(steps))
    usual = steps[np.abs(steps) < 3.0 * typical] if typical > 0.0 else np.maximum(steps, 0.0)
    step = float(np.mean(usual))  # of coarse or irregular time stamps, too
    return step or None, first, bool(np.all(steps == steps[0]))


def _measure_warming(temperature: Times | None, parts: int = 8) -> float:
    """Return the largest mean change of the temperature per sample between parts of the recording."""
    if temperature is None or temperature.size < parts * MIN_SAMPLES // 2:
        return 0.0
    size = temperature.size // parts
    means = np.nanmedian(temperature[: parts * size].reshape(parts, size), axis=1)
    return float(np.nanmax(np.abs(np.diff(means)), initial=0.0)) / size


# --- hypotheses ----------------------------------------------------------------------------------


def _list_candidates(
    kind: str,
    unknown: Mapping[str, Sequence[str]],
    columns: Mapping[str, Times],
    names: Mapping[str, str],
    stated: Mapping[str, str],
    blocks: Sequence[slice],
    evidence: _Evidence,
) -> dict[str, float]:
    """Return the possible units of a kind of quantity, each with its log prior probability."""
    quantities = next(one.quantities for one in KINDS if one.name == kind)
    if kind not in unknown:
        return {next((stated[q] for q in quantities if q in columns and q in stated), ""): 0.0}
    members = unknown[kind]
    own = all(names.get(q) == q for q in (members if kind == TIME.name else AXES) if q in names)
    parts = [columns[q][block] for q in members for block in blocks]
    fractional = any(bool(np.any(np.mod(part[np.isfinite(part)], 1.0) != 0.0)) for part in parts)
    if kind == TIME.name:
        if not evidence.step or (own and 1.0 < 1.0 / evidence.step < MAX_RATE_HZ):
            return {"s": 0.0}
        if names_sample_time_fine(names["t"]):
            return {"s/10000": 0.0, "us": 0.0}
        found = dict.fromkeys(TIME_UNITS, 0.0)
        own_s = OWN_TIME if parts[0].dtype.kind == "f" else 6.0
        found["s"] = own_s if own else 3.0 if fractional else 0.0
        if evidence.constant_step and evidence.step == 1.0:
            found[ROW_NUMBER] = 0.0 if evidence.first_time in (0.0, 1.0) and not own else -6.0
        return found
    counts = any(stated.get(q, "").lower() in UNSCALED for q in members)
    largest = max(float(np.nanmax(np.abs(part), initial=0.0)) for part in parts)
    integers = counts or (not fractional and largest >= 2.0)
    choices = {GYRO.name: (GYRO_UNITS, GYRO_COUNTS), ACCEL.name: (ACCEL_UNITS, ACCEL_COUNTS)}[kind][integers]
    if counts:
        return {unit: prior for unit, prior in choices.items() if unit.startswith(("deg/s/", "g/"))}
    if not own:
        return dict(choices)
    si_unit = KIND_OF[members[0]].si_unit
    is_written_by_program = names.get("t") == TIME_NS
    may_be_degrees = _fits_gyro("deg/s", evidence) and (not is_written_by_program or _contradicts_si(evidence))
    fitting = {
        unit: prior
        for unit, prior in choices.items()
        if kind == ACCEL.name or integers or (unit == "deg/s" and may_be_degrees)
    }
    return {**fitting, si_unit: OWN_NAME}


def _contradicts_si(evidence: _Evidence) -> bool:
    """Return True if the rates cannot be in rad/s: gravity turns otherwise, or not at all. Any noise is possible."""
    rate_hz = _rate("s", evidence)
    turn = 1.0 if evidence.rotation is None or rate_hz is None else evidence.rotation * rate_hz
    return _score_gyro("rad/s", evidence) < MIN_POSSIBLE or abs(log(turn)) > log(3.0)


def _fits_gyro(unit: str, evidence: _Evidence) -> bool:
    """Return True if the noise and the bias at rest are those of a usual gyroscope. Numbers of any size fit rad/s."""
    noise = evidence.gyro_noise
    rates = [_rate(time, evidence) or 100.0 for time in TIME_UNITS]
    usual = [rate_hz for rate_hz in rates if 1.0 <= rate_hz <= MAX_RATE_HZ] or rates[:1]
    fits = [0.0 if noise is None else _score_gyro_noise(noise * angular_rate_factor(unit), one) for one in usual]
    return _score_gyro(unit, evidence) + max(fits) > -2.0


def _score(candidates: Mapping[str, Mapping[str, float]], evidence: _Evidence) -> dict[tuple[str, str, str], float]:
    """Return the log likelihood of each combination of units of time, gyroscope and accelerometer."""
    of_gyro = {unit: _score_gyro(unit, evidence) for unit in candidates[GYRO.name]}
    of_accel = {unit: _score_accel(unit, evidence) for unit in candidates[ACCEL.name]}
    scores = {}
    for time, gyro, accel in itertools.product(*(candidates[kind.name] for kind in (TIME, GYRO, ACCEL))):
        rate_hz = _rate(time, evidence)
        score = candidates[TIME.name][time] + candidates[GYRO.name][gyro] + candidates[ACCEL.name][accel]
        score += of_gyro[gyro] + of_accel[accel] + _score_time(time, rate_hz, evidence)
        if gyro and accel:
            in_g, in_degrees = "g" in accel, not gyro.endswith("rad/s")
            score -= 2.2 if in_g and not in_degrees else 0.85 if in_degrees and not in_g else 0.0
        if gyro and evidence.gyro_noise is not None:
            score += _score_gyro_noise(evidence.gyro_noise * angular_rate_factor(gyro), rate_hz)
        if accel and evidence.accel_noise is not None:
            score += 0.5 * _score_noise(evidence.accel_noise * acceleration_factor(accel), rate_hz, 1.5e-3, 0.1)
        if gyro and evidence.rotation is not None and rate_hz is not None:
            score += _normal(log(evidence.rotation * rate_hz / angular_rate_factor(gyro)), 0.3, 14.0)
        scores[time, gyro, accel] = score if isfinite(score) else -inf
    return scores


def _normal(x: float, sigma: float, limit: float) -> float:
    """Return the logarithm of a normal distribution with heavy tails, relative to its maximum."""
    return -min(0.5 * (x / sigma) ** 2, limit)


def _beyond(x: float, usual: float, impossible: float) -> float:
    """Return 0 for a number up to ``usual``, 1 from ``impossible``, and between them a logarithmic interpolation."""
    return float(np.interp(log(max(x, 1e-30)), (log(usual), log(impossible)), (0.0, 1.0)))


def _rate(time_unit: str, evidence: _Evidence) -> float | None:
    if evidence.step is None:
        return evidence.rate_hz
    return None if time_unit == ROW_NUMBER else 1.0 / (evidence.step * time_factor(time_unit or "s"))


def _score_time(unit: str, rate_hz: float | None, evidence: _Evidence) -> float:
    if evidence.step is None or rate_hz is None:
        return 0.0
    decades = log10(rate_hz)
    score = float(
        np.interp(decades, (-3, -1, 0, 1, 1.4, 3.3, 4, 4.5, 5, 7), (-10.5, -9, -5, -0.5, 0, 0, -3, -5, -10, -20))
    )
    unix_s = evidence.first_time * time_factor(unit or "s")
    warming_c_s = evidence.temperature_step_c * rate_hz
    return score + (4.0 if 9.5e8 < unix_s < 2.1e9 else 0.0) - 8.0 * _beyond(warming_c_s, 0.5, 5.0)


def _score_gyro(unit: str, evidence: _Evidence) -> float:
    if not unit:
        return 0.0
    factor = angular_rate_factor(unit)
    score = -15.0 if evidence.gyro_peak * factor > MAX_RATE_RAD_S else 0.0
    if evidence.gyro_bias is not None:
        bias = evidence.gyro_bias * factor / DEGREE
        sigma = 1.6 if evidence.gravity is not None else 2.2
        x = log(max(bias, 1e-9) / 0.5)
        score += _normal(x, sigma if x > 0.0 else 3.0, 10.0) - 8.0 * (
            _beyond(bias, 10.0, 20.0) + _beyond(bias, 20.0, 60.0)
        )
    return score


def _score_accel(unit: str, evidence: _Evidence) -> float:
    if not unit or evidence.gravity is None:
        return 0.0
    limit = 20.0 if evidence.gravity_sigma < 0.1 else 6.0
    return _normal(log(evidence.gravity * acceleration_factor(unit) / G0), evidence.gravity_sigma, limit)


def _score_gyro_noise(sigma: float, rate_hz: float | None) -> float:
    return _score_noise(sigma, rate_hz, 0.006 * DEGREE, 0.3 * DEGREE)


def _score_noise(sigma: float, rate_hz: float | None, typical: float, largest: float) -> float:
    """Return the log likelihood of a noise density. Noise densities of MEMS sensors extend over two decades."""
    density = sigma / sqrt(rate_hz or 100.0)
    x = log(density / typical)
    return _normal(x, (1.1 if x > 0.0 else 0.75) * (1.0 if rate_hz else 1.5), 15.0) - 6.0 * _beyond(
        density, largest / 1.5, largest
    )


# --- reasons -------------------------------------------------------------------------------------


def _describe(kind: str, unit: str, best: tuple[str, str, str], evidence: _Evidence) -> str:
    """Return what a unit means: the sample rate, the noise of the gyroscope, or gravity."""
    if kind == TIME.name:
        if unit == ROW_NUMBER:
            return "give --columns t=- --rate HZ"
        return "no steps" if evidence.step is None else f"{1.0 / (evidence.step * time_factor(unit)):.4g} Hz"
    if kind == GYRO.name:
        factor, rate_hz = angular_rate_factor(unit) / DEGREE, _rate(best[0], evidence)
        parts = []
        if evidence.gyro_noise is not None and rate_hz:
            parts.append(f"noise {evidence.gyro_noise * factor / sqrt(rate_hz):.2g} °/s/√Hz")
        if evidence.gyro_bias is not None:
            parts.append(f"bias {evidence.gyro_bias * factor:.2g} °/s")
        if evidence.rotation is not None and rate_hz:
            parts.append(f"{evidence.rotation * rate_hz / angular_rate_factor(unit):.2g} times the turn of gravity")
        return ", ".join(parts) or f"up to {evidence.gyro_peak * factor:.3g} °/s"
    if evidence.gravity is None:
        return "no gravity"
    return f"gravity {evidence.gravity * acceleration_factor(unit) / G0:.4g} g"
