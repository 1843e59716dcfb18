"""Tests of the table of result kinds: messages, drawings, sizes and merging."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.common import topics
from monitor.estimation.estimate import CoefficientsAfterEachSample
from monitor.publishing.messages import results
from monitor.publishing.messages.message import Message
from monitor.publishing.result_kinds import (
    RESULT_KINDS,
    TimedResult,
    keep_all,
    keep_newest,
    keep_newest_and_spaced,
    kind_of,
)
from tests.monitor.publishing import example_results


def test_each_result_and_message_is_in_one_row() -> None:
    assert len({kind.result for kind in RESULT_KINDS}) == len(RESULT_KINDS)
    published = [message for kind in RESULT_KINDS for message in kind.messages]
    assert len(set(published)) == len(published)
    known = {c for c in vars(results).values() if isinstance(c, type) and issubclass(c, Message)}
    not_published = {Message, results.SlidingWindowMessage, results.ResetReply, results.ReconcileReply}
    assert set(published) == known - not_published


def test_schema_of_a_message_is_that_of_its_topic() -> None:
    for kind in RESULT_KINDS:
        for message in kind.messages:
            assert message.__struct_config__.tag == message.topic.schema_name()
            assert message.topic.encoding == topics.JSON


def test_each_drawing_has_a_panel() -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from monitor.publishing.rerun import panels

    for kind in RESULT_KINDS:
        for drawing in kind.drawings:
            panel = getattr(panels, drawing.panel)
            assert issubclass(panel, panels.Panel)
            assert panel.draw is not panels.Panel.draw


def test_size_of_a_result_grows_with_its_arrays() -> None:
    small, large = example_results.make_estimate(seconds=20.0), example_results.make_estimate(seconds=3600.0)
    assert kind_of(small).size_bytes(small) < kind_of(large).size_bytes(large)
    assert kind_of(example_results.make_health()).size_bytes(example_results.make_health()) > 0


def merge_results(merge: object, times_s: tuple[float, ...]) -> list[float]:
    waiting: list[TimedResult] = []
    for t_s in times_s:
        merge(waiting, (t_s, example_results.make_health()))  # type: ignore[operator]
    return [t_s for t_s, _ in waiting]


def test_waiting_results_are_merged() -> None:
    times_s = (0.0, 0.3, 0.6, 0.9, 1.2, 1.5)
    assert merge_results(keep_all, times_s) == list(times_s)
    assert merge_results(keep_newest, times_s) == [1.5]
    assert merge_results(keep_newest_and_spaced, times_s) == [0.0, 0.9, 1.5]


def test_merged_estimates_keep_the_values_of_each_sample() -> None:
    waiting: list[TimedResult] = []
    for i in range(3):
        history = CoefficientsAfterEachSample(np.array([i]), np.full((1, 5, 6), float(i)))
        keep_newest_and_spaced(waiting, (0.1 * i, replace(example_results.make_estimate(), history=history)))
    assert [t_s for t_s, _ in waiting] == [0.0, pytest.approx(0.2)]
    assert waiting[-1][1].history.t_ns.tolist() == [1, 2]
