"""Tests of ``reconcile`` on parts of real recordings.

A clearly visible effect must be named, or reported as unexplained at its frequency.
"""

import numpy as np
import pytest

from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile
from monitor.reconcile.result import AddedOrResizedEffect, Reconciliation
from monitor.reconcile.summary.ranked_findings import rank_findings
from monitor.reconcile.summary.summary_sentences import summarize
from tests.support.recordings import recordings

pytestmark = pytest.mark.data

DEG = np.pi / 180.0
G = 9.80665


def reconcile_with_classic_terms(file: str, axis: str, begin: int = 0, end: int | None = None) -> Reconciliation:
    """Compare one axis of a part of a recording with the five classic terms."""
    with np.load(recordings() / f"{file}.npz") as columns:
        values = columns[axis][begin:end].astype(np.float64)
        return reconcile(RecordedAxes({axis: values}, float(columns["fs"])), None, seed=1)


def added_effects(result: Reconciliation) -> dict[str, AddedOrResizedEffect]:
    """Return the added effects by name. If a name occurs several times, the last effect counts."""
    (axis,) = result.axes.values()
    return {step.effect: step for step in axis.steps if step.kind == "added"}


def parameter_value(step: AddedOrResizedEffect, name: str) -> float:
    return float(step.parameters[name].value)


def found_near(result: Reconciliation, hertz: float, within: float) -> bool:
    """Return True if an effect is named within ``within`` Hz of a frequency, or an unexplained gap lies there."""
    (axis,) = result.axes.values()
    named = [parameter_value(step, "frequency") for step in axis.steps if "frequency" in step.parameters]
    bands = [score.where.frequency for score in axis.left_over if score.where.frequency is not None]
    return any(abs(f - hertz) < within for f in named) or any(
        lo - within < hertz < hi + within and hi - lo < 0.2 * hertz for lo, hi in bands
    )


def test_adis16405_resonance_and_resolution() -> None:
    result = reconcile_with_classic_terms("adis16405/run1", "gz", 800_000, 820_000)
    assert parameter_value(added_effects(result)["resolution"], "step") == pytest.approx(0.05 * DEG, rel=1e-6)
    assert found_near(result, 20.0, 2.0)


def test_adis16405_resolution_of_an_accelerometer() -> None:
    found = added_effects(reconcile_with_classic_terms("adis16405/run1", "ax", 800_000, 820_000))
    assert parameter_value(found["resolution"], "step") == pytest.approx(3.33e-3 * G, rel=1e-4)


def test_adis16405_accelerometer_line() -> None:
    assert found_near(reconcile_with_classic_terms("adis16405/run1", "ax", 700_000, 760_000), 0.565, 0.02)


@pytest.mark.parametrize(("axis", "hertz"), [("gy", 37.99), ("gz", 31.0)])
def test_mpu6050_line_and_resolution(axis: str, hertz: float) -> None:
    result = reconcile_with_classic_terms("mpu6050-arduino/static-7min", axis)
    found = added_effects(result)
    assert parameter_value(found["resolution"], "step") == pytest.approx(DEG / 131.0, rel=1e-5)
    assert found_near(result, hertz, 0.02)


def test_mpu6050_without_a_line() -> None:
    assert set(added_effects(reconcile_with_classic_terms("mpu6050-arduino/static-7min", "gx"))) == {"resolution"}


def test_mpu6050_line_has_a_constant_amplitude() -> None:
    """The ratio E|z|⁴/(E|z|²)² of the line without the noise around it is 1.1. A resonance has the ratio 2."""
    found = added_effects(reconcile_with_classic_terms("mpu6050-hosttime/static-11min", "gz"))
    assert parameter_value(found["wandering_line"], "frequency") == pytest.approx(31.38, abs=0.1)
    assert "sinusoidal" not in found


def test_mpu6050_summary_begins_with_the_line() -> None:
    result = reconcile_with_classic_terms("mpu6050-hosttime/static-11min", "gz")
    first = rank_findings(result).findings[0]
    assert (first.effect, first.parameters["frequency"].value) == ("wandering_line", pytest.approx(31.38, abs=0.1))
    assert first.share > 0.9
    assert any(sentence.startswith("Wandering line at 31.") for sentence in summarize(result))


def test_xsens_outliers_or_heavy_tails() -> None:
    result = reconcile_with_classic_terms("xsens-mtig/contaminated-gx", "gx", 0, 100_000)
    left = {score.diagnostic for score in result.axes["gx"].left_over}
    assert "outliers" in added_effects(result) or "tails" in left
    assert result.verdict != "agrees"


def test_px4_line_by_the_nominal_rate() -> None:
    # the line is at 116.13 Hz by the time stamps; the nominal rate is 250 Hz, and the measured rate is 248.56 Hz
    assert found_near(
        reconcile_with_classic_terms("px4-bench/bench-69s", "gx", 2000, 8000), 116.13 * 250.0 / 248.56, 0.15
    )


def test_vn100_intermittent_line() -> None:
    result = reconcile_with_classic_terms("vn100-serial/static-12min", "az", 10_000, 24_000)
    assert found_near(result, 13.38, 0.05)
    assert result.verdict in ("partly_explained", "unexplained")


def test_phone_resolution() -> None:
    found = added_effects(reconcile_with_classic_terms("phone/gyro-a", "gx"))
    assert parameter_value(found["resolution"], "step") == pytest.approx(1e-3, rel=1e-5)
