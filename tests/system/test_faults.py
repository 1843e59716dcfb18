"""What goes wrong around the service: what can go on goes on, and the status says what is wrong.

Every test has a second, healthy device in the same service. It must lose no sample, whatever happens to the first
device, the viewer, the disk, or whoever listens.
"""

import importlib.util
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
import zenoh

from drivers.data_types import concatenate_blocks
from tests.support.ports import free_endpoint, free_port
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import router, session
from tests.system.rig import Cable, Running, running

PERIOD_NS = 10_000_000
HEALTHY = """
[[device]]
name = "healthy"
rate = 100.0
driver = { link = "virtual", silence = 0.0 }
"""
SERIAL = """
[[device]]
name = "board"
rate = 100.0
[device.driver]
link = "serial"
port = "{port}"
decoder = "text"
decoder_options = {{ columns = ["gx"] }}
"""
NO_ZENOH = '[zenoh]\nmode = "none"\n'
NO_VIEWER = '[viewer]\nmode = "none"\n'
needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk is not installed")


@pytest.fixture(autouse=True)
def no_desktop(monkeypatch: pytest.MonkeyPatch) -> None:
    """No window and no browser is opened by a test."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@contextmanager
def healthy(folder: Path, text: str) -> Iterator[Running]:
    """A service with the healthy device, which is judged at the end."""
    with running(folder, HEALTHY + text) as run:
        counts = run.station("healthy").driver.counts
        wait_for(lambda: counts.received >= 10, "the healthy device")
        yield run
        if not run.service._stop.is_set():
            goes_on(run)
    number = (
        concatenate_blocks(run.caught.blocks["healthy"]).ticks // PERIOD_NS
    )  # TimeStartup: the place of each in what was sent
    assert counts.received == number.size
    missing = number[-1] - number[0] + 1 - number.size
    # the simulated sensor drops what a reader does not fetch in time on a loaded machine; nothing else may be missing
    assert missing <= run.station("healthy").simulated.fault_counts.dropped
    assert counts.lost + counts.bad == missing
    assert not any(event.kind == "clock_jumped" for device, event in run.caught.events if device == "healthy")
    assert run.station("healthy").ring.overflowed == 0


def goes_on(run: Running) -> None:
    """The healthy device's samples arrive, are worked on and are published, at once."""
    caught = run.caught
    before = run.station("healthy").publisher.published
    newest_ns = caught.estimates["healthy"].t_ns if "healthy" in caught.estimates else 0
    wait_for(lambda: run.station("healthy").publisher.published >= before + 50, "samples of the healthy device")
    newer = lambda: "healthy" in caught.estimates and caught.estimates["healthy"].t_ns > newest_ns  # noqa: E731
    wait_for(newer, "estimates of the healthy device")
    wait_for(lambda: caught.healths["healthy"].state == "running", "its status")


def says(run: Running, device: str, words: str) -> None:
    """The status that goes out for a device says so."""
    healths = run.caught.healths
    wait_for(
        lambda: device in healths and words in healths[device].text,
        lambda: f'"{words}"; the status says: {healths.get(device)}',
    )


def output_says(run: Running, output: str, right: Callable[[str], bool]) -> str:
    """The status of the healthy device says so of an output; returns the sentence."""
    healths = run.caught.healths

    def said() -> str | None:
        text = healths["healthy"].outputs.get(output) if "healthy" in healths else None
        return text if text is not None and right(text) else None

    return wait_for(said, lambda: f"the state of {output}; the status says: {healths.get('healthy')}") or ""


def viewer(mode: str) -> str:
    return f'[viewer]\nmode = "{mode}"\nport = {free_port()}\nweb_port = {free_port()}\n' + NO_ZENOH


def viewer_child(run: Running) -> psutil.Process:
    assert run.service.viewer is not None
    child = run.service.viewer._child
    assert child is not None
    return psutil.Process(child.pid)


# --- the viewer ------------------------------------------------------------------------------------


