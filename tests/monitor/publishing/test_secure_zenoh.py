"""zenoh with certificates, passwords and access control: the right one gets in, every other is refused and told why.

What is tested are the files of ``config/secure``, with the folder of the certificates and the router's place filled in.
Certificates are made for each run; the router is zenoh's own, in this process.
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
from monitor.publishing.zenoh.history_client import query_histories
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from monitor.settings import loading
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing import made
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for

SECURE = CONFIG_FOLDER / "secure"
PASSWORD = "correct horse"
USERS = {"nose": PASSWORD, "reader": "hunter2", "operator": "battery", "router": "staple"}


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, what it signed, an operator that another one signed, and the users' passwords."""
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


class World:
    """A router of one of the shipped files, and files for those who want in."""

    def __init__(self, folder: Path, certificates: Path, router: str) -> None:
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self._folder, self._certificates = folder, certificates
        self.router = build_session_config({}, self.file(router))

    def file(self, shipped: str, **swaps: str) -> Path:
        """A shipped file at home here; ``swaps`` of words in it."""
        text = (SECURE / shipped).read_text("utf-8")
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

    def certified(self, who: str) -> Path:
        """Who shows the certificate of that name."""
        return self.file("watch.json5", **{"/reader.": f"/{who}."})

    def user(self, who: str, password: str) -> Path:
        """Who gives this name and password."""
        return self.file("watch-password.json5", **{'"reader"': f'"{who}"', "change-me": password})


@pytest.fixture
def by_certificate(tmp_path: Path, certificates: Path) -> Iterator[World]:
    world = World(tmp_path, certificates, "router.json5")
    with zenoh.open(world.router):
        yield world


@pytest.fixture
def by_password(tmp_path: Path, certificates: Path) -> Iterator[World]:
    world = World(tmp_path, certificates, "router-password.json5")
    with zenoh.open(world.router):
        yield world


def nothing_kept(device: str, _parameters: str) -> bytes:
    raise NotReady(f"nothing is kept of {device}")


@contextlib.contextmanager
def daemon(file: Path) -> Iterator[ZenohPublisher]:
    """A daemon's session that sends status ten times a second and answers ``reset``."""
    table = ZenohTable(mode=None, listen=None, config=file)
    out, ending = ZenohPublisher(table, ["nose"], read_history=nothing_kept), threading.Event()

    def work() -> None:
        while not ending.wait(0.1):
            out.put(topics.STATUS, "nose", StatusMessage.from_result("nose", time.time(), 0, made.health()).encode())
            while not out.commands.empty():
                out.commands.get_nowait().reply_result(b'"done"')

    worker = threading.Thread(target=work)
    out.start()
    out.set_alive("nose", True)
    worker.start()
    try:
        yield out
    finally:
        ending.set()
        worker.join()
        out.close()


def replies(file: Path, key: str) -> list[bytes]:
    with zenoh.open(build_session_config({"mode": "client"}, file)) as session:
        return [bytes(reply.ok.payload) for reply in session.get(key, timeout=PATIENCE_S) if reply.ok]


def heard(arriving: ZenohSubscriber, so_far: set[str]) -> set[str]:
    so_far |= {one.key for one in arriving.take(0.1)}
    return so_far


def refusal(file: Path) -> str:
    """What a watcher says who does not get in; nothing reaches it."""
    with contextlib.closing(ZenohSubscriber("imu/**", file=file)) as arriving:
        arriving.start()
        said = wait_for(lambda: ": " in arriving.state and arriving.state)
        assert arriving.take(0.0) == []
    assert said.count("\n") == 0
    return str(said)


# --- certificates


def test_who_has_the_right_certificate_watches_and_commands(by_certificate: World) -> None:
    with daemon(by_certificate.file("daemon.json5")) as out:
        wait_for(lambda: out.state == "ok")
        for who in ("reader", "operator"):
            with contextlib.closing(ZenohSubscriber("imu/**", file=by_certificate.certified(who))) as arriving:
                arriving.start()
                so_far: set[str] = set()
                wait_for(lambda a=arriving, s=so_far: heard(a, s) >= {"imu/nose/status", "imu/nose/alive"})
                assert arriving.state == "ok"
        operator = by_certificate.certified("operator")
        assert wait_for(lambda: replies(operator, "imu/nose/command/reset")) == [b'"done"']


@pytest.mark.parametrize("key", ["imu/nose/command/reset", "imu/*/command/*", "imu/**", "**"])
def test_a_reader_is_refused_commands(by_certificate: World, key: str) -> None:
    with daemon(by_certificate.file("daemon.json5")) as out:
        wait_for(lambda: out.state == "ok")
        operator = by_certificate.certified("operator")
        wait_for(lambda: replies(operator, "imu/nose/command/reset"))
        assert replies(by_certificate.certified("reader"), key) == []
        assert out.commands.empty()


