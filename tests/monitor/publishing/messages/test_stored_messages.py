"""Tests that messages equal the stored payloads in ``examples``, which were written by an earlier version."""

import json

import pytest

from monitor.publishing.messages import analysis_json, message
from monitor.publishing.messages.history import MAX_HISTORY_BYTES
from monitor.publishing.messages.results import ReconcileReply
from tests.monitor.publishing.messages.example_messages import EXAMPLES, UNIX_S, make_messages

MESSAGES = make_messages()


def read_stored_payload(name: str) -> bytes:
    return (EXAMPLES / f"{name}.json").read_bytes().rstrip()


@pytest.mark.parametrize("name", MESSAGES)
def test_encoded_message_equals_the_stored_payload(name: str) -> None:
    assert MESSAGES[name].encode() == read_stored_payload(name)


@pytest.mark.parametrize("name", [name for name in MESSAGES if not name.startswith("analyze")])
def test_decoded_payload_is_encoded_to_the_same_bytes(name: str) -> None:
    found = message.decode_message(type(MESSAGES[name]), read_stored_payload(name), MAX_HISTORY_BYTES)  # type: ignore[type-var]
    assert found.encode() == read_stored_payload(name)  # type: ignore[attr-defined]


def test_reconcile_reply_has_the_keys_of_the_report() -> None:
    report = {"schema": "x", "verdict": "agrees", "axes": {"gz": {}}}
    head = ReconcileReply(device="bench-1", t=UNIX_S, samples=7)
    sent = json.loads(head.encode_report(report, 0, "/reports/a", kept_reports=20))
    stored = json.loads(read_stored_payload("reconcile"))
    assert list(sent.items()) == [*stored.items(), ("kept_reports", 20)]


def test_every_stored_payload_is_compared() -> None:
    assert {path.stem for path in EXAMPLES.iterdir()} == set(MESSAGES) | {"reconcile"}


def test_schema_of_an_analysis_is_its_tag() -> None:
    assert (
        json.loads(read_stored_payload("analyze"))["schema"]
        == json.loads(read_stored_payload("analyze_failed"))["schema"]
        == analysis_json.SCHEMA
    )