@needs_rerun
def test_a_frozen_viewer(tmp_path: Path) -> None:
    with healthy(tmp_path, viewer("web")) as run:
        output_says(run, "viewer", lambda text: text == "ok")
        child = viewer_child(run)
        child.send_signal(signal.SIGSTOP)
        output_says(run, "viewer", lambda text: text.startswith("stalled"))
        goes_on(run)
        child.send_signal(signal.SIGCONT)
        output_says(run, "viewer", lambda text: text == "ok")
        child.send_signal(signal.SIGSTOP)  # now for good: it must not hold up the end
        output_says(run, "viewer", lambda text: text.startswith("stalled"))
        goes_on(run)
        run.service.request_stop()
        run.join()
        wait_for(lambda: not child.is_running(), "the end of the viewer")


@needs_rerun
def test_a_viewer_that_is_killed_comes_back(tmp_path: Path) -> None:
    with healthy(tmp_path, viewer("web")) as run:
        output_says(run, "viewer", lambda text: text == "ok")
        first = viewer_child(run)
        first.kill()
        assert "-9" in output_says(run, "viewer", lambda text: text not in ("ok", "starting"))
        output_says(run, "viewer", lambda text: text == "ok")
        assert viewer_child(run).pid != first.pid


@needs_rerun
def test_a_peer_on_the_viewers_port_that_never_reads(tmp_path: Path) -> None:
    """It takes the connection and nothing more."""
    with socket.create_server(("127.0.0.1", 0), backlog=100) as silent:
        port = silent.getsockname()[1]
        with healthy(tmp_path, f'[viewer]\nmode = "native"\nport = {port}\n' + NO_ZENOH) as run:
            assert f"{port}: busy" in output_says(run, "viewer", lambda text: text not in ("ok", "starting"))


@needs_rerun
def test_a_window_waits_for_its_port_and_takes_a_viewer_that_comes(tmp_path: Path) -> None:
    from monitor.publishing.rerun import sinks

    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with healthy(tmp_path, f'[viewer]\nmode = "native"\nport = {port}\n' + NO_ZENOH) as run:
            output_says(run, "viewer", lambda text: "busy" in text)
            other.close()
            page = ("--web-viewer-port", str(free_port()))
            child = sinks.ViewerProcess(["--serve-web", "--bind", "127.0.0.1", "--port", str(port), *page])
            try:
                output_says(run, "viewer", lambda text: text == "ok")
            finally:
                child.kill()
                child.terminate()


@needs_rerun
def test_a_page_whose_ports_are_busy_takes_others(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as two:
        ports = [server.getsockname()[1] for server in (one, two)]
        text = f'[viewer]\nmode = "web"\nport = {ports[0]}\nweb_port = {ports[1]}\n' + NO_ZENOH
        with healthy(tmp_path, text) as run:
            text = output_says(run, "viewer", lambda text: text.startswith("ok"))
            assert all(f"port {port} is busy" in text for port in ports)
            assert run.service.viewer is not None
            assert run.service.viewer.url.startswith("http://127.0.0.1:")
            assert f":{ports[1]}/" not in run.service.viewer.url


@needs_rerun
def test_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    """The folder is a file, which stops root too; then it is a folder."""
    folder = tmp_path / "folder"
    folder.touch()
    with healthy(tmp_path, f'[viewer]\nmode = "{folder}/live.rrd"\n' + NO_ZENOH) as run:
        assert "cannot write" in output_says(run, "viewer", lambda text: text not in ("ok", "starting"))
        folder.unlink()
        folder.mkdir()
        output_says(run, "viewer", lambda text: text == "ok")
        wait_for(lambda: (folder / "live.rrd").stat().st_size > 10_000, "what is drawn")


@needs_rerun
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from monitor.publishing.rerun import sinks

    monkeypatch.setattr(sinks, "check_regular_file", lambda path: None)  # a device stands for the full disk here
    (tmp_path / "live.rrd").symlink_to("/dev/full")
    with healthy(tmp_path, f'[viewer]\nmode = "{tmp_path}/live.rrd"\n' + NO_ZENOH) as run:
        output_says(run, "viewer", lambda text: "No space left" in text)


# --- zenoh -----------------------------------------------------------------------------------------

SLOW = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
session = zenoh.open(config)
if sys.argv[2] == "callback":
    subscriber = session.declare_subscriber("imu/**", lambda sample: (print("ready", flush=True), time.sleep(3600.0)))
else:
    subscriber = session.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(1))
    subscriber.recv()
    print("ready", flush=True)
