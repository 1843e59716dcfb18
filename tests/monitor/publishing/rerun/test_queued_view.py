"""The live view: what reaches a recording, and that no viewer can harm the service."""

import fcntl
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.publishing.rerun import queued_view as rerun_view
from monitor.publishing.rerun.queued_view import MISSING, RerunView
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.result_kinds import SampleBatch
from tests.monitor.publishing import made
from tests.support.ports import free_port
from tests.support.waiting import FOREVER_S, PATIENCE_S, stays_true, wait_for

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun import sinks

DEVICE = [ViewerDeviceDescription("bench-1", "stim300 on a test")]
T0 = 1.76e9


@pytest.fixture
def server() -> Iterator[sinks.ViewerProcess]:
    """A Rerun server on loopback that someone else started, with ``port`` and ``web_port``."""
    port, web_port = free_port(), free_port()
    child = sinks.ViewerProcess(
        ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port)]
    )
    child.port = port  # type: ignore[attr-defined]
    wait_for(lambda: sinks.is_rerun_server(port))
    yield child
    child.kill()
    child.terminate()


def feed(view: RerunView, i: int) -> None:
    """Pass a tenth of a second of everything to the view. The calls never wait for a viewer."""
    t = T0 + 0.1 * i
    samples, estimate, health = made.samples(t, 0.1), made.estimate(t, seconds=60 + i, seed=i), made.health()
    view.put("bench-1", t, SampleBatch(*samples))
    view.put("bench-1", t, estimate)
    view.put("bench-1", t, health)


