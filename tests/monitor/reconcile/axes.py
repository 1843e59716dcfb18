"""Noise series, axes and recordings for the tests of the search. SciPy draws the series, not the simulator."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.data_types import AXES, Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import EFFECTS, AngleRandomWalk, BiasInstability, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.reconcile.diagnostics.null_distribution import NullDistribution
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS
from monitor.reconcile.likelihood.axis_fit import Axis, RegressorCache
from monitor.reconcile.likelihood.hypothesis_fit import fit_deterministic_effects
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.search.sample_repair import build_repaired_axes

RATE_HZ = 100.0
N, B, K = 1e-4, 2e-5, 2e-6  # rad/√s, rad/s, rad/s/√s
TERMS = (AngleRandomWalk(N=N), BiasInstability(B=B), RateRandomWalk(K=K))
WHITE, WALK = TERMS[0], TERMS[2]
GYRO_AXES = ("gx", "gy", "gz")
MODEL = NoiseModel(dict.fromkeys(GYRO_AXES, TERMS), RATE_HZ)
STRICT = dict.fromkeys(DIAGNOSTICS, NullDistribution(7.0, 15.0))
"""Null quantile and threshold in nats, close to those of a true model. The hidden effects have far larger gains."""


def white(n: int, rng: np.random.Generator, size: float = N) -> Floats:
    return size * RATE_HZ**0.5 * rng.standard_normal(n)


def walk(n: int, rng: np.random.Generator, size: float = K) -> Floats:
    return size / RATE_HZ**0.5 * np.cumsum(rng.standard_normal(n))


def correlated(n: int, rng: np.random.Generator, sigma: float, time_s: float) -> Floats:
    """Draw Gauss-Markov noise by its recursion from a stationary start."""
    decay = np.exp(-1.0 / (RATE_HZ * time_s))
    drawn = rng.standard_normal(n) * sigma * np.sqrt(1.0 - decay**2)
    drawn[0] = sigma * rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -decay], drawn))


def draw_resonance(n: int, rng: np.random.Generator, sigma: float, f_hz: float, width_hz: float) -> Floats:
    """Draw a second-order autoregression with a pole at the frequency."""
    radius = np.exp(-np.pi * width_hz / RATE_HZ)
    poles = [1.0, -2.0 * radius * np.cos(2.0 * np.pi * f_hz / RATE_HZ), radius**2]
    made = lfilter([1.0], poles, rng.standard_normal(n + 5000))[5000:]
    return np.asarray(sigma * made / made.std())


def time_s(n: int) -> Floats:
    return np.arange(n) / RATE_HZ


def make_temperature(n: int) -> Floats:
    """Return an oscillating temperature with a drift in °C, shape [n]."""
    t = np.arange(n) / n
    return 25.0 + 3.0 * np.sin(2.0 * np.pi * 1.7 * t) + 2.0 * t


def axes(
    values: Mapping[str, Floats],
    effects: Mapping[str, tuple[Effect, ...]] | tuple[Effect, ...] = (),
    temperature_c: Floats | None = None,
    seed: int = 0,
) -> dict[str, Axis]:
    """Prepare the axes of a recording for the search."""
    n = next(iter(values.values())).size
    each = effects if isinstance(effects, Mapping) else dict.fromkeys(values, effects)
    given = RecordedAxes(values, RATE_HZ, temperature_c)
    return build_repaired_axes(given, each, RegressorCache(n, RATE_HZ, temperature_c), np.random.default_rng(seed))


def axis(y: Floats, effects: tuple[Effect, ...] = (), temperature_c: Floats | None = None) -> Axis:
    """Prepare a recording with a single axis for the search."""
    return axes({"gz": y}, effects, temperature_c)["gz"]


def whiten(one: Axis, effects: tuple[Effect, ...]) -> WhitenedAxis:
    """Whiten an axis by a model without fitting its parameters."""
    return whiten_axis(fit_deterministic_effects(one, effects))


def recording(
    model: NoiseModel, n: int, seed: int, temperature_c: Floats | None = None, names: tuple[str, ...] = GYRO_AXES
) -> RecordedAxes:
    """Return a recording that the simulator has drawn."""
    drawn = model.simulate(n, RATE_HZ, seed, temperature_c)
    return RecordedAxes({name: drawn[:, AXES.index(name)].copy() for name in names}, RATE_HZ, temperature_c)


# --- the contract of report.json

VERDICTS = {"agrees", "explained", "partly_explained", "unexplained"}
SCORE = {"lens", "where", "gap", "null95", "threshold"}


def check_report(report: dict[str, Any]) -> None:
    """Check a report with a verdict against the schema imu-monitor/reconcile/1."""
    assert report["schema"] == "imu-monitor/reconcile/1"
    assert report["verdict"] in VERDICTS
    assert report["axes"]
    assert 1 <= len(report["summary"]) <= 5
    shares = [one["share"] for one in (*report["findings"], *report["remaining"])]
    assert all(0.0 <= share <= 1.0 for share in shares)
    assert not shares or sum(shares) == pytest.approx(1.0 if report["gap_nats"] else 0.0)
    for name, one in report["axes"].items():
        assert name in AXES
        expected = {
            (False, False): "agrees",
            (True, False): "explained",
            (True, True): "partly_explained",
            (False, True): "unexplained",
        }
        assert one["verdict"] == expected[bool(one["steps"]), bool(one["left_over"])]
        for score in one["left_over"]:
            assert set(score) == SCORE
            assert score["lens"] in DIAGNOSTICS
            assert score["gap"] > score["threshold"]
        for step in one["steps"]:
            _check_step(step)


def _check_step(step: dict[str, Any]) -> None:
    assert set(step["found"]) == SCORE
    assert step["kind"] in ("added", "retuned", "absent")
    assert step["effect"] in EFFECTS
    assert 0.0 <= step["confidence"] <= 1.0
    allowed = set(EFFECTS[step["effect"]].__dataclass_fields__)
    assert set(step["parameters"]) <= allowed
    assert step["parameters"]
    for bounds in step["parameters"].values():
        assert isinstance(bounds["value"], float | str)
        if bounds.get("lo") is not None:
            assert bounds["lo"] <= bounds["value"] <= bounds["hi"]
    for other in step["runners_up"]:
        assert other["effect"] in EFFECTS
        assert other["effect"] != step["effect"]
        assert 0.0 < other["confidence"] <= 1.0
    assert step["confidence"] + sum(other["confidence"] for other in step["runners_up"]) <= 1.0 + 1e-9
    assert set(step["gap"]) == {"before", "after", "null95", "threshold"}
    if step["held_out_gap"] is None:
        assert step["held_out_reason"]
    else:
        assert set(step["held_out_gap"]) == set(step["gap"])
    assert step["because"].endswith(".")
