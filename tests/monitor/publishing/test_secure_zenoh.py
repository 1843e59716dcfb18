"""Tests of Zenoh with certificates, passwords and access control: wrong credentials are refused with a reason.

The tests use the files in ``config/secure`` with the certificate folder and the router address filled in.
The certificates are created for each run, and the router runs in this process.
"""

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import trustme
import zenoh

from drivers.errors import LinkUnavailable, NotReady
from drivers.links import zenoh_link
from drivers.zenoh.session_config import build_session_config
from monitor.common import topics
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.publishing.messages.results import StatusMessage
from monitor.publishing.zenoh.clients import query_histories
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from monitor.settings import loading
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing import example_results
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for

SECURE_FOLDER = CONFIG_FOLDER / "secure"
PASSWORD = "correct horse"
USERS = {"nose": PASSWORD, "reader": "hunter2", "operator": "battery", "router": "staple"}


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create an authority, certificates of all users, an operator signed by another authority, and passwords."""
    folder = tmp_path_factory.mktemp("certificates")
    ours, theirs = trustme.CA(), trustme.CA()
    ours.cert_pem.write_to_path(folder / "ca.pem")
    theirs.cert_pem.write_to_path(folder / "their-ca.pem")
    for name, authority in (*((name, ours) for name in USERS), ("impostor", theirs)):
        signed = authority.issue_cert("127.0.0.1", common_name="operator" if name == "impostor" else name)
        signed.private_key_pem.write_to_path(folder / f"{name}.key")
        (folder / f"{name}.pem").write_bytes(b"".join(part.bytes() for part in signed.cert_chain_pems))
    (folder / "users.txt").write_text("".join(f"{user}:{password}\n" for user, password in USERS.items()))
    return folder


class SecuredRouter:
    """A router with a shipped configuration, and files for its clients."""

    def __init__(self, folder: Path, certificates: Path, router: str) -> None:
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self._folder, self._certificates = folder, certificates
        self.router = build_session_config({}, self.make_config_file(router))

    def make_config_file(self, shipped: str, **swaps: str) -> Path:
        """Copy a shipped file with local addresses; ``swaps`` are further replacements."""
        text = (SECURE_FOLDER / shipped).read_text("utf-8")
        for old, new in {
            "/etc/imu-monitor": str(self._certificates),
            "tls/0.0.0.0:7447": self.endpoint,
            "tls/router.example:7447": self.endpoint,
            **swaps,
        }.items():
            assert old in text or old.startswith(("/", "tls/")), old
            text = text.replace(old, new)
        path = self._folder / f"{len(list(self._folder.iterdir()))}-{shipped}"
        path.write_text(text)
        return path

    def make_certificate_file(self, name: str) -> Path:
        """Return the configuration of a client with the certificate of this name."""
        return self.make_config_file("watch.json5", **{"/reader.": f"/{name}."})

    def make_password_file(self, name: str, password: str) -> Path:
        """Return the configuration of a client with this name and password."""
        return self.make_config_file("watch-password.json5", **{'"reader"': f'"{name}"', "change-me": password})


@pytest.fixture
def certificate_router(tmp_path: Path, certificates: Path) -> Iterator[SecuredRouter]:
    secured_router = SecuredRouter(tmp_path, certificates, "router.json5")
    with zenoh.open(secured_router.router):
        yield secured_router


@pytest.fixture
def password_router(tmp_path: Path, certificates: Path) -> Iterator[SecuredRouter]:
    secured_router = SecuredRouter(tmp_path, certificates, "router-password.json5")
    with zenoh.open(secured_router.router):
        yield secured_router


def refuse_history(device: str, _parameters: str) -> bytes:
    raise NotReady(f"nothing is kept of {device}")


@contextlib.contextmanager
def run_daemon(file: Path) -> Iterator[ZenohPublisher]:
    """Run a daemon's session that sends ten statuses per second and answers ``reset``."""
    table = ZenohTable(mode=None, listen=None, config=file)
    publisher, ending = ZenohPublisher(table, ["nose"], read_history=refuse_history), threading.Event()

    def send_and_answer() -> None:
        while not ending.wait(0.1):
            publisher.put(
                topics.STATUS,
                "nose",
                StatusMessage.from_result("nose", time.time(), 0, example_results.make_health()).encode(),
            )
            while not publisher.commands.empty():
                publisher.commands.get_nowait().reply_result(b'"done"')

    worker = threading.Thread(target=send_and_answer)
    publisher.start()
    publisher.set_alive("nose", True)
    worker.start()
    try:
        yield publisher
    finally:
        ending.set()
        worker.join()
        publisher.close()


