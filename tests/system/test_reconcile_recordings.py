"""``reconcile`` on stretches of real recordings: what is plainly in them is named, or left over at its place."""

import numpy as np
import pytest

from monitor.reconcile.preparation.reconcile_input import Recording
from monitor.reconcile.reconcile import reconcile
from monitor.reconcile.result import AddedOrResizedEffect, Reconciliation
from monitor.reconcile.summary.ranked_findings import rank_findings
from monitor.reconcile.summary.summary_sentences import summarize
from tests.support.recordings import recordings

pytestmark = pytest.mark.data

DEG = np.pi / 180.0
G = 9.80665


def compared(file: str, axis: str, begin: int = 0, end: int | None = None) -> Reconciliation:
    """One axis of a stretch beside the five classic terms."""
    with np.load(recordings() / f"{file}.npz") as held:
        values = held[axis][begin:end].astype(np.float64)
        return reconcile(Recording({axis: values}, float(held["fs"])), None, seed=1)


def added(result: Reconciliation) -> dict[str, AddedOrResizedEffect]:
    """By name, the last of a name."""
    (axis,) = result.axes.values()
    return {step.effect: step for step in axis.steps if step.kind == "added"}


def size(step: AddedOrResizedEffect, name: str) -> float:
    return float(step.parameters[name].value)


def seen_at(result: Reconciliation, hertz: float, within: float) -> bool:
    """Whether something is named near a frequency, or left over there without a name."""
    (axis,) = result.axes.values()
    named = [size(step, "frequency") for step in axis.steps if "frequency" in step.parameters]
    places = [score.where.frequency for score in axis.left_over if score.where.frequency is not None]
    return any(abs(f - hertz) < within for f in named) or any(
        lo - within < hertz < hi + within and hi - lo < 0.2 * hertz for lo, hi in places
    )


def test_adis16405_resonance_and_resolution() -> None:
    result = compared("adis16405/run1", "gz", 800_000, 820_000)
    assert size(added(result)["resolution"], "step") == pytest.approx(0.05 * DEG, rel=1e-6)
    assert seen_at(result, 20.0, 2.0)


def test_adis16405_resolution_of_an_accelerometer() -> None:
    found = added(compared("adis16405/run1", "ax", 800_000, 820_000))
    assert size(found["resolution"], "step") == pytest.approx(3.33e-3 * G, rel=1e-4)


def test_adis16405_accelerometer_line() -> None:
    assert seen_at(compared("adis16405/run1", "ax", 700_000, 760_000), 0.565, 0.02)


@pytest.mark.parametrize(("axis", "hertz"), [("gy", 37.99), ("gz", 31.0)])
def test_mpu6050_line_and_resolution(axis: str, hertz: float) -> None:
    result = compared("mpu6050-arduino/static-7min", axis)
    found = added(result)
    assert size(found["resolution"], "step") == pytest.approx(DEG / 131.0, rel=1e-5)
    assert seen_at(result, hertz, 0.02)


def test_mpu6050_without_a_line() -> None:
    assert set(added(compared("mpu6050-arduino/static-7min", "gx"))) == {"resolution"}


def test_mpu6050_resonance() -> None:
    found = added(compared("mpu6050-hosttime/static-11min", "gz"))
    assert size(found["narrowband"], "frequency") == pytest.approx(31.38, abs=0.1)
    assert "sinusoidal" not in found


def test_mpu6050_summary_begins_with_the_resonance() -> None:
    result = compared("mpu6050-hosttime/static-11min", "gz")
    first = rank_findings(result).findings[0]
    assert (first.effect, first.parameters["frequency"].value) == ("narrowband", pytest.approx(31.38, abs=0.1))
    assert first.share > 0.9
    assert any(sentence.startswith("Resonance at 31.") for sentence in summarize(result))


def test_xsens_tails() -> None:
    result = compared("xsens-mtig/contaminated-gx", "gx", 0, 100_000)
    left = {score.diagnostic for score in result.axes["gx"].left_over}
    assert "outliers" in added(result) or "tails" in left
    assert result.verdict != "agrees"


def test_px4_line_by_the_nominal_rate() -> None:
    # 116.13 Hz by the time stamps; the file says 250 Hz, and 248.56 samples came a second
    assert seen_at(compared("px4-bench/bench-69s", "gx", 2000, 8000), 116.13 * 250.0 / 248.56, 0.15)


def test_vn100_line_that_comes_and_goes() -> None:
    result = compared("vn100-serial/static-12min", "az", 10_000, 24_000)
    assert seen_at(result, 13.38, 0.05)
    assert result.verdict in ("partly_explained", "unexplained")


def test_phone_resolution() -> None:
    found = added(compared("phone/gyro-a", "gx"))
    assert size(found["resolution"], "step") == pytest.approx(1e-3, rel=1e-5)