def test_a_reader_cannot_publish(by_certificate: World) -> None:
    with (
        contextlib.closing(ZenohSubscriber("imu/**", file=by_certificate.certified("operator"))) as arriving,
        zenoh.open(build_session_config({"mode": "client"}, by_certificate.certified("reader"))) as reader,
        zenoh.open(build_session_config({"mode": "client"}, by_certificate.certified("nose"))) as nose,
    ):
        arriving.start()
        so_far: set[str] = set()

        def publish() -> bool:
            reader.put("imu/forged/status", b"forged")
            nose.put("imu/nose/status", b"true")
            return "imu/nose/status" in heard(arriving, so_far)

        wait_for(publish)
        for _ in range(5):
            publish()
        assert so_far == {"imu/nose/status"}


@pytest.mark.parametrize(
    ("swaps", "why"),
    [
        ({"/reader.": "/impostor."}, "does not accept our certificate: it is not signed by its authority"),
        ({"ca.pem": "their-ca.pem"}, "its certificate is not valid: unable to get local issuer certificate"),
        ({"enable_mtls: true": "enable_mtls: false"}, "requires a certificate of ours: set connect_certificate"),
        ({"reader.key": "nobody.key"}, "our certificates cannot be read: No such file or directory"),
        ({"tls/127": "tcp/127"}, "answers, but refuses the login"),
    ],
)
def test_the_wrong_certificate_is_refused_and_told(by_certificate: World, swaps: dict[str, str], why: str) -> None:
    file = by_certificate.file("watch.json5", **swaps)
    said = refusal(file)
    assert why in said
    assert said.startswith(json.loads(build_session_config({}, file).get_json("connect/endpoints"))[0])
    with daemon(file) as out:  # the daemon's status says the same
        wait_for(lambda: why in out.state)


# --- user and password


def test_who_knows_the_password_watches_and_commands_by_its_right(by_password: World) -> None:
    with daemon(by_password.user("nose", USERS["nose"])) as out:
        wait_for(lambda: out.state == "ok")
        reader, operator = (by_password.user(who, USERS[who]) for who in ("reader", "operator"))
        with contextlib.closing(ZenohSubscriber("imu/**", file=reader)) as arriving:
            arriving.start()
            so_far: set[str] = set()
            wait_for(lambda: "imu/nose/status" in heard(arriving, so_far))
        assert wait_for(lambda: replies(operator, "imu/nose/command/reset")) == [b'"done"']
        assert replies(reader, "imu/nose/command/reset") == []


@pytest.mark.parametrize(("user", "password"), [("reader", "wrong"), ("stranger", PASSWORD), ("", "")])
def test_the_wrong_password_is_refused_and_not_repeated(by_password: World, user: str, password: str) -> None:
    said = refusal(by_password.user(user, password))
    assert "answers, but refuses the login: check user and password" in said
    assert not password or password not in said


def test_the_past_is_told_to_those_who_get_in_alone(by_certificate: World) -> None:
    with daemon(by_certificate.file("daemon.json5")) as out:
        wait_for(lambda: out.state == "ok")
        operator = by_certificate.certified("operator")
        wait_for(lambda: replies(operator, "imu/nose/command/reset"))
        with pytest.raises(NotReady, match="nothing is kept of nose"):  # the daemon's own word
            query_histories(None, "nose", "", file=by_certificate.certified("reader"))
        with pytest.raises(LinkUnavailable, match="not signed by its authority"):
            query_histories(None, "nose", "", file=by_certificate.certified("impostor"))


# --- the link and the files


def test_samples_of_another_daemon_come_through_the_link_with_a_certificate(by_certificate: World) -> None:
    link = zenoh_link.build(zenoh_link.Settings(key="imu/nose/samples", config=str(by_certificate.certified("reader"))))
    link.open()
    try:
        with zenoh.open(build_session_config({"mode": "client"}, by_certificate.certified("nose"))) as nose:

            def come() -> Any:
                nose.put("imu/nose/samples", b"batch")
                return link.wait_for_chunks_or_timeout(0.1)

            assert wait_for(come)[0].data == b"batch"
    finally:
        link.close()


def test_a_link_as_client_without_the_certificate_is_told_why(by_certificate: World) -> None:
    file = by_certificate.certified("impostor")
    link = zenoh_link.build(zenoh_link.Settings(key="imu/nose/samples", mode="client", config=str(file)))
    with pytest.raises(LinkUnavailable, match="does not accept our certificate"):
        link.open()


def test_the_shipped_daemon_reads_its_files(tmp_path: Path) -> None:
    reading = loading.examine_config_file(SECURE / "daemon.toml")
    config, wrong = reading.config, reading.wrong
    assert wrong == []
    assert config is not None
    assert config.zenoh.listen is None
    for file in SECURE.glob("*.json5"):
        build_session_config({}, file)
