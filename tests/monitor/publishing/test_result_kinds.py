"""The table of results: each row can be published and drawn, and what waits for a slow viewer is merged as it says."""

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
from tests.monitor.publishing import made


def test_each_kind_and_each_message_stands_in_one_row() -> None:
    assert len({kind.result for kind in RESULT_KINDS}) == len(RESULT_KINDS)
    published = [message for kind in RESULT_KINDS for message in kind.messages]
    assert len(set(published)) == len(published)
    known = {one for one in vars(results).values() if isinstance(one, type) and issubclass(one, Message)}
    answers = {Message, results.SlidingWindowMessage, results.ResetReply, results.ReconcileReply}
    assert set(published) == known - answers


def test_the_schema_of_a_message_is_that_of_its_topic() -> None:
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


def test_the_size_of_a_result_is_that_of_its_arrays() -> None:
    small, large = made.estimate(seconds=20.0), made.estimate(seconds=3600.0)
    assert kind_of(small).size_bytes(small) < kind_of(large).size_bytes(large)
    assert kind_of(made.health()).size_bytes(made.health()) > 0


def merged(merge: object, times_s: tuple[float, ...]) -> list[float]:
    waiting: list[TimedResult] = []
    for t_s in times_s:
        merge(waiting, (t_s, made.health()))  # type: ignore[operator]
    return [t_s for t_s, _ in waiting]


def test_results_that_wait_are_merged() -> None:
    times_s = (0.0, 0.3, 0.6, 0.9, 1.2, 1.5)
    assert merged(keep_all, times_s) == list(times_s)
    assert merged(keep_newest, times_s) == [1.5]
    assert merged(keep_newest_and_spaced, times_s) == [0.0, 0.9, 1.5]


def test_no_value_of_a_single_sample_is_lost_when_estimates_are_merged() -> None:
    waiting: list[TimedResult] = []
    for i in range(3):
        history = CoefficientsAfterEachSample(np.array([i]), np.full((1, 5, 6), float(i)))
        keep_newest_and_spaced(waiting, (0.1 * i, replace(made.estimate(), history=history)))
    assert [t_s for t_s, _ in waiting] == [0.0, pytest.approx(0.2)]
    assert waiting[-1][1].history.t_ns.tolist() == [1, 2]
