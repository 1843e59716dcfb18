"""Tests of faults of the viewer, zenoh and serial links while the service runs.

Every fault must be reported in the status. Every test has a second, healthy device in the same service. The healthy
device must lose no sample.
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
from tests.support.zenoh_sessions import open_router, open_session
from tests.system.rig import PluggableTerminal, RunningService, run_service

PERIOD_NS = 10_000_000
HEALTHY_DEVICE = """
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
    """Prevent the viewer from opening a window or a browser."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@contextmanager
def run_with_healthy_device(folder: Path, text: str) -> Iterator[RunningService]:
    """Run a service with the healthy device, and check at the end that this device has lost no sample."""
    with run_service(folder, HEALTHY_DEVICE + text) as run:
        counts = run.worker("healthy").driver.counts
        wait_for(lambda: counts.received >= 10, "the healthy device")
        yield run
        if not run.service._stop.is_set():
            check_healthy_device_continues(run)
    # the ticks (TimeStartup) give the number of each sample among the sent samples
    number = concatenate_blocks(run.output.blocks["healthy"]).ticks // PERIOD_NS
    assert counts.received == number.size
    missing = number[-1] - number[0] + 1 - number.size
    # the simulated sensor drops samples that a loaded machine does not read in time; no other sample may be missing
    assert missing <= run.worker("healthy").simulated.fault_counts.dropped
    assert counts.lost + counts.bad == missing
    assert not any(event.kind == "clock_jumped" for device, event in run.output.events if device == "healthy")
    assert run.worker("healthy").ring.overflowed == 0


def check_healthy_device_continues(run: RunningService) -> None:
    """Wait until new samples and a new estimate of the healthy device have been published."""
    output = run.output
    before = run.worker("healthy").publisher.published
    newest_ns = output.estimates["healthy"].t_ns if "healthy" in output.estimates else 0
    wait_for(lambda: run.worker("healthy").publisher.published >= before + 50, "samples of the healthy device")
    newer = lambda: "healthy" in output.estimates and output.estimates["healthy"].t_ns > newest_ns  # noqa: E731
    wait_for(newer, "estimates of the healthy device")
    wait_for(lambda: output.healths["healthy"].state == "running", "its status")


def wait_for_status(run: RunningService, device: str, words: str) -> None:
    """Wait until the published status of a device contains ``words``."""
    healths = run.output.healths
    wait_for(
        lambda: device in healths and words in healths[device].text,
        lambda: f'"{words}"; the status says: {healths.get(device)}',
    )


def wait_for_output_state(run: RunningService, output: str, condition: Callable[[str], bool]) -> str:
    """Wait until the state of an output in the status of the healthy device fulfils ``condition``. Return the state."""
    healths = run.output.healths

    def matching_state() -> str | None:
        text = healths["healthy"].outputs.get(output) if "healthy" in healths else None
        return text if text is not None and condition(text) else None

    return wait_for(matching_state, lambda: f"the state of {output}; the status says: {healths.get('healthy')}") or ""


def viewer_config(mode: str) -> str:
    return f'[viewer]\nmode = "{mode}"\nport = {free_port()}\nweb_port = {free_port()}\n' + NO_ZENOH


def get_viewer_process(run: RunningService) -> psutil.Process:
    assert run.service.viewer is not None
    child = run.service.viewer._child
    assert child is not None
    return psutil.Process(child.pid)


# --- the viewer ------------------------------------------------------------------------------------


@needs_rerun
def test_frozen_viewer_is_reported_and_delays_no_samples(tmp_path: Path) -> None:
    with run_with_healthy_device(tmp_path, viewer_config("web")) as run:
        wait_for_output_state(run, "viewer", lambda text: text == "ok")
        child = get_viewer_process(run)
        child.send_signal(signal.SIGSTOP)
        wait_for_output_state(run, "viewer", lambda text: text.startswith("stalled"))
        check_healthy_device_continues(run)
        child.send_signal(signal.SIGCONT)
        wait_for_output_state(run, "viewer", lambda text: text == "ok")
        child.send_signal(signal.SIGSTOP)  # until the end; a stopped viewer must not delay the end of the service
        wait_for_output_state(run, "viewer", lambda text: text.startswith("stalled"))
        check_healthy_device_continues(run)
        run.service.request_stop()
        run.join()
        wait_for(lambda: not child.is_running(), "the end of the viewer")


@needs_rerun
def test_killed_viewer_is_restarted(tmp_path: Path) -> None:
    with run_with_healthy_device(tmp_path, viewer_config("web")) as run:
        wait_for_output_state(run, "viewer", lambda text: text == "ok")
        first = get_viewer_process(run)
        first.kill()
        assert "-9" in wait_for_output_state(run, "viewer", lambda text: text not in ("ok", "starting"))
        wait_for_output_state(run, "viewer", lambda text: text == "ok")
        assert get_viewer_process(run).pid != first.pid


@needs_rerun
def test_viewer_port_used_by_another_program_is_reported_as_busy(tmp_path: Path) -> None:
    """The other program accepts the connection and never reads."""
    with socket.create_server(("127.0.0.1", 0), backlog=100) as silent:
        port = silent.getsockname()[1]
        with run_with_healthy_device(tmp_path, f'[viewer]\nmode = "native"\nport = {port}\n' + NO_ZENOH) as run:
            assert f"{port}: busy" in wait_for_output_state(run, "viewer", lambda text: text not in ("ok", "starting"))


@needs_rerun
def test_native_viewer_is_used_as_soon_as_it_listens_on_a_port_that_was_busy(tmp_path: Path) -> None:
    from monitor.publishing.rerun import sinks

    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with run_with_healthy_device(tmp_path, f'[viewer]\nmode = "native"\nport = {port}\n' + NO_ZENOH) as run:
            wait_for_output_state(run, "viewer", lambda text: "busy" in text)
            other.close()
            page = ("--web-viewer-port", str(free_port()))
            child = sinks.ViewerProcess(["--serve-web", "--bind", "127.0.0.1", "--port", str(port), *page])
            try:
                wait_for_output_state(run, "viewer", lambda text: text == "ok")
            finally:
                child.kill()
                child.terminate()


@needs_rerun
def test_web_viewer_uses_other_ports_if_the_configured_ones_are_busy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as two:
        ports = [server.getsockname()[1] for server in (one, two)]
        text = f'[viewer]\nmode = "web"\nport = {ports[0]}\nweb_port = {ports[1]}\n' + NO_ZENOH
        with run_with_healthy_device(tmp_path, text) as run:
            text = wait_for_output_state(run, "viewer", lambda text: text.startswith("ok"))
            assert all(f"port {port} is busy" in text for port in ports)
            assert run.service.viewer is not None
            assert run.service.viewer.url.startswith("http://127.0.0.1:")
            assert f":{ports[1]}/" not in run.service.viewer.url


@needs_rerun
def test_viewer_file_that_cannot_be_written_is_reported_and_tried_again(tmp_path: Path) -> None:
    """The folder is first a file, in which even root cannot write, and later a folder."""
    folder = tmp_path / "folder"
    folder.touch()
    with run_with_healthy_device(tmp_path, f'[viewer]\nmode = "{folder}/live.rrd"\n' + NO_ZENOH) as run:
        assert "cannot write" in wait_for_output_state(run, "viewer", lambda text: text not in ("ok", "starting"))
        folder.unlink()
        folder.mkdir()
        wait_for_output_state(run, "viewer", lambda text: text == "ok")
        wait_for(lambda: (folder / "live.rrd").stat().st_size > 10_000, "data in the file")


@needs_rerun
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_full_disk_of_the_viewer_file_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from monitor.publishing.rerun import sinks

    monkeypatch.setattr(sinks, "check_regular_file", lambda path: None)  # /dev/full simulates the full disk
    (tmp_path / "live.rrd").symlink_to("/dev/full")
    with run_with_healthy_device(tmp_path, f'[viewer]\nmode = "{tmp_path}/live.rrd"\n' + NO_ZENOH) as run:
        wait_for_output_state(run, "viewer", lambda text: "No space left" in text)


# --- zenoh -----------------------------------------------------------------------------------------

SLOW_SUBSCRIBER = """
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
def start_python(source: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    child = subprocess.Popen([sys.executable, "-c", source, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield child
    finally:
        child.kill()
        child.wait(PATIENCE_S)
        assert child.stdout is not None
        child.stdout.close()


def read_line(child: "subprocess.Popen[str]") -> str:
    assert child.stdout is not None
    return child.stdout.readline().strip()


@pytest.mark.parametrize("kind", ["channel", "callback", "stopped"])
def test_subscriber_that_reads_nothing_delays_no_samples(tmp_path: Path, kind: str) -> None:
    """The service publishes 34 MB, which is more than all buffers on the way can hold."""
    path, endpoint = tmp_path / "bulk.npz", free_endpoint()
    values = np.random.default_rng(1).standard_normal((6, BULK))
    later = tmp_path / "later.npz"
    later.touch()
    np.savez(path, fs=1000.0, **dict(zip(("gx", "gy", "gz", "ax", "ay", "az"), values, strict=True)))
    zenoh_text = f'[zenoh]\nlisten = ["{endpoint}"]\n' + NO_VIEWER
    with run_with_healthy_device(tmp_path, BULK_DEVICE.format(path=later) + zenoh_text) as run:
        wait_for_output_state(run, "zenoh", lambda text: text == "ok")
        with start_python(SLOW_SUBSCRIBER, endpoint, kind) as slow:
            assert read_line(slow) == "ready"
            if kind == "stopped":
                slow.send_signal(signal.SIGSTOP)
            path.replace(later)  # the replay retries until the file is a recording
            bulk = run.worker("bulk")
            wait_for(lambda: bulk.publisher.published == BULK, "the whole recording")
            check_healthy_device_continues(run)
            assert slow.poll() is None
            assert run.output.healths["healthy"].outputs["zenoh"] == "ok"
    counts = run.worker("bulk").driver.counts
    assert (counts.received, counts.lost, counts.bad, run.worker("bulk").ring.overflowed) == (BULK, 0, 0, 0)


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_service_connects_as_soon_as_the_router_starts(tmp_path: Path, mode: str) -> None:
    endpoint = free_endpoint()
    text = f'[zenoh]\nmode = "{mode}"\nlisten = ["{free_endpoint()}"]\nconnect = ["{endpoint}"]\n'
    with run_with_healthy_device(tmp_path, text + NO_VIEWER) as run:
        assert endpoint in wait_for_output_state(run, "zenoh", lambda text: text not in ("ok", "not open yet"))
        check_healthy_device_continues(run)
        for _ in range(2):  # a second time for a restarted router
            with open_router(endpoint) as opened:
                subscriber = opened.declare_subscriber("imu/healthy/status", zenoh.handlers.RingChannel(4))
                wait_for_output_state(run, "zenoh", lambda text: text == "ok")
                wait_for(lambda subscriber=subscriber: subscriber.try_recv() is not None, "a status at the router")
            wait_for_output_state(run, "zenoh", lambda text: text == f"nobody at {endpoint}; trying again")


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_busy_zenoh_port_is_replaced_by_another_port(tmp_path: Path, host: str) -> None:
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET
    try:
        other = socket.create_server((host.strip("[]"), 0), family=family)
    except OSError:
        pytest.skip("no IPv6 on this machine's loopback")
    with other:
        busy = f"tcp/{host}:{other.getsockname()[1]}"
        with run_with_healthy_device(tmp_path, f'[zenoh]\nlisten = ["{busy}"]\n' + NO_VIEWER) as run:
            state = wait_for_output_state(run, "zenoh", lambda text: text.startswith("ok"))
            assert f"{busy} is busy: listening on tcp/{host}:" in state
            free = state.rsplit(" ", 1)[1]
            with open_session(connect=[free]) as client:
                subscriber = client.declare_subscriber("imu/healthy/status", zenoh.handlers.RingChannel(4))
                wait_for(lambda: subscriber.try_recv() is not None, "a status on the other port")


# --- links -----------------------------------------------------------------------------------------


def board_config(terminal: PluggableTerminal, silence_s: float = 0.0) -> str:
    return SERIAL.format(port=terminal.port) + f"silence = {silence_s}\n" + NO_ZENOH + NO_VIEWER


def wait_for_open_port(run: RunningService) -> None:
    wait_for(lambda: run.worker("board").driver.link._port is not None, "the port")


def text_lines(first: int, n: int) -> bytes:
    return b"".join(b"%.4f\n" % (1e-4 * i) for i in range(first, first + n))


LOCK_PORT = """
import fcntl, sys, time
port = open(sys.argv[1], "rb", buffering=0)
fcntl.flock(port, fcntl.LOCK_EX)
print("locked", flush=True)
time.sleep(3600.0)
"""


def test_port_locked_by_another_program_is_reported_and_opened_when_released(tmp_path: Path) -> None:
    terminal = PluggableTerminal(tmp_path)
    with start_python(LOCK_PORT, str(terminal.port)) as holder:
        assert read_line(holder) == "locked"
        with run_with_healthy_device(tmp_path, board_config(terminal)) as run:
            wait_for_status(run, "board", "held by another program")
            assert run.output.healths["board"].state == "waiting"
            check_healthy_device_continues(run)
            holder.kill()
            wait_for_open_port(run)
            terminal.write(text_lines(0, 50))
            wait_for(lambda: run.output.healths["board"].state == "running", "the port to be used")
            assert run.output.healths["board"].received >= 49


def test_silent_link_is_lost_and_recovers(tmp_path: Path) -> None:
    terminal = PluggableTerminal(tmp_path)
    with run_with_healthy_device(tmp_path, board_config(terminal, 0.5)) as run:
        counts = run.worker("board").driver.counts
        wait_for_open_port(run)
        terminal.write(text_lines(0, 50))
        wait_for(lambda: counts.received >= 49, "the first lines")
        wait_for_status(run, "board", "silent for")
        assert run.output.healths["board"].state == "lost"
        check_healthy_device_continues(run)
        before = counts.received

        def has_recovered() -> bool:
            # repeated, because opening a port discards bytes and silence closes the link
            terminal.write(text_lines(50, 10))
            return counts.received > before and run.output.healths["board"].state == "running"

        wait_for(has_recovered, "lines after the silence")
        kinds = [event.kind for device, event in run.output.events if device == "board"]
        link_events = [kind for kind in kinds if kind in ("link_lost", "link_back")]
        # a loaded machine may need longer than the silence limit until here, so the link may be lost once more
        assert link_events[:2] == ["link_lost", "link_back"]
        n = len(link_events)
        assert link_events == ["link_lost", "link_back"] * (n // 2) + ["link_lost"] * (n % 2)


def wait_for_clean_status(run: RunningService, terminal: PluggableTerminal) -> None:
    """Write lines at the configured rate until the status reports no problem.

    Lines that are written in one burst have another rate, which the status reports for a while.
    """
    begun_s, sent = time.monotonic(), 0

    def is_clean() -> bool:
        nonlocal sent
        due = int((time.monotonic() - begun_s) * 1e9) // PERIOD_NS
        terminal.write(text_lines(100 + sent, due - sent))
        sent = due
        return run.output.healths["board"].text == ""

    wait_for(is_clean, lambda: f"a clean status: {run.output.healths['board']}")


def test_undecodable_bytes_are_reported_until_valid_lines_arrive(tmp_path: Path) -> None:
    """The line carries random bytes as at a wrong baud rate, then good lines, then random bytes, then good lines."""
    noise, terminal = random.Random(1), PluggableTerminal(tmp_path)
    with run_with_healthy_device(tmp_path, board_config(terminal)) as run:
        counts = run.worker("board").driver.counts
        wait_for_open_port(run)
        for _ in range(10):
            terminal.write(noise.randbytes(400).replace(b"\n", b"\0"))
        wait_for_status(run, "board", "bytes without a sample")
        assert run.output.healths["board"].state == "waiting"
        check_healthy_device_continues(run)
        terminal.write(b"\n" + text_lines(0, 50))
        wait_for(lambda: counts.received >= 50, "good lines")
        wait_for_clean_status(run, terminal)

        def garbage_is_reported() -> bool:
            terminal.write(noise.randbytes(400).replace(b"\n", b"\0"))
            return "without a sample" in run.output.healths["board"].text

        wait_for(garbage_is_reported, "a status that reports bytes without samples")
        check_healthy_device_continues(run)
        before = counts.received
        terminal.write(b"\n" + text_lines(50, 50))
        wait_for(lambda: counts.received >= before + 50, "good lines again")
        wait_for_clean_status(run, terminal)


def test_tau_below_the_measured_sample_period_is_reported_and_samples_continue(tmp_path: Path) -> None:
    """The error becomes known with the measured rate. The samples of the device are published without an estimate."""
    text = '[[device]]\nname = "odd"\ntau = [0.001]\ndriver = { link = "virtual", seed = 2 }\n'
    with run_with_healthy_device(tmp_path, text + NO_ZENOH + NO_VIEWER) as run:
        wait_for_status(run, "odd", "no estimate: tau: none of [0.001] s")
        published = run.worker("odd").publisher.published
        wait_for(lambda: run.worker("odd").publisher.published > published, "its samples")
