"""The outputs of a replay: nothing stands at the date of the host."""

import numpy as np

from drivers.sample import SampleBlock, block
from monitor.health import Health
from monitor.history.row import Row
from monitor.outputs import HistoryOutput, ViewerOutput
from tests.monitor.publish import made

RECORDED_S, TODAY_S = 1_600_000_000.0, 1_790_000_000.0


class Shown:
    """A viewer and a writer of history that keep the times they are given."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.times_s: list[float] = []

    def put(self, device: str, row: Row | None) -> None:
        if row is not None:
            self.rows.append(row)

    def samples(self, device: str, t_s: object, values: object, temperature_c: object) -> None:
        pass

    def health(self, device: str, unix_s: float, health: Health) -> None:
        self.times_s.append(unix_s)


def recorded() -> SampleBlock:
    t_ns = np.array([0, 10_000_000], np.int64) + round(RECORDED_S * 1e9)
    return block(t_ns, np.zeros((2, 6)), np.array([20.0, 20.0]))


def test_the_history_of_a_replay_has_the_times_of_its_published_samples_alone() -> None:
    shown = Shown()
    output = HistoryOutput(shown, ["d"])  # type: ignore[arg-type]
    output.health("d", TODAY_S, made.health(received=5))  # received, and not published yet
    output.samples("d", 2, recorded(), 0)
    output.health("d", TODAY_S, made.health(received=7))
    output.end()
    assert [row.start_s for row in shown.rows] == [round(RECORDED_S // 60 * 60)]


def test_the_viewer_of_a_replay_has_the_times_of_its_published_samples_alone() -> None:
    shown = Shown()
    output = ViewerOutput(shown, ["d"])  # type: ignore[arg-type]
    output.health("d", TODAY_S, made.health(received=5, uptime_s=1.0))
    output.samples("d", 2, recorded(), 0)
    output.health("d", TODAY_S, made.health(received=7, uptime_s=1.0))
    assert shown.times_s == [RECORDED_S + 0.01]
