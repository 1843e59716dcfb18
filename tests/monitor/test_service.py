"""What the service says of itself: where its page is, and nothing at a date that is not the samples'."""

import threading
import time
from pathlib import Path

import pytest
from rich.console import Console
from structlog.testing import capture_logs

from monitor import settings
from monitor.outputs import TableOutput
from monitor.publish.terminal import Board
from monitor.service import Service

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from tests.monitor.publish.test_rerun_view import free_port, read, wait_for

RECORDED_S = 1_600_000_000.0


def config(folder: Path, driver: str, viewer: str) -> settings.Config:
    path = folder / "config.toml"
    device = f'[[device]]\nname = "d"\nrate = 100.0\ndriver = {{ {driver} }}\n'
    path.write_text(f'{device}[zenoh]\nmode = "none"\n[viewer]\n{viewer}')
    return settings.load(path)


def test_the_page_is_told_once_in_the_log_and_stands_above_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    viewer = f'mode = "auto"\nport = {free_port()}\nweb_port = {free_port()}\n'
    board = Board()
    service = Service(config(tmp_path, 'link = "virtual"', viewer), [TableOutput(board)])
    assert service.view is not None
    thread = threading.Thread(target=service.run)
    with capture_logs() as logs:
        thread.start()
        try:
            assert wait_for(lambda: board.note != "")
            url, note = service.view.url, board.note
            time.sleep(2.5)  # more rounds of the status
            with (console := Console(width=200)).capture() as captured:
                console.print(board.table(time.monotonic()))
        finally:
            service.stop()
            thread.join(20.0)
    assert not thread.is_alive()
    assert url.startswith("http://127.0.0.1:")
    assert note == f"viewer: {url}"
    assert url in captured.get()
    assert [line["url"] for line in logs if line["event"] == "viewer"] == [url]


def test_a_recording_of_long_ago_leaves_nothing_at_todays_date(tmp_path: Path) -> None:
    path = tmp_path / "view.rrd"
    rows = [f"{RECORDED_S + i / 100:.2f},{0.1 * (-1) ** i}" for i in range(100)]
    (tmp_path / "long-ago.csv").write_text("\n".join(["t,gz", *rows]))
    service = Service(config(tmp_path, 'link = "replay", path = "long-ago.csv"', f'mode = "{path}"\n'))
    service.run(20.0)
    assert service.stations[0].driver.state == "ended"
    cells = read(path)
    assert "ENDED" in str(cells["/d/status"])
    times_s = [t / 1e9 for entity in cells.values() for t in entity.get("sample_time", []) if isinstance(t, int)]
    assert RECORDED_S <= min(times_s) <= max(times_s) <= RECORDED_S + 1.0
