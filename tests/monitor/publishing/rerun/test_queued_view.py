"""Tests of the live view: recorded content, and viewers that block, end or are missing."""

import contextlib
import fcntl
import http.client
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.publishing.rerun import queued_view as rerun_view
from monitor.publishing.rerun.queued_view import MISSING, RerunView
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.result_kinds import SampleBatch
from tests.monitor.publishing import example_results
from tests.support.ports import free_port
from tests.support.waiting import FOREVER_S, PATIENCE_S, stays_true, wait_for

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun import blueprint, sinks

DEVICE = [ViewerDeviceDescription("bench-1", "stim300 on a test")]
T0 = 1.76e9


@pytest.fixture
def rerun_server() -> Iterator[sinks.ViewerProcess]:
    """Start a Rerun server on loopback, with ``port`` and ``web_port``, as another program would."""
    port, web_port = free_port(), free_port()
    child = sinks.ViewerProcess(
        ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port)]
    )
    child.port = port  # type: ignore[attr-defined]
    wait_for(lambda: sinks.is_rerun_server(port))
    yield child
    child.kill()
    child.terminate()


def put_results(view: RerunView, i: int) -> None:
    """Pass a tenth of a second of all results to the view. The calls never wait for a viewer."""
    t = T0 + 0.1 * i
    samples, estimate, health = (
        example_results.simulate_samples(t, 0.1),
        example_results.make_estimate(t, seconds=60 + i, seed=i),
        example_results.make_health(),
    )
    view.put("bench-1", t, SampleBatch(*samples))
    view.put("bench-1", t, estimate)
    view.put("bench-1", t, health)