def test_a_recording_holds_what_was_shown(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(ViewerSettings(mode=str(path)), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    t, values, temperature_c = made.samples(T0, 1.0)
    estimate = made.estimate(T0 + 1)
    view.put("bench-1", T0, SampleBatch(t, values, temperature_c))
    view.put("bench-1", T0 + 1, estimate)
    view.put("bench-1", T0 + 1, Event("noise_changed", 0, "gz angle random walk rose by 47 %", axis="gz"))
    view.put("bench-1", T0 + 1, made.health())
    view.close()
    assert view.state == "closed"

    rows = read(path)
    letters = [f"/bench-1/coefficients/{letter}/{axis}" for letter in "QNBK" for axis in AXES]
    expected = {f"/bench-1/{room}/{axis}" for room in ("samples", "allan") for axis in AXES} | set(letters)
    assert expected | {"/bench-1/events", "/bench-1/temperature", "/bench-1/status"} <= rows.keys()
    gz = column(rows["/bench-1/samples/gz"], "Scalars:scalars")
    assert gz == pytest.approx(np.degrees(values[:, 2]))
    n = column(rows["/bench-1/coefficients/N/gx"], "Scalars:scalars")
    c = estimate.coefficients
    assert n == pytest.approx(np.degrees([c.value[1, 0], c.lo[1, 0], c.hi[1, 0]]) * 60)
    deviation = column(rows["/bench-1/allan/az"], "deviation")
    assert deviation == pytest.approx(np.sqrt(estimate.curve.avar[:, 5]))
    assert "08:53:21  gz angle random walk rose by 47 %" in str(rows["/bench-1/events"])
    assert "RUNNING" in str(rows["/bench-1/status"])
    times = column(rows["/bench-1/samples/ax"], "sample_time")
    assert times[[0, -1]] / 1e9 == pytest.approx([T0, T0 + 0.99], abs=1e-6)


def test_the_gap_has_a_course_and_the_model_a_line(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(
        ViewerSettings(mode=str(path)),
        [ViewerDeviceDescription("bench-1", has_model=True), ViewerDeviceDescription("plain")],
    )
    view.start()
    wait_for(lambda: view.state == "ok")
    looks = [made.look(made.estimate(T0 + i, seed=i), scale=1.1) for i in range(3)]
    for i, look in enumerate(looks):
        view.put("bench-1", T0 + 0.1 * i, look)
    view.put("bench-1", T0 + 1, made.estimate(T0 + 1))
    view.put("plain", T0 + 1, made.estimate(T0 + 1))
    view.close()
    rows = read(path)
    # within a second the newest counts
    gz = column(rows["/bench-1/gap/gz"], "Scalars:scalars")
    assert gz.tolist() == [looks[0].axes["gz"].gap, looks[2].axes["gz"].gap]
    threshold = column(rows["/bench-1/gap/threshold"], "Scalars:scalars")
    assert threshold.tolist() == [looks[0].axes["gz"].threshold] * 2
    assert (gz > threshold).all()
    strokes = [cell for cell in rows["/bench-1/allan/gz/model"]["LineStrips2D:strips"] if cell]
    assert len(strokes[-1]) > 10
    assert not [cell for cell in rows["/plain/allan/gz/model"]["LineStrips2D:strips"] if cell]
    assert not [entity for entity in rows if entity.startswith("/plain/gap/") and "Scalars:scalars" in rows[entity]]


def test_means_have_a_course_beside_what_was_expected(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(ViewerSettings(mode=str(path)), [ViewerDeviceDescription("bench-1", has_thermal=True)])
    view.start()
    wait_for(lambda: view.state == "ok")
    for i in range(3):
        view.put("bench-1", T0 + 600.0 * i, made.thermal_look(bias=1e-4 * (i + 1)))
    view.close()
    rows = read(path)
    gz = column(rows["/bench-1/thermal/gz"], "Scalars:scalars").reshape(3, 4)
    hour = np.degrees(3600.0)
    assert gz[:, 0] == pytest.approx(np.array([1e-4, 2e-4, 3e-4]) * hour)
    assert gz[:, 1:] == pytest.approx(np.tile(np.array([2.2e-4, 1.8e-4, 2.6e-4]) * hour, (3, 1)))
    assert column(rows["/bench-1/thermal/gz"], "sample_time") / 1e9 == pytest.approx(
        T0 + 600.0 * np.arange(3), abs=1e-6
    )
    az = column(rows["/bench-1/thermal/az"], "Scalars:scalars").reshape(3, 4)
    assert np.isfinite(az).tolist() == [[True, False, False, False]] * 3
    assert "Scalars:scalars" not in rows.get("/bench-1/thermal/gx", {})


def read(path: Path) -> dict[str, dict[str, list[object]]]:
    """Entity -> column -> cells of the recording, the blueprint's not among them."""
    from rerun.chunk import RrdReader

    rows: dict[str, dict[str, list[object]]] = {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="RRD file has no footer")  # on purpose, see rerun_sinks
        reader = RrdReader(str(path))
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        for name, cells in zip(batch.schema.names, batch.columns, strict=True):
            is_time = name == "sample_time"
            rows.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(
                cells.cast("int64").to_pylist() if is_time else cells.to_pylist()
            )
    return rows


def column(cells: dict[str, list[object]], name: str) -> np.ndarray:
    """All numbers of the one column whose name ends so."""
    (key,) = [k for k in cells if k == name or k.endswith(name)]
    return np.array(
        [x for cell in cells[key] if cell is not None for x in (cell if isinstance(cell, list) else [cell])]
    )


def test_a_frozen_viewer_delays_nobody_and_is_said(server: sinks.ViewerProcess) -> None:
    view = RerunView(ViewerSettings("native", port=server.port), DEVICE)  # type: ignore[attr-defined]
    view.start()
    wait_for(lambda: view.state == "ok")
    os.kill(server.pid, signal.SIGSTOP)
    given = count()
    # the server answers nothing from here on: a call that waited for it would not return
    wait_for(lambda: feed(view, next(given)) or view.state.startswith("stalled"), "the view to say that it stalls")
    feed(view, next(given))
    os.kill(server.pid, signal.SIGCONT)
    wait_for(lambda: view.state == "ok")
    view.close()


def test_a_stalled_view_counts_what_it_drops(server: sinks.ViewerProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_view, "BACKLOG_BYTES", 100_000)
    view = RerunView(ViewerSettings("native", port=server.port), DEVICE)  # type: ignore[attr-defined]
    view.start()
    wait_for(lambda: view.state == "ok")
    os.kill(server.pid, signal.SIGSTOP)
    wait_for(lambda: view.state.startswith("stalled"))
    for i in range(100):
        feed(view, i)
    wait_for(lambda: view.state.startswith("stalled") and "(0 dropped)" not in view.state)
    view.close(1.0)  # returns, although the viewer stays frozen


@pytest.mark.long
def test_a_process_with_a_frozen_viewer_exits(server: sinks.ViewerProcess) -> None:
    """Rerun's exit handler and its destructors would wait for the viewer for ever."""
    program = f"""
        import os, signal, time
        import numpy as np
        from monitor.publishing.rerun.queued_view import RerunView
        from monitor.publishing.result_kinds import SampleBatch
        from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
        view = RerunView(ViewerSettings("native", port={server.port}), [ViewerDeviceDescription("d")])
        view.start()
        while view.state != "ok":
            time.sleep(0.02)
        os.kill({server.pid}, signal.SIGSTOP)
        t = np.arange(2000) / 100
        for i in range(400):
            view.put("d", 20.0 * i, SampleBatch(t + 20.0 * i, np.random.default_rng(i).standard_normal((2000, 6)), t))
            time.sleep(0.005)
        while not view.state.startswith("stalled"):
            time.sleep(0.05)
        view.close(1.0)
        print("closed", flush=True)
    """  # type: ignore[attr-defined]
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], timeout=PATIENCE_S, capture_output=True, text=True, check=True
    )
    assert done.stdout == "closed\n"


def test_a_viewer_that_dies_is_said_and_joined_again(
    server: sinks.ViewerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_view, "RETRY_S", (0.1,))
    monkeypatch.setattr(sinks, "has_desktop", lambda: False)
    port = server.port  # type: ignore[attr-defined]
    view = RerunView(ViewerSettings("native", port=port), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    server.kill()
    wait_for(lambda: view.state != "ok")
    feed(view, 1)
    again = sinks.ViewerProcess(
        ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(free_port())]
    )
    try:
        wait_for(lambda: view.state == "ok")
        view.close()
    finally:
        again.terminate()


def test_a_window_that_was_closed_is_not_opened_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The window is played by a server that leaves with status 0 as soon as someone has looked at it."""
    monkeypatch.setattr(rerun_view, "RETRY_S", (0.05,))
    monkeypatch.setattr(sinks, "has_desktop", lambda: True)
    starts = tmp_path / "starts"
    program = tmp_path / "window"
    program.write_text(f"""#!{sys.executable}
import socket, sys
open({str(starts)!r}, "a").write("started\\n")
port = int(sys.argv[sys.argv.index("--port") + 1])
with socket.create_server(("127.0.0.1", port)) as server:
    server.accept()
""")
    program.chmod(0o755)
    monkeypatch.setattr(sinks, "viewer_program_path", lambda: program)
    view = RerunView(ViewerSettings("native", port=free_port()), DEVICE)
    view.start()
    wait_for(lambda: view.state == sinks.CLOSED)
    assert stays_true(lambda: view.state == sinks.CLOSED)  # for the time of ten more tries
    assert starts.read_text() == "started\n"
    view.close()


def test_the_page_takes_the_next_free_port_and_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sinks, "has_desktop", lambda: False)
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        busy = int(holder.getsockname()[1])
        view = RerunView(ViewerSettings("web", port=busy, web_port=free_port()), DEVICE)
        view.start()
        wait_for(lambda: f"ok, but port {busy} is busy: " in view.state, lambda: view.state)
        assert f"{busy}%2Fproxy" not in view.url
        assert view.url.startswith("http://127.0.0.1:")
        port = int(view.url.rsplit("%3A", 1)[1].split("%2F")[0])
        assert sinks.is_rerun_server(port)
        view.close()
    assert not sinks.is_listening(port)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("setpriv") is None, reason="a program ends with its parent where there is setpriv")
def test_a_killed_daemon_takes_its_viewer_along() -> None:
    port, web_port = free_port(), free_port()
    program = f"""
        import time
        from monitor.publishing.rerun.queued_view import RerunView
        from monitor.publishing.result_kinds import SampleBatch
        from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
        RerunView(ViewerSettings("web", {port}, {web_port}), [ViewerDeviceDescription("d")]).start()
        time.sleep({FOREVER_S})
    """
    with subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)]) as daemon:
        try:
            wait_for(lambda: sinks.is_rerun_server(port))
        finally:
            daemon.kill()
    wait_for(lambda: not sinks.is_listening(port))


def test_a_port_that_another_program_holds_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = int(holder.getsockname()[1])
        view = RerunView(ViewerSettings("native", port=port), DEVICE)
        view.start()
        wait_for(lambda: "busy" in view.state)
        assert view.state == f"cannot listen on {port}: busy"
        view.close()


def test_a_file_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    view = RerunView(ViewerSettings(mode=str(tmp_path / "absent" / "run.rrd")), DEVICE)
    view.start()
    wait_for(lambda: view.state.startswith("cannot write"))
    view.close()


def test_a_file_that_another_process_writes_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    path.write_bytes(b"written before")
    with path.open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        view = RerunView(ViewerSettings(mode=str(path)), DEVICE)
        view.start()
        wait_for(lambda: "another process writes this file" in view.state)
        assert path.read_bytes() == b"written before"
    wait_for(lambda: view.state == "ok")
    view.close()
    assert path.read_bytes().startswith(b"RRF")


def test_without_rerun_the_service_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # an import then fails as if it were not there
    view = RerunView(ViewerSettings("web"), DEVICE)
    view.start()
    wait_for(lambda: view.state == MISSING)
    feed(view, 1)
    view.close()


@pytest.mark.long
def test_mode_none_imports_and_starts_nothing() -> None:
    program = """
        import sys, threading
        from monitor.publishing.rerun.queued_view import RerunView
        from monitor.publishing.result_kinds import SampleBatch
        from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
        view = RerunView(ViewerSettings("none"), [ViewerDeviceDescription("d")])
        view.start()
        view.close()
        assert "rerun" not in sys.modules and threading.active_count() == 1, sys.modules.keys()
        print(view.state)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "off"
