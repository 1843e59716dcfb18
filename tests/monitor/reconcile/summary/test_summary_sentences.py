"""Tests of the summary: at most five sentences, faults first, and only important findings."""

from dataclasses import replace

import pytest

from monitor.noise.effects import EFFECTS
from monitor.reconcile.result import Reconciliation, RecordingFinding, RemainingGap
from monitor.reconcile.summary.ranked_findings import RankedGapCause, rank_findings
from monitor.reconcile.summary.summary_sentences import EFFECT_PHRASES, describe_finding, summarize
from tests.monitor.reconcile import samples
from tests.monitor.reconcile.runs_made import around

CONTINUE = "Continue with model.toml, which contains the findings, if the findings belong to the sensor."


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (samples.agrees(), ("The model agrees with the recording on all 6 axes.",)),
        (samples.explained(), (
            "The model differs from the recording on gz, and 2 findings explain all of the difference.",
            "Line at 17.3 Hz on gz (96 %) and 1 smaller finding (4.3 %).",
            CONTINUE,
        )),
        (samples.partly_explained(), (
            "The model differs from the recording on gz, and 1 finding explains 96 % of the difference.",
            "Line at 17.3 Hz on gz (96 %).",
            "No effect explains the rest (4.3 % of the whole): a difference in the spectrum from 6 to 11 Hz on gz "
            "(4.3 %).",
            CONTINUE,
        )),
        (samples.unexplained(), (
            "The model of five classic terms differs from the recording on ax, and no known effect explains the "
            "difference.",
            "No effect explains the rest: a difference in the spectrum from 6 to 11 Hz on ax (100 %).",
            "Examine the remaining differences in the figures of the report.",
        )),
    ],
)  # fmt: skip
def test_summary_has_the_expected_text(made: Reconciliation, said: tuple[str, ...]) -> None:
    assert summarize(made) == said


def fault(kind: str, *axes: str) -> RecordingFinding:
    return RecordingFinding(kind, axes, "A sentence.", {}, {}, True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("unit_error", "Correct the unit"),
        ("too_short", "Record for longer"),
        ("motion", "without motion"),
        ("missing_rows", "connection"),
    ],
)
def test_faults_of_the_recording_are_stated_first(kind: str, advice: str) -> None:
    r = replace(samples.partly_explained(), recording_findings=(fault(kind, "gz", "gx"), fault(kind, "gy")))
    said = summarize(r)
    assert len(said) == 5
    assert said[0] == f"The recording has 1 fault: {kind.replace('_', ' ')} on gx, gy and gz."
    assert advice in said[-1]


def with_remaining(*gains: tuple[str, float]) -> Reconciliation:
    r = samples.partly_explained()
    (one,) = r.axes["gz"].remaining
    remaining = tuple(RemainingGap(group, one.strongest, gain) for group, gain in gains)
    return replace(r, axes={**r.axes, "gz": replace(r.axes["gz"], remaining=remaining)})


def test_small_remaining_gap_is_stated_as_small() -> None:
    said = summarize(with_remaining(("spectrum", 2.0)))
    assert "The remaining difference on gz is significant, but only 0.2 % of the whole." in said


def test_vibration_and_disturbances_have_their_own_advice() -> None:
    assert "Mount the sensor elsewhere" in summarize(with_remaining(("other_axes", 5000.0)))[-1]
    assert "Record again without disturbances" in summarize(with_remaining(("distribution", 5000.0)))[-1]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, "line at 17.3 Hz on gz"),
        ({"effect": "cross_axis", "parameters": {"source": around(0.0, 0.0)}}, "leak from 0.0 on gz"),
        ({"kind": "absent"}, "no line at 17.3 Hz on gz"),
        ({"kind": "retuned", "size_ratio": 0.5}, "line at 17.3 Hz changed by a factor of 0.5 on gz"),
        ({"kind": "retuned", "size_ratio": 1.01, "old_frequency": 17.0}, "line moved from 17 to 17.3 Hz on gz"),
        ({"kind": "retuned", "size_ratio": 2.0, "old_frequency": 17.0}, "line moved from 17 to 17.3 Hz "
         "and changed by a factor of 2 on gz"),
        ({"kind": "retuned"}, "line at 17.3 Hz of another size on gz"),
        ({"effect": "narrowband", "kind": "retuned", "size_ratio": 1.01,
          "parameters": {"frequency": around(17.3, 0.1), "bandwidth": around(2.0, 0.1)}},
         "resonance at 17.3 Hz with a bandwidth of 2 Hz on gz"),
        ({"effect": "resolution", "kind": "retuned", "size_ratio": 2.0, "parameters": {"step": around(2e-3, 1e-6)}},
         "quantization steps changed by a factor of 2 on gz"),
        ({"effect": "scale_factor", "parameters": {"factor": around(1.25, 0.1)}, "axes": ("gx", "gy", "gz")},
         "scale factor of 1.25 on gx, gy and gz"),
    ],
)  # fmt: skip
def test_phrase_of_a_finding_contains_its_place(changed: dict[str, object], said: str) -> None:
    line: RankedGapCause = rank_findings(samples.explained()).findings[0]
    assert describe_finding(replace(line, **changed)) == said  # type: ignore[arg-type]


def test_every_phrase_belongs_to_an_effect() -> None:
    assert set(EFFECT_PHRASES) <= set(EFFECTS)