def get_replies(file: Path, key: str) -> list[bytes]:
    with zenoh.open(build_session_config({"mode": "client"}, file)) as session:
        return [bytes(reply.ok.payload) for reply in session.get(key, timeout=PATIENCE_S) if reply.ok]


def collect_keys(subscriber: ZenohSubscriber, received_keys: set[str]) -> set[str]:
    received_keys |= {message.key for message in subscriber.take(0.1)}
    return received_keys


def wait_for_refusal(file: Path) -> str:
    """Return the state of a client that is refused and therefore receives nothing."""
    with contextlib.closing(ZenohSubscriber("imu/**", file=file)) as subscriber:
        subscriber.start()
        state = wait_for(lambda: ": " in subscriber.state and subscriber.state)
        assert subscriber.take(0.0) == []
    assert state.count("\n") == 0
    return str(state)


# --- certificates


def test_valid_certificate_allows_watching_and_commands(certificate_router: SecuredRouter) -> None:
    with run_daemon(certificate_router.make_config_file("daemon.json5")) as publisher:
        wait_for(lambda: publisher.state == "ok")
        for name in ("reader", "operator"):
            with contextlib.closing(
                ZenohSubscriber("imu/**", file=certificate_router.make_certificate_file(name))
            ) as subscriber:
                subscriber.start()
                received_keys: set[str] = set()
                wait_for(
                    lambda a=subscriber, s=received_keys: collect_keys(a, s) >= {"imu/nose/status", "imu/nose/alive"}
                )
                assert subscriber.state == "ok"
        operator = certificate_router.make_certificate_file("operator")
        assert wait_for(lambda: get_replies(operator, "imu/nose/command/reset")) == [b'"done"']


@pytest.mark.parametrize("key", ["imu/nose/command/reset", "imu/*/command/*", "imu/**", "**"])
def test_reader_may_not_send_commands(certificate_router: SecuredRouter, key: str) -> None:
    with run_daemon(certificate_router.make_config_file("daemon.json5")) as publisher:
        wait_for(lambda: publisher.state == "ok")
        operator = certificate_router.make_certificate_file("operator")
        wait_for(lambda: get_replies(operator, "imu/nose/command/reset"))
        assert get_replies(certificate_router.make_certificate_file("reader"), key) == []
        assert publisher.commands.empty()


def test_reader_may_not_publish(certificate_router: SecuredRouter) -> None:
    with (
        contextlib.closing(
            ZenohSubscriber("imu/**", file=certificate_router.make_certificate_file("operator"))
        ) as subscriber,
        zenoh.open(
            build_session_config({"mode": "client"}, certificate_router.make_certificate_file("reader"))
        ) as reader,
        zenoh.open(build_session_config({"mode": "client"}, certificate_router.make_certificate_file("nose"))) as nose,
    ):
        subscriber.start()
        received_keys: set[str] = set()

        def publish() -> bool:
            reader.put("imu/forged/status", b"forged")
            nose.put("imu/nose/status", b"true")
            return "imu/nose/status" in collect_keys(subscriber, received_keys)

        wait_for(publish)
        for _ in range(5):
            publish()
        assert received_keys == {"imu/nose/status"}


