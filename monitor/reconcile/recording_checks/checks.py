"""Run all checks of a recording in order, and correct the recording for each fault that can be corrected.

The order matters. Wrong samples are marked before the spectra of the axes are compared with the model. The motion
detector needs the right unit, so it runs after the check of the units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, get_args

import numpy as np

from drivers.sample import AXES, Floats
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.recording import MIN_SAMPLES, Recording
from monitor.reconcile.recording_checks.axis_permutation import (
    TriadOrder,
    describe_order,
    fading_peaks,
    find_order,
    reorder,
)
from monitor.reconcile.recording_checks.block_spectra import block_spectrum
from monitor.reconcile.recording_checks.corrupt_rows import check_corrupt_rows
from monitor.reconcile.recording_checks.missing_rows import check_missing_rows
from monitor.reconcile.recording_checks.motion import check_motion
from monitor.reconcile.recording_checks.repeated_rows import check_repeated_rows
from monitor.reconcile.recording_checks.sample_rate import correct_impossible_rate
from monitor.reconcile.recording_checks.slow_terms import check_slow_terms
from monitor.reconcile.recording_checks.stuck_values import check_stuck_values
from monitor.reconcile.recording_checks.unit_error import find_unit_error, triad_evidence
from monitor.reconcile.result import FindingKind, RecordingFinding

TRIADS: Final = (AXES[:3], AXES[3:])
"""Names of the axes of the gyroscopes and of the accelerometers."""
KINDS: Final[tuple[str, ...]] = get_args(FindingKind)
"""Kinds of findings in the order of the report."""
SIMULATION_SEED: Final = 1_000_003
"""Offset of the seed of the simulation, which differs from all simulations of the null distribution."""


@dataclass(frozen=True, slots=True)
class CheckedRecording:
    """Corrected recording and the faults that were found."""

    recording: Recording
    findings: tuple[RecordingFinding, ...]  # the gravest first


def check_recording(recording: Recording, model: NoiseModel | None, seed: int) -> CheckedRecording:
    """Check a recording, and correct the faults that can be corrected.

    Parameters
    ----------
    recording : Recording
        Recording to check.
    model : NoiseModel or None
        Model under test. If None, only the checks that need no model run.
    seed : int
        Seed of the simulation of the model.
    """
    if recording.samples < MIN_SAMPLES:
        return CheckedRecording(recording, ())
    findings = check_missing_rows(recording.values, recording.rate_hz)
    impossible = None if model is None else correct_impossible_rate(recording, model)
    if impossible is not None:
        recording, finding = impossible
        findings.append(finding)
    rate_hz = recording.rate_hz
    simulated = None if model is None else _simulate(recording, model, seed)
    values, found = check_stuck_values(recording.values, rate_hz, simulated)
    findings += found
    values, found = check_corrupt_rows(values, rate_hz, simulated, model)
    findings += found
    for triad in TRIADS:
        values, found = _check_triad(values, triad, rate_hz, model, simulated)
        findings += found
    values, found = check_motion(values, rate_hz, simulated, model)
    findings += found
    if found:  # the distances of rows in motion hide corrupt rows
        values, found = check_corrupt_rows(values, rate_hz, simulated, model)
        findings += found
    findings += check_repeated_rows(values, rate_hz, model)
    if model is not None:
        findings += check_slow_terms(tuple(values), recording.samples, rate_hz, model)
    return CheckedRecording(replace(recording, values=values), sort_findings(findings))


def sort_findings(findings: Sequence[RecordingFinding]) -> tuple[RecordingFinding, ...]:
    """Return the findings with the gravest first."""
    return tuple(sorted(findings, key=lambda one: KINDS.index(one.kind)))


def _check_triad(
    values: Mapping[str, Floats],
    triad: tuple[str, ...],
    rate_hz: float,
    model: NoiseModel | None,
    simulated: Mapping[str, Floats] | None,
) -> tuple[dict[str, Floats], list[RecordingFinding]]:
    """Check the order and the unit of the axes of one triad."""
    if not set(triad) <= set(values):
        return dict(values), []
    order: TriadOrder | None = None
    findings: list[RecordingFinding] = []
    corrected = dict(values)
    if simulated is not None and model is not None:
        recorded = [block_spectrum(values[axis], rate_hz) for axis in triad]
        expected = [block_spectrum(simulated[axis], rate_hz) for axis in triad]
        if not all(recorded) or not all(expected):
            return corrected, []
        peaks = fading_peaks((effect for _, effect in model), values[triad[0]].size / rate_hz)
        order = find_order([one for one in recorded if one], [one for one in expected if one], peaks)
        described = describe_order(triad, order)
        if described is not None:
            findings.append(described)
            corrected = reorder(corrected, triad, order.order)
    unit = find_unit_error(triad, triad_evidence(corrected, triad, model, order))
    if unit is not None:
        factor, finding = unit
        findings.append(finding)
        corrected = {axis: y / factor if axis in triad else y for axis, y in corrected.items()}
    return corrected, findings


def _simulate(recording: Recording, model: NoiseModel, seed: int) -> dict[str, Floats]:
    """Return a simulation of the model with the axes, length and temperature of the recording."""
    temperature_c = recording.temperature_c
    if temperature_c is not None:
        known = np.flatnonzero(np.isfinite(temperature_c))
        whole = np.arange(temperature_c.size)
        temperature_c = np.interp(whole, known, temperature_c[known]) if known.size else None
    drawn = model.simulate(recording.samples, recording.rate_hz, seed + SIMULATION_SEED, temperature_c)
    return {axis: np.ascontiguousarray(drawn[:, AXES.index(axis)]) for axis in recording.values}
