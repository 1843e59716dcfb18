"""Payloads in ``examples`` were written before the messages became structs: they are still written and read so."""

import json

import pytest

from monitor.publishing.messages import analysis_json, message
from monitor.publishing.messages.history import MAX_HISTORY_BYTES
from monitor.publishing.messages.results import ReconcileReply
from tests.monitor.publishing.messages.made_messages import EXAMPLES, UNIX_S, messages

MESSAGES = messages()


def stored(name: str) -> bytes:
    return (EXAMPLES / f"{name}.json").read_bytes().rstrip()


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_written_as_it_was(name: str) -> None:
    assert MESSAGES[name].encode() == stored(name)


@pytest.mark.parametrize("name", [name for name in MESSAGES if not name.startswith("analyze")])
def test_a_message_that_is_read_and_written_again_is_the_same(name: str) -> None:
    found = message.decode_message(type(MESSAGES[name]), stored(name), MAX_HISTORY_BYTES)  # type: ignore[type-var]
    assert found.encode() == stored(name)  # type: ignore[attr-defined]


def test_a_reconcile_reply_has_the_keys_of_the_report() -> None:
    report = {"schema": "x", "verdict": "agrees", "axes": {"gz": {}}}
    head = ReconcileReply(device="bench-1", t=UNIX_S, samples=7)
    assert head.encode_report(report, 0, "/reports/a") == stored("reconcile")


def test_every_example_is_compared() -> None:
    assert {path.stem for path in EXAMPLES.iterdir()} == set(MESSAGES) | {"reconcile"}


def test_the_schema_of_an_analysis_is_its_tag() -> None:
    assert (
        json.loads(stored("analyze"))["schema"]
        == json.loads(stored("analyze_failed"))["schema"]
        == analysis_json.SCHEMA
    )