@pytest.mark.parametrize(
    ("swaps", "reason"),
    [
        ({"/reader.": "/impostor."}, "does not accept our certificate: it is not signed by its authority"),
        ({"ca.pem": "their-ca.pem"}, "its certificate is not valid: unable to get local issuer certificate"),
        ({"enable_mtls: true": "enable_mtls: false"}, "requires a certificate of ours: set connect_certificate"),
        ({"reader.key": "nobody.key"}, "our certificates cannot be read: No such file or directory"),
        ({"tls/127": "tcp/127"}, "answers, but refuses the login"),
    ],
)
def test_invalid_certificate_is_refused_with_a_reason(
    certificate_router: SecuredRouter, swaps: dict[str, str], reason: str
) -> None:
    file = certificate_router.make_config_file("watch.json5", **swaps)
    state = wait_for_refusal(file)
    assert reason in state
    assert state.startswith(json.loads(build_session_config({}, file).get_json("connect/endpoints"))[0])
    with run_daemon(file) as publisher:  # the status of the daemon has the same reason
        wait_for(lambda: reason in publisher.state)


# --- user and password


def test_valid_password_allows_watching_and_commands_by_role(password_router: SecuredRouter) -> None:
    with run_daemon(password_router.make_password_file("nose", USERS["nose"])) as publisher:
        wait_for(lambda: publisher.state == "ok")
        reader, operator = (password_router.make_password_file(name, USERS[name]) for name in ("reader", "operator"))
        with contextlib.closing(ZenohSubscriber("imu/**", file=reader)) as subscriber:
            subscriber.start()
            received_keys: set[str] = set()
            wait_for(lambda: "imu/nose/status" in collect_keys(subscriber, received_keys))
        assert wait_for(lambda: get_replies(operator, "imu/nose/command/reset")) == [b'"done"']
        assert get_replies(reader, "imu/nose/command/reset") == []


@pytest.mark.parametrize(("user", "password"), [("reader", "wrong"), ("stranger", PASSWORD), ("", "")])
def test_invalid_password_is_refused_and_not_repeated(password_router: SecuredRouter, user: str, password: str) -> None:
    state = wait_for_refusal(password_router.make_password_file(user, password))
    assert "answers, but refuses the login: check user and password" in state
    assert not password or password not in state


def test_history_is_answered_only_to_valid_clients(certificate_router: SecuredRouter) -> None:
    with run_daemon(certificate_router.make_config_file("daemon.json5")) as publisher:
        wait_for(lambda: publisher.state == "ok")
        operator = certificate_router.make_certificate_file("operator")
        wait_for(lambda: get_replies(operator, "imu/nose/command/reset"))
        with pytest.raises(NotReady, match="nothing is kept of nose"):  # this is the answer of the daemon
            query_histories(None, "nose", "", file=certificate_router.make_certificate_file("reader"))
        with pytest.raises(LinkUnavailable, match="not signed by its authority"):
            query_histories(None, "nose", "", file=certificate_router.make_certificate_file("impostor"))


# --- the link and the files


def test_zenoh_link_with_a_certificate_receives_samples(certificate_router: SecuredRouter) -> None:
    link = zenoh_link.build(
        zenoh_link.Settings(key="imu/nose/samples", config=str(certificate_router.make_certificate_file("reader")))
    )
    link.open()
    try:
        with zenoh.open(
            build_session_config({"mode": "client"}, certificate_router.make_certificate_file("nose"))
        ) as nose:

            def publish_and_receive() -> Any:
                nose.put("imu/nose/samples", b"batch")
                return link.wait_for_chunks_or_timeout(0.1)

            assert wait_for(publish_and_receive)[0].data == b"batch"
    finally:
        link.close()


def test_zenoh_link_without_a_valid_certificate_reports_the_reason(certificate_router: SecuredRouter) -> None:
    file = certificate_router.make_certificate_file("impostor")
    link = zenoh_link.build(zenoh_link.Settings(key="imu/nose/samples", mode="client", config=str(file)))
    with pytest.raises(LinkUnavailable, match="does not accept our certificate"):
        link.open()


def test_shipped_secure_configuration_is_valid(tmp_path: Path) -> None:
    reading = loading.examine_config_file(SECURE_FOLDER / "daemon.toml")
    config, wrong = reading.config, reading.wrong
    assert wrong == []
    assert config is not None
    assert config.zenoh.listen is None
    for file in SECURE_FOLDER.glob("*.json5"):
        build_session_config({}, file)