def test_recording_contains_the_shown_results(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(ViewerSettings(mode=str(path)), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    t, values, temperature_c = example_results.simulate_samples(T0, 1.0)
    estimate = example_results.make_estimate(T0 + 1)
    view.put("bench-1", T0, SampleBatch(t, values, temperature_c))
    view.put("bench-1", T0 + 1, estimate)
    view.put("bench-1", T0 + 1, Event("noise_changed", 0, "gz angle random walk rose by 47 %", axis="gz"))
    view.put("bench-1", T0 + 1, example_results.make_health())
    view.close()
    assert view.state == "closed"

    rows = read_entities(path)
    letters = [f"/bench-1/coefficients/{letter}/{axis}" for letter in "QNBK" for axis in AXES]
    expected = {f"/bench-1/{part}/{axis}" for part in ("samples", "allan") for axis in AXES} | set(letters)
    assert expected | {"/bench-1/events", "/bench-1/temperature", "/bench-1/status"} <= rows.keys()
    gz = read_column_values(rows["/bench-1/samples/gz"], "Scalars:scalars")
    assert gz == pytest.approx(np.degrees(values[:, 2]))
    n = read_column_values(rows["/bench-1/coefficients/N/gx"], "Scalars:scalars")
    c = estimate.coefficients
    assert n == pytest.approx(np.degrees([c.value[1, 0], c.lo[1, 0], c.hi[1, 0]]) * 60)
    deviation = read_column_values(rows["/bench-1/allan/az"], "deviation")
    assert deviation == pytest.approx(np.sqrt(estimate.curve.avar[:, 5]))
    assert "- **10-09 08:53:21 WARN** gz angle random walk rose by 47 %" in str(rows["/bench-1/events"])
    assert "RUNNING" in str(rows["/bench-1/status"])
    times = read_column_values(rows["/bench-1/samples/ax"], "sample_time")
    assert times[[0, -1]] / 1e9 == pytest.approx([T0, T0 + 0.99], abs=1e-6)


@pytest.mark.parametrize("later_samples", [1, 2, 100])
def test_line_of_the_samples_is_interrupted_at_a_gap(tmp_path: Path, later_samples: int) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(ViewerSettings(mode=str(path)), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    for begin_s, samples in ((T0, 100), (T0 + 16.0, later_samples)):
        view.put("bench-1", begin_s, SampleBatch(*example_results.simulate_samples(begin_s, samples / 100.0)))
    view.close()
    gz = read_column_values(read_entities(path)["/bench-1/samples/gz"], "Scalars:scalars")
    assert np.flatnonzero(np.isnan(gz)).tolist() == [100]
    assert gz.size == 101 + later_samples


def test_state_before_the_first_sample_has_no_time(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(ViewerSettings(mode=str(path)), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    view.put("bench-1", np.nan, replace(example_results.make_health(), state="waiting"))
    view.close()
    rows = read_entities(path)
    assert "WAITING" in str(rows["/bench-1/waiting"])
    assert not [entity for entity, columns in rows.items() if "sample_time" in columns]


def test_layout_shows_the_state_once_its_time_is_known(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shown: list[set[str]] = []

    def build(*arguments: Any) -> Any:
        layout = build_layout(*arguments)
        shown.append({str(view.origin) for view in blueprint.list_views(layout.root_container)})
        return layout

    build_layout = blueprint.blueprint
    monkeypatch.setattr(blueprint, "blueprint", build)
    monkeypatch.setattr(rerun_view, "LAYOUT_PERIODS_S", (0.0,))
    view = RerunView(ViewerSettings(mode=str(tmp_path / "run.rrd")), DEVICE)
    view.start()
    for at_s, entity in ((np.nan, "/bench-1/waiting"), (T0, "/bench-1/status")):
        view.put("bench-1", at_s, example_results.make_health())
        wait_for(lambda entity=entity: shown and entity in shown[-1])
    view.close()


def test_gap_and_model_curve_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    view = RerunView(
        ViewerSettings(mode=str(path)),
        [ViewerDeviceDescription("bench-1", has_model=True), ViewerDeviceDescription("plain")],
    )
    view.start()
    wait_for(lambda: view.state == "ok")
    comparisons = [
        example_results.make_comparison(example_results.make_estimate(T0 + i, seed=i), scale=1.1) for i in range(3)
    ]
    for i, comparison in enumerate(comparisons):
        view.put("bench-1", T0 + 0.1 * i, comparison)
    view.put("bench-1", T0 + 1, example_results.make_estimate(T0 + 1))
    view.put("plain", T0 + 1, example_results.make_estimate(T0 + 1))
    view.close()
    rows = read_entities(path)
    # Within one second, only the newest comparison is kept.
    gaps = read_column_values(rows["/bench-1/gap/gyro"], "Scalars:scalars").reshape(-1, 4)  # gx, gy, gz, threshold
    assert gaps[:, 2].tolist() == [comparisons[0].axes["gz"].gap, comparisons[2].axes["gz"].gap]
    assert gaps[:, 3].tolist() == [comparisons[0].axes["gz"].threshold] * 2
    assert (gaps[:, 2] > gaps[:, 3]).all()
    with_model, without_model = (
        len(rows[f"/{device}/allan/gyro/curves"]["LineStrips2D:strips"][-1]) for device in ("bench-1", "plain")
    )
    assert with_model > without_model + 10
    assert not [entity for entity in rows if entity.startswith("/plain/gap/") and "Scalars:scalars" in rows[entity]]


@pytest.mark.parametrize(("units", "factor", "name"), [("imu", np.degrees(3600.0), "°/h"), ("si", 1.0, "rad/s")])
def test_thermal_means_and_predictions_are_recorded(units: str, factor: float, name: str, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    settings = ViewerSettings(mode=str(path), units=UNIT_SYSTEMS[units])
    view = RerunView(settings, [ViewerDeviceDescription("bench-1", has_thermal=True)])
    view.start()
    wait_for(lambda: view.state == "ok")
    for i in range(3):
        view.put("bench-1", T0 + 600.0 * i, example_results.make_thermal_result(bias=1e-4 * (i + 1)))
    view.close()
    rows = read_entities(path)
    gz = read_column_values(rows["/bench-1/thermal/gz"], "Scalars:scalars").reshape(3, 4)
    assert gz[:, 0] == pytest.approx(np.array([1e-4, 2e-4, 3e-4]) * factor)
    assert gz[:, 1:] == pytest.approx(np.tile(np.array([2.2e-4, 1.8e-4, 2.6e-4]) * factor, (3, 1)))
    assert f"gz bias, {name}" in str(rows["/bench-1/thermal/gz"])
    assert read_column_values(rows["/bench-1/thermal/gz"], "sample_time") / 1e9 == pytest.approx(
        T0 + 600.0 * np.arange(3), abs=1e-6
    )
    az = read_column_values(rows["/bench-1/thermal/az"], "Scalars:scalars").reshape(3, 4)
    assert np.isfinite(az).tolist() == [[True, False, False, False]] * 3
    assert "Scalars:scalars" not in rows.get("/bench-1/thermal/gx", {})


def read_entities(path: Path) -> dict[str, dict[str, list[object]]]:
    """Map entity and column to the cells of the recording, without the blueprint."""
    from rerun.chunk import RrdReader

    rows: dict[str, dict[str, list[object]]] = {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="RRD file has no footer")  # this is intended, see rerun_sinks
        reader = RrdReader(str(path))
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        for name, cells in zip(batch.schema.names, batch.columns, strict=True):
            is_time = name == "sample_time"
            rows.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(
                cells.cast("int64").to_pylist() if is_time else cells.to_pylist()
            )
    return rows


def read_column_values(cells: dict[str, list[object]], name: str) -> np.ndarray:
    """Return all numbers of the single column whose name ends with ``name``."""
    (key,) = [k for k in cells if k == name or k.endswith(name)]
    return np.array(
        [x for cell in cells[key] if cell is not None for x in (cell if isinstance(cell, list) else [cell])]
    )


def test_frozen_viewer_does_not_block_and_is_reported(rerun_server: sinks.ViewerProcess) -> None:
    view = RerunView(ViewerSettings("native", port=rerun_server.port), DEVICE)  # type: ignore[attr-defined]
    view.start()
    wait_for(lambda: view.state == "ok")
    os.kill(rerun_server.pid, signal.SIGSTOP)
    numbers = count()
    # The server answers nothing from now on, so a call that waited for it would not return.
    wait_for(
        lambda: put_results(view, next(numbers)) or view.state.startswith("stalled"), "the view to say that it stalls"
    )
    put_results(view, next(numbers))
    os.kill(rerun_server.pid, signal.SIGCONT)
    wait_for(lambda: view.state == "ok")
    view.close()


def test_stalled_view_counts_dropped_results(
    rerun_server: sinks.ViewerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_view, "BACKLOG_BYTES", 100_000)
    view = RerunView(ViewerSettings("native", port=rerun_server.port), DEVICE)  # type: ignore[attr-defined]
    view.start()
    wait_for(lambda: view.state == "ok")
    os.kill(rerun_server.pid, signal.SIGSTOP)
    wait_for(lambda: view.state.startswith("stalled"))
    for i in range(100):
        put_results(view, i)
    wait_for(lambda: view.state.startswith("stalled") and "(0 dropped)" not in view.state)
    view.close(1.0)  # returns although the viewer stays frozen


@pytest.mark.long
def test_process_with_a_frozen_viewer_exits(rerun_server: sinks.ViewerProcess) -> None:
    """Rerun's exit handler and destructors would wait for the viewer forever."""
    program = f"""
        import os, signal, time
        import numpy as np
        from monitor.publishing.rerun.queued_view import RerunView
        from monitor.publishing.result_kinds import SampleBatch
        from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
        view = RerunView(ViewerSettings("native", port={rerun_server.port}), [ViewerDeviceDescription("d")])
        view.start()
        while view.state != "ok":
            time.sleep(0.02)
        os.kill({rerun_server.pid}, signal.SIGSTOP)
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


def test_ended_viewer_is_reported_and_reconnected(
    rerun_server: sinks.ViewerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_view, "RETRY_S", (0.1,))
    monkeypatch.setattr(sinks, "has_desktop", lambda: False)
    port = rerun_server.port  # type: ignore[attr-defined]
    view = RerunView(ViewerSettings("native", port=port), DEVICE)
    view.start()
    wait_for(lambda: view.state == "ok")
    rerun_server.kill()
    wait_for(lambda: view.state != "ok")
    put_results(view, 1)
    again = sinks.ViewerProcess(
        ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(free_port())]
    )
    try:
        wait_for(lambda: view.state == "ok")
        view.close()
    finally:
        again.terminate()


def test_closed_window_is_not_opened_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A server that exits with status 0 after the first connection acts as the window."""
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
    assert stays_true(lambda: view.state == sinks.CLOSED)  # for the duration of ten more attempts
    assert starts.read_text() == "started\n"
    view.close()


def test_page_that_is_opened_late_receives_the_newest_results_first(monkeypatch: pytest.MonkeyPatch) -> None:
    import rerun as rr

    monkeypatch.setattr(sinks, "has_desktop", lambda: False)
    output = sinks.open_output(ViewerSettings("web", free_port(), free_port()), "late", lambda: False)
    try:
        names = ["walnut", "pumpkin", "kohlrabi"]  # distinct words, because the server compresses messages
        for i, name in enumerate(names):
            output.stream.set_time("sample_time", duration=float(i))
            output.stream.log(name, rr.Scalars(1.0))
            assert output.confirm_delivery(PATIENCE_S)
        assert read_entity_order(output.port or 0, names) == names[::-1]
    finally:
        output.close()


def read_entity_order(port: int, names: list[str]) -> list[str]:
    """Return the names in the order in which a Rerun server sends their first messages to a new viewer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    headers = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}
    service = sinks.PROBE_METHOD.rpartition("/")[0]
    connection.request("POST", f"{service}/ReadMessages", bytes(5), headers)
    found: list[str] = []
    with contextlib.closing(connection), connection.getresponse() as reply:
        while len(found) < len(names):
            size = int.from_bytes(reply.read(5)[1:], "big")
            message = reply.read(size)
            found += [name for name in names if name not in found and name.encode() in message]
    return found


def test_web_viewer_uses_the_next_free_port_and_releases_it(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_viewer_program_records_no_usage_statistics(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("CI", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    port, web_port = free_port(), free_port()
    child = sinks.ViewerProcess(
        ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port)]
    )
    wait_for(lambda: sinks.is_rerun_server(port))
    child.terminate()
    assert not list(tmp_path.rglob("*analytics*"))


@pytest.mark.long
@pytest.mark.skipif(shutil.which("setpriv") is None, reason="ending a program with its parent needs setpriv")
def test_killed_daemon_ends_its_viewer() -> None:
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


def test_port_used_by_another_program_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = int(holder.getsockname()[1])
        view = RerunView(ViewerSettings("native", port=port), DEVICE)
        view.start()
        wait_for(lambda: "busy" in view.state)
        assert view.state == f"cannot listen on {port}: busy"
        view.close()


def test_unwritable_file_is_reported(tmp_path: Path) -> None:
    view = RerunView(ViewerSettings(mode=str(tmp_path / "absent" / "run.rrd")), DEVICE)
    view.start()
    wait_for(lambda: view.state.startswith("cannot write"))
    view.close()


def test_file_locked_by_another_process_is_not_changed(tmp_path: Path) -> None:
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


def test_missing_rerun_does_not_stop_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # the import fails as if rerun were not installed
    view = RerunView(ViewerSettings("web"), DEVICE)
    view.start()
    wait_for(lambda: view.state == MISSING)
    put_results(view, 1)
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
