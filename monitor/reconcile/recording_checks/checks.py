"""Run the checks of a recording in a fixed order, and correct the faults that can be corrected.

Wrong samples are marked as missing before the spectra of the axes are compared with the model. The motion detector
needs samples in the right unit, so motion is checked after the units.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, get_args

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import MIN_SAMPLES, RecordedAxes
from monitor.reconcile.recording_checks.axis_permutation import (
    TriadOrder,
    compute_resonance_log_power_variances,
    compute_robust_spectrum,
    describe_axis_order,
    find_axis_order,
    reorder_axes,
)
from monitor.reconcile.recording_checks.corrupt_rows import check_corrupt_rows
from monitor.reconcile.recording_checks.missing_and_repeated_rows import (
    check_missing_rows,
    check_repeated_rows,
    check_stuck_values,
)
from monitor.reconcile.recording_checks.motion import check_motion
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.recording_checks.sample_rate_from_features import correct_impossible_sample_rate
from monitor.reconcile.recording_checks.temporary_vibration import check_temporary_vibration
from monitor.reconcile.recording_checks.unit_error import collect_triad_evidence, find_unit_error
from monitor.reconcile.recording_checks.untestable_slow_terms import check_slow_terms
from monitor.reconcile.result import FindingKind, RecordingFinding

TRIADS: Final = (AXES[:3], AXES[3:])
"""Axes of the gyroscopes and of the accelerometers."""
FINDING_KINDS: Final[tuple[str, ...]] = get_args(FindingKind)
"""Kinds of findings in the order of the report."""
SIMULATION_SEED_OFFSET: Final = 1_000_003
"""Offset of the simulation seed. The offset keeps the seed different from the seeds of the null distribution."""


@dataclass(frozen=True, slots=True)
class CheckedRecording:
    """Corrected recording, and the faults that were found."""

    recording: RecordedAxes
    findings: tuple[RecordingFinding, ...]  # the most serious fault first


def check_recording(recording: RecordedAxes, model: NoiseModel | None, seed: int) -> CheckedRecording:
    """Check a recording, and correct the faults that can be corrected.

    Parameters
    ----------
    recording : RecordedAxes
        Recording to check.
    model : NoiseModel or None
        Model under test. If None, only the checks that do not need a model are run.
    seed : int
        Seed of the simulation of the model.
    """
    if recording.sample_count < MIN_SAMPLES:
        return CheckedRecording(recording, ())
    findings: list[RecordingFinding] = []
    impossible = None if model is None else correct_impossible_sample_rate(recording, model)
    if impossible is not None:
        recording, finding = impossible
        findings.append(finding)
    simulated = None if model is None else _simulate(recording, model, seed)
    tested = RecordingUnderTest(recording.values, recording.rate_hz, model, simulated, seed)
    for check in CHECKS:
        values, found = check(tested)
        tested = replace(tested, values=values)
        if found and check is check_motion:
            values, more = check_corrupt_rows(tested)  # large distances during the motion hid corrupt rows
            tested, found = replace(tested, values=values), [*found, *more]
        findings += found
    return CheckedRecording(replace(recording, values=dict(tested.values)), sort_findings(findings))


def sort_findings(findings: Sequence[RecordingFinding]) -> tuple[RecordingFinding, ...]:
    """Sort findings by kind, with the most serious kind first."""
    return tuple(sorted(findings, key=lambda one: FINDING_KINDS.index(one.kind)))


def _check_gyroscopes(recording: RecordingUnderTest) -> CheckResult:
    return _check_triad(recording, TRIADS[0])


def _check_accelerometers(recording: RecordingUnderTest) -> CheckResult:
    return _check_triad(recording, TRIADS[1])


def _check_triad(recording: RecordingUnderTest, triad: tuple[str, ...]) -> CheckResult:
    """Correct the order and the unit of the axes of one triad."""
    values, rate_hz, model, simulated = recording.values, recording.rate_hz, recording.model, recording.simulated
    if not set(triad) <= set(values):
        return values, []
    order: TriadOrder | None = None
    findings: list[RecordingFinding] = []
    corrected = dict(values)
    if simulated is not None and model is not None:
        recorded = [compute_robust_spectrum(values[axis], rate_hz) for axis in triad]
        expected = [compute_robust_spectrum(simulated[axis], rate_hz) for axis in triad]
        if not all(recorded) or not all(expected):
            return corrected, []
        peaks = compute_resonance_log_power_variances((effect for _, effect in model), recording.sample_count / rate_hz)
        order = find_axis_order([one for one in recorded if one], [one for one in expected if one], peaks)
        described = describe_axis_order(triad, order)
        if described is not None:
            findings.append(described)
            corrected = reorder_axes(corrected, triad, order.order)
    unit = find_unit_error(triad, collect_triad_evidence(corrected, triad, model, order))
    if unit is not None:
        factor, finding = unit
        findings.append(finding)
        corrected = {axis: y / factor if axis in triad else y for axis, y in corrected.items()}
    return corrected, findings


def _simulate(recording: RecordedAxes, model: NoiseModel, seed: int) -> dict[str, Floats]:
    """Simulate the model with the axes, length and temperature of the recording."""
    temperature_c = recording.temperature_c
    if temperature_c is not None:
        known = np.flatnonzero(np.isfinite(temperature_c))
        whole = np.arange(temperature_c.size)
        temperature_c = np.interp(whole, known, temperature_c[known]) if known.size else None
    drawn = model.simulate(recording.sample_count, recording.rate_hz, seed + SIMULATION_SEED_OFFSET, temperature_c)
    return {axis: np.ascontiguousarray(drawn[:, AXES.index(axis)]) for axis in recording.values}


CHECKS: Final[tuple[Callable[[RecordingUnderTest], CheckResult], ...]] = (
    check_missing_rows,
    check_stuck_values,
    check_corrupt_rows,
    _check_gyroscopes,
    _check_accelerometers,
    check_motion,
    check_temporary_vibration,
    check_repeated_rows,
    check_slow_terms,
)
"""Checks in the order in which they are run. A check sees the corrections of the checks before it."""
