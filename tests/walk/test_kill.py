"""A daemon that is killed beside a sensor of a kilohertz: the next one goes on, and a second is missing at most."""

from pathlib import Path

import pytest

from tests.bench.kill import RATE, Bench

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")


@pytest.mark.timeout(180)
def test_killed_in_the_middle_nothing_that_was_written_is_lost(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        kills = []
        for after_s in (5.3, 1.1, 4.4):
            kills.append(bench.kill(after_s))
            bench.check_files()
        rows = len(bench.ticks())
        status = bench.live(lambda: len(bench.ticks()) > rows + RATE, 60.0)
    finally:
        bench.close()
    assert status == 0
    assert max(one.missing_s for one in kills) <= 1.0
    log = (tmp_path / "daemon.log").read_text()
    assert "of the window were rebuilt from the recording" in log
    assert "Traceback" not in log
    bench.check_files()