time.sleep(3600.0)
"""
BULK = 600_000
BULK_DEVICE = """
[[device]]
name = "bulk"
rate = 1000.0
publish = "every block"
refit = "1 Hz"
driver = {{ link = "replay", path = "{path}", speed = "max" }}
"""


@contextmanager
def process(source: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    child = subprocess.Popen([sys.executable, "-c", source, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield child
    finally:
        child.kill()
        child.wait(PATIENCE_S)
        assert child.stdout is not None
        child.stdout.close()


def first_word(child: "subprocess.Popen[str]") -> str:
    assert child.stdout is not None
    return child.stdout.readline().strip()


@pytest.mark.parametrize("kind", ["channel", "callback", "stopped"])
def test_a_subscriber_that_takes_nothing(tmp_path: Path, kind: str) -> None:
    """More than any buffer on the way holds is sent past it: 34 MB."""
    path, endpoint = tmp_path / "bulk.npz", free_endpoint()
    values = np.random.default_rng(1).standard_normal((6, BULK))
    later = tmp_path / "later.npz"
    later.touch()
    np.savez(path, fs=1000.0, **dict(zip(("gx", "gy", "gz", "ax", "ay", "az"), values, strict=True)))
    zenoh_text = f'[zenoh]\nlisten = ["{endpoint}"]\n' + NO_VIEWER
    with healthy(tmp_path, BULK_DEVICE.format(path=later) + zenoh_text) as run:
        output_says(run, "zenoh", lambda text: text == "ok")
        with process(SLOW, endpoint, kind) as slow:
            assert first_word(slow) == "ready"
            if kind == "stopped":
                slow.send_signal(signal.SIGSTOP)
            path.replace(later)  # the replay tries until it is one
            bulk = run.station("bulk")
            wait_for(lambda: bulk.publisher.published == BULK, "the whole recording")
            goes_on(run)
            assert slow.poll() is None
            assert run.caught.healths["healthy"].outputs["zenoh"] == "ok"
    counts = run.station("bulk").driver.counts
    assert (counts.received, counts.lost, counts.bad, run.station("bulk").ring.overflowed) == (BULK, 0, 0, 0)


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_router_that_is_not_there_yet(tmp_path: Path, mode: str) -> None:
    endpoint = free_endpoint()
    text = f'[zenoh]\nmode = "{mode}"\nlisten = ["{free_endpoint()}"]\nconnect = ["{endpoint}"]\n'
    with healthy(tmp_path, text + NO_VIEWER) as run:
        assert endpoint in output_says(run, "zenoh", lambda text: text not in ("ok", "not open yet"))
        goes_on(run)
        for _ in range(2):  # and once more when it was restarted
            with router(endpoint) as opened:
                heard = opened.declare_subscriber("imu/healthy/status", zenoh.handlers.RingChannel(4))
                output_says(run, "zenoh", lambda text: text == "ok")
                wait_for(lambda heard=heard: heard.try_recv() is not None, "a status at the router")
            output_says(run, "zenoh", lambda text: text == f"nobody at {endpoint}; trying again")


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_a_busy_zenoh_port(tmp_path: Path, host: str) -> None:
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET
    try:
        other = socket.create_server((host.strip("[]"), 0), family=family)
    except OSError:
        pytest.skip("no IPv6 on this machine's loopback")
    with other:
        busy = f"tcp/{host}:{other.getsockname()[1]}"
        with healthy(tmp_path, f'[zenoh]\nlisten = ["{busy}"]\n' + NO_VIEWER) as run:
            said = output_says(run, "zenoh", lambda text: text.startswith("ok"))
            assert f"{busy} is busy: listening on tcp/{host}:" in said
            free = said.rsplit(" ", 1)[1]
            with session(connect=[free]) as client:
                heard = client.declare_subscriber("imu/healthy/status", zenoh.handlers.RingChannel(4))
                wait_for(lambda: heard.try_recv() is not None, "a status on the other port")


# --- links -----------------------------------------------------------------------------------------


def board(cable: Cable, silence_s: float = 0.0) -> str:
    return SERIAL.format(port=cable.port) + f"silence = {silence_s}\n" + NO_ZENOH + NO_VIEWER


def opened(run: Running) -> None:
    wait_for(lambda: run.station("board").driver.link._port is not None, "the port")


def lines(first: int, n: int) -> bytes:
    return b"".join(b"%.4f\n" % (1e-4 * i) for i in range(first, first + n))


HOLDER = """
import fcntl, sys, time
port = open(sys.argv[1], "rb", buffering=0)
fcntl.flock(port, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(3600.0)
"""


def test_a_port_held_by_another_program(tmp_path: Path) -> None:
    cable = Cable(tmp_path)
    with process(HOLDER, str(cable.port)) as holder:
        assert first_word(holder) == "held"
        with healthy(tmp_path, board(cable)) as run:
            says(run, "board", "held by another program")
            assert run.caught.healths["board"].state == "waiting"
            goes_on(run)
            holder.kill()
            opened(run)
            cable.write(lines(0, 50))
            wait_for(lambda: run.caught.healths["board"].state == "running", "the port to be used")
            assert run.caught.healths["board"].received >= 49


def test_a_link_that_goes_silent_and_comes_back(tmp_path: Path) -> None:
    cable = Cable(tmp_path)
    with healthy(tmp_path, board(cable, 0.5)) as run:
        counts = run.station("board").driver.counts
        opened(run)
        cable.write(lines(0, 50))
        wait_for(lambda: counts.received >= 49, "the first lines")
        says(run, "board", "silent for")
        assert run.caught.healths["board"].state == "lost"
        goes_on(run)
        before = counts.received

        def back() -> bool:
            cable.write(lines(50, 10))  # repeated, because an opening port discards bytes and silence ends the link
            return counts.received > before and run.caught.healths["board"].state == "running"

        wait_for(back, "lines after the silence")
        kinds = [event.kind for device, event in run.caught.events if device == "board"]
        told = [kind for kind in kinds if kind in ("link_lost", "link_back")]
        # a loaded machine may take longer than the silence until here, and the link is silent once more
        assert told[:2] == ["link_lost", "link_back"]
        assert told == ["link_lost", "link_back"] * (len(told) // 2) + ["link_lost"] * (len(told) % 2)


def clean(run: Running, cable: Cable) -> None:
    """Wait until the status has nothing to say, while lines come at the configured rate.

    Lines that come at once have another rate, and the status says so until it is known better.
    """
    begun_s, sent = time.monotonic(), 0

    def right() -> bool:
        nonlocal sent
        due = int((time.monotonic() - begun_s) * 1e9) // PERIOD_NS
        cable.write(lines(100 + sent, due - sent))
        sent = due
        return run.caught.healths["board"].text == ""

    wait_for(right, lambda: f"a clean status: {run.caught.healths['board']}")


def test_garbage_on_the_line(tmp_path: Path) -> None:
    """What another baud rate makes of the bytes: first nothing else, then good lines, then garbage again."""
    noise, cable = random.Random(1), Cable(tmp_path)
    with healthy(tmp_path, board(cable)) as run:
        counts = run.station("board").driver.counts
        opened(run)
        for _ in range(10):
            cable.write(noise.randbytes(400).replace(b"\n", b"\0"))
        says(run, "board", "bytes without a sample")
        assert run.caught.healths["board"].state == "waiting"
        goes_on(run)
        cable.write(b"\n" + lines(0, 50))
        wait_for(lambda: counts.received >= 50, "good lines")
        clean(run, cable)

        def garbage() -> bool:
            cable.write(noise.randbytes(400).replace(b"\n", b"\0"))
            return "without a sample" in run.caught.healths["board"].text

        wait_for(garbage, "the status to say that samples come no more")
        goes_on(run)
        before = counts.received
        cable.write(b"\n" + lines(50, 50))
        wait_for(lambda: counts.received >= before + 50, "good lines again")
        clean(run, cable)


def test_a_tau_that_the_found_rate_makes_impossible(tmp_path: Path) -> None:
    """Known only once the rate is: the device's samples go on without an estimate."""
    text = '[[device]]\nname = "odd"\ntau = [0.001]\ndriver = { link = "virtual", seed = 2 }\n'
    with healthy(tmp_path, text + NO_ZENOH + NO_VIEWER) as run:
        says(run, "odd", "no estimate: tau: none of [0.001] s")
        published = run.station("odd").publisher.published
        wait_for(lambda: run.station("odd").publisher.published > published, "its samples")
