"""Tests of the points that the viewer draws of the history: extremes and gaps are kept."""

from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.common.unit_formatting import COEFFICIENT_UNITS, sensor_kind
from monitor.history.bucketed_history import HistoryTable, build_table
from monitor.history.history_row import HistoryRow
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun.panels.history_points import history_points
from monitor.publishing.rerun.queued_view import RerunView
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from tests.monitor.publishing.rerun.test_queued_view import read_column_values, read_entities
from tests.support.waiting import wait_for

T0 = 1_760_000_040


def make_history(values: list[tuple[float, float, float] | None]) -> HistoryTable:
    """Each item is low, last and high of N for one minute, or None; intervals are last ± 10 %."""
    names = tuple(f"{axis}.N{end}" for end in ("", ".lo", ".hi") for axis in AXES)
    rows = []
    for i, minute in enumerate(values):
        if minute is not None:
            low, last, high = (np.repeat(np.float32([part, 0.9 * minute[1], 1.1 * minute[1]]), 6) for part in minute)
            n = np.full(len(names), 10)
            rows.append(HistoryRow(T0 + 60 * i, 60, T0 + 60.0 * i + 59, names, n, low, high, last))
    event = StoredEvent(T0 + 10.0, "noise_changed", "gz noisier", "gz", {"N": {"after": 1.5e-4}})
    return build_table("bench-1", TimeRange(T0, T0 + 60 * len(values)), 60, rows, [event], 1)


def test_only_an_extreme_beyond_the_interval_is_a_point() -> None:
    history = make_history([(0.98, 1.0, 1.02), (0.5, 1.0, 2.0), (1.0, 1.0, 1.0)])
    column_of_n = history.select_column("gz.N")
    at, values = history_points(
        history, column_of_n, history.select_column("gz.N.lo").last, history.select_column("gz.N.hi").last
    )
    np.testing.assert_allclose(at - T0, [60, 80, 100, 120, 180, 180], atol=0.01)
    np.testing.assert_array_equal(values[:, 0], np.float32([1.0, 0.5, 2.0, 1.0, 1.0, np.nan]))
    np.testing.assert_allclose(values[:-1, 1:], [[0.9, 1.1]] * 5, rtol=1e-6)


def test_minute_without_values_is_a_gap() -> None:
    history = make_history([(1.0, 1.0, 1.0), None, (1.0, 1.0, 1.0)])
    unknown = np.full(2, np.nan)
    at, values = history_points(history, history.select_column("gz.N"), unknown, unknown)
    np.testing.assert_allclose(at - T0, [60, 60, 180, 180], atol=0.01)
    np.testing.assert_array_equal(np.isnan(values[:, 0]), [False, True, False, True])
    assert np.isnan(values[:, 1:]).all()


def test_view_opens_with_the_history(tmp_path: Path) -> None:
    path, devices = tmp_path / "view.rrd", []
    history = make_history([(1.0e-4, 1.1e-4, 1.2e-4), (1.0e-4, 1.1e-4, 5e-4)])

    def read_history(device: str) -> HistoryTable | None:
        devices.append(device)
        return history if device == "bench-1" else None

    view = RerunView(
        ViewerSettings(str(path)),
        [ViewerDeviceDescription("bench-1"), ViewerDeviceDescription("bench-2")],
        read_history,
    )
    view.start()
    wait_for(lambda: view.state == "ok" and len(devices) == 2)
    view.close(10.0)
    cells = read_entities(path)
    for axis in AXES:
        shown = cells[f"/bench-1/coefficients/N/{axis}"]
        factor = COEFFICIENT_UNITS[sensor_kind(axis)]["N"].factor
        assert max(t for t in shown["sample_time"] if isinstance(t, int)) / 1e9 == pytest.approx(T0 + 120, abs=0.1)
        assert np.nanmax(read_column_values(shown, "Scalars:scalars")) == pytest.approx(5e-4 * factor, rel=1e-6)
    events = str(cells["/bench-1/events"])
    assert "- 10-09 08:" in events or "- **10-09 08:" in events
    assert "gz noisier" in events
    assert "sample_time" not in cells["/bench-2/coefficients/N/gz"]  # only the style is defined
