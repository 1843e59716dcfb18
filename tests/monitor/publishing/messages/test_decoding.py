"""Tests that results survive encoding and decoding as messages, and that invalid results are refused."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.estimation.estimate import Estimate
from monitor.publishing.messages.message import Message, decode_message
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    StatusMessage,
    fitted_allan_variance,
)
from tests.monitor.publishing import example_results


def encode_and_decode(estimate: Estimate, **changed: object) -> Estimate:
    allan = json.loads(AllanMessage.from_result("a", 1.76e9, 0, estimate).encode()) | changed
    payload = CoefficientsMessage.from_result("a", 1.76e9, 0, estimate).encode()
    coefficients = decode_message(CoefficientsMessage, payload).to_coefficients()
    return decode_message(AllanMessage, json.dumps(allan).encode()).to_estimate(coefficients, frozenset())


def test_decoded_estimate_equals_the_original() -> None:
    sent = example_results.make_estimate()
    got = encode_and_decode(sent)
    for name in ("tau_s", "factors", "avar", "lo", "hi", "n"):
        assert getattr(got.curve, name) == pytest.approx(getattr(sent.curve, name), rel=1e-9, nan_ok=True), name
    for name in ("value", "lo", "hi", "status"):
        assert getattr(got.coefficients, name) == pytest.approx(
            getattr(sent.coefficients, name), rel=1e-9, nan_ok=True
        ), name
    assert (got.rate_hz, got.window_s, got.samples) == (sent.rate_hz, sent.window_s, sent.samples)
    assert got.fitted == pytest.approx(sent.fitted, rel=0.02)


class MessageWithNameOfShape(Message, frozen=True, kw_only=True, tag="counts"):
    counts: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    levels: np.ndarray[tuple[Any, ...], np.dtype[np.float64]]


def test_integers_stay_integers_whatever_the_version_of_numpy_calls_the_shape_of_arrays() -> None:
    payload = b'{"schema":"counts","device":"","t":null,"samples":0,"counts":[1,2],"levels":[1.0,null]}'
    found = decode_message(MessageWithNameOfShape, payload)
    assert found.counts.dtype == np.int64
    assert found.encode() == payload


def test_poorly_fitted_axes_are_kept_and_absent_in_older_messages() -> None:
    assert encode_and_decode(
        replace(example_results.make_estimate(), poorly_fitted_axes=("gz",))
    ).poorly_fitted_axes == ("gz",)
    older = AllanMessage.from_result("a", 1.76e9, 0, example_results.make_estimate()).encode()
    assert b"poorly" not in older
    assert encode_and_decode(example_results.make_estimate(), poorly_fitted_axes=["gx", "roll"]).poorly_fitted_axes == (
        "gx",
    )


def test_fitted_curve_follows_the_standard() -> None:
    """N alone gives σ² = N²/τ, and B alone gives (2 ln 2/π) B²."""
    coefficients = example_results.make_estimate().coefficients
    coefficients.value[:] = np.nan
    coefficients.value[1, 0] = 3.0
    coefficients.value[2, 1] = 2.0
    fitted = fitted_allan_variance(np.array([1.0, 9.0]), 1000.0, coefficients)
    assert fitted[:, 0] == pytest.approx([9.0, 1.0])
    assert fitted[:, 1] == pytest.approx([1.7651, 1.7651], rel=1e-4)
    assert np.isnan(fitted[:, 2:]).all()


@pytest.mark.parametrize(
    "changed",
    [{"tau": []}, {"tau": [2.0, 1.0]}, {"tau": [-1.0, 1.0]}, {"tau": [1.0]}, {"rate": 0.0}, {"tau": [1.0] * 2000}],
)
def test_invalid_curve_is_refused(changed: dict[str, object]) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - any message is acceptable
        encode_and_decode(example_results.make_estimate(), **changed)


@pytest.mark.parametrize(
    "changed",
    [
        {"t": 1e308}, {"t": -1e308}, {"filled": 1e308}, {"rate": 1e308}, {"rate": 1e-308},
        {"tau": [1e-300], "axes": {}}, {"tau": [1e300], "axes": {}},
        {"tau": [1.0], "axes": {"gx": {"deviation": [1e300], "lo": [1.0], "hi": [1.0]}}},
    ],
)  # fmt: skip
def test_numbers_that_overflow_are_refused(changed: dict[str, object]) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - any message is acceptable
        encode_and_decode(example_results.make_estimate(), **changed)


def test_decoded_health_and_event_equal_the_originals() -> None:
    sent = example_results.make_health(text="viewer is slow")
    got = StatusMessage.decode(StatusMessage.from_result("a", 1.0, 0, sent).encode()).to_health()
    assert got.text == "viewer is slow"
    assert (got.received, got.uptime_s, got.memory_bytes) == (sent.received, sent.uptime_s, sent.memory_bytes)
    event = Event("noise_changed", 10**18, "gz rose", "gz", {"N": {"before": 1.0, "after": 2.0}})
    read = EventMessage.decode(EventMessage.from_result("a", 1e9, 5, event).encode()).to_event()
    assert (read.kind, read.axis, read.text, read.values) == ("noise_changed", "gz", "gz rose", event.values)
    assert read.axis in AXES
