"""A daemon that is killed beside a sensor of a kilohertz: the next one goes on, and a second is missing at most."""

from pathlib import Path

import pytest

from tests.bench.kill import RATE, Bench

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")


def test_killed_in_the_middle_nothing_that_was_written_is_lost(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        kills = []
        for moment in (bench.recorded(2 * RATE), bench.has_port, bench.recorded(3 * RATE)):
            kills.append(bench.kill_when(moment))
            bench.check_files()
        rows = len(bench.ticks())
        status = bench.live(lambda: len(bench.ticks()) > rows + RATE)
    finally:
        bench.close()
    assert status == 0
    assert max(one.missing_s for one in kills) <= 1.0
    log = (tmp_path / "daemon.log").read_text()
    assert "of the window were rebuilt from the recording" in log
    assert "Traceback" not in log
    bench.check_files()
