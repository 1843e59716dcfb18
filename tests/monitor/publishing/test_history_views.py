"""Tests of the history as tables, plots and files."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from drivers.data_types import AXES
from drivers.errors import ConfigError, NotReady
from drivers.recordings.formats import WRITABLE_TABLES
from monitor.common.unit_formatting import UNIT_SYSTEMS, coefficient_unit
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.bucketed_history import HistoryTable, build_table
from monitor.history.history_row import STATES, HistoryRow
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.plots.history_plot import save_history_plot
from monitor.publishing.reports import history_file
from monitor.publishing.terminal import history_text

T0 = 1_763_683_200  # midnight UTC
RNG = np.random.default_rng(1)
EVENT_VALUES = {"N": {"before": 1e-4, "after": 2e-4}}
EVENTS = (
    StoredEvent(T0 + 3600.0, "noise_changed", "gz noisier [not markup]", "gz", EVENT_VALUES, T0, 9.0),
    StoredEvent(T0 + 7200.0, "link_lost", "gone", represented_events=4),
)  # fmt: skip


def make_history(
    buckets: int = 48, hole: slice = slice(20, 24), axes: tuple[str, ...] = ("gx", "gz", "az")
) -> HistoryTable:
    """Return half-hour rows with one high value of N, a bounded R, a gap and lost samples."""
    names = (*(f"{axis}.{letter}" for axis in axes for letter in ("N", "B")), *(f"{axis}.R.bound" for axis in axes))
    names = (*names, *(f"{axis}.N.{end}" for axis in axes for end in ("lo", "hi")), "temperature", "gz.sigma.1")
    rows = []
    for i in np.delete(np.arange(buckets), hole).tolist():
        last = (1e-4 * (1.0 + 0.01 * RNG.standard_normal(len(names)))).astype(np.float32)
        last[names.index("temperature")] = 20.0 + i
        high = last * (5.0 if i == 7 else 1.01)
        n = np.full(len(names), 100)
        counts = (180_000, 12 if i == 9 else 0, 0, 0)
        state = STATES.index("lost" if i == 9 else "running")
        low = last * np.float32(0.99)
        rows.append(HistoryRow(T0 + 1800 * i, 1800, T0 + 1800.0 * i + 1799, names, n, low, high, last, counts, state))
    return build_table("bench-1", TimeRange(T0, T0 + 1800 * buckets), 1800, rows, EVENTS, 7)


def render_text(print_function, *arguments: object, width: int = 110) -> str:
    console = Console(width=width, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.capture() as captured:
        print_function(*arguments, console)
    console.file.close()
    return captured.get()


def test_summary_has_first_last_extremes_and_events() -> None:
    history = make_history()
    text = render_text(history_text.print_history_summary, history, AXES, ("N", "R"))
    assert "bench-1: 2025-11-21 00:00 to 2025-11-22 00:00 UTC, 44 rows of 30 min, 7,920,000 samples" in text
    n = history.select_column("gz.N")
    unit = coefficient_unit("N", "gz")
    (line,) = [line for line in text.splitlines() if line.startswith("gz N")]
    for number in (n.last[0], n.last[-1], n.low.min(), n.high.max()):
        assert unit.format_si_value(number).split()[0] in line.split()
    assert history_text.GAP in line
    assert "≤" in next(line for line in text.splitlines() if line.startswith("az R"))
    assert "temperature 19.8 … 135 °C" in text
    assert "samples 12 lost" in text
    assert "lost at some time in 1 of 44 rows" in text
    assert "2025-11-21 01:00:00  gz noisier [not markup]" in text
    assert "gone (and 3 more before it)" in text
    assert "… 5 earlier events" in text


def test_axis_history_has_one_line_per_bucket() -> None:
    text = render_text(history_text.print_axis_history, make_history(), "gz", SYMBOLS)
    lines = [line for line in text.splitlines() if line.startswith("2025-11-21")]
    assert len(lines) == 44
    assert lines[7].split()[3].startswith(f"{1e-4 * coefficient_unit('N', 'gz').factor:.1f}")
    assert "…" in lines[7]
    assert lines[9].split()[-2:] == ["12", "lost"]


def test_axis_history_of_80_columns_omits_ranges_and_keeps_all_columns() -> None:
    text = render_text(history_text.print_axis_history, make_history(), "gz", SYMBOLS, width=80)
    assert "…" not in text
    assert " ".join(text.split("\n")[1].split()) == "UTC Q µrad N °/√h B °/h K °/h/√h R °/h/h °C lost state"


def test_tables_and_plot_have_the_units_of_data_sheets(tmp_path: Path) -> None:
    history, units = make_history(), UNIT_SYSTEMS["datasheet"]
    text = render_text(
        lambda past, console: history_text.print_history_summary(past, AXES, ("N",), console, units), history
    )
    rows = [line.split() for line in text.splitlines() if line.startswith("gz N")]
    assert [row[2] for row in rows] == ["°/√h", "m°/s/√Hz"]
    first = float(history.select_column("gz.N").last[0])
    assert float(rows[1][3]) == pytest.approx(first * math.sqrt(2.0) * math.degrees(1e3), rel=0.01)
    text = render_text(
        lambda past, console: history_text.print_axis_history(past, "gz", ("N", "B"), console, units), history
    )
    assert "N °/√h" in text
    assert "N m°/s/√Hz" in text
    save_history_plot(history, tmp_path / "past.svg", units=units)
    svg = (tmp_path / "past.svg").read_text()
    assert "N, m°/s/√Hz" in svg
    assert "N, °/√h" not in svg


def test_events_without_rows_are_printed() -> None:
    history = build_table("bench-1", TimeRange(T0, T0 + 60.0), 60, [], EVENTS, 2)
    text = render_text(history_text.print_history_summary, history, AXES, SYMBOLS)
    assert "no rows between 2025-11-21 00:00:00" in text
    assert "gz noisier" in text


@pytest.mark.parametrize("suffix", WRITABLE_TABLES)
def test_file_has_every_column_with_its_unit(tmp_path: Path, suffix: str) -> None:
    history, path = make_history(), tmp_path / f"h{suffix}"
    history_file.save_history(history, path)
    columns = history_file.history_columns(history)
    assert {"t (Unix s)", "gz.N (rad/sqrt(s))", "gz.N high (rad/sqrt(s))", "az.R.bound (m/s^3)"} <= set(columns)
    np.testing.assert_array_equal(columns["gz.N high (rad/sqrt(s))"], history.select_column("gz.N").high)
    np.testing.assert_array_equal(columns["lost (samples)"], history.counts[:, 1])
    found = read_file(path, suffix)
    assert list(found) == list(columns)
    for name, column in columns.items():
        np.testing.assert_array_equal(found[name], column, name)


def read_file(path: Path, suffix: str) -> dict[str, np.ndarray]:
    """Read the file with the library of its format, as another program would."""
    if suffix == ".npz":
        with np.load(path) as data:
            return dict(data)
    if suffix in (".csv", ".csv.gz"):
        rows = np.genfromtxt(path, delimiter=",", names=None, skip_header=1)
        data = path.read_bytes()
        text = (gzip.decompress(data) if suffix == ".csv.gz" else data).decode()
        return dict(zip(text.splitlines()[0].split(","), rows.T, strict=True))
    pyarrow = pytest.importorskip("pyarrow")
    if suffix == ".parquet":
        import pyarrow.parquet

        arrow = pyarrow.parquet.read_table(path)
    else:
        import pyarrow.ipc

        opened = pyarrow.ipc.open_stream(path) if suffix == ".arrows" else pyarrow.ipc.open_file(path)
        arrow = opened.read_all()
    return {name: arrow[name].to_numpy() for name in arrow.column_names}


def test_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"tables are written as \.csv"):
        history_file.save_history(make_history(), tmp_path / "h.doc")


@pytest.mark.long
@pytest.mark.parametrize("axes", [("gx", "gz", "az"), ("az",), ("gx",)], ids=str)
def test_plot_works_for_any_axes(tmp_path: Path, axes: tuple[str, ...]) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    path = tmp_path / "h.png"
    save_history_plot(make_history(axes=axes), path)
    picture = imread(path)
    assert picture.shape[1] == (2220 if len(axes) == 3 else 1110)
    colours = np.rint(255.0 * picture).astype(np.uint8).view(np.uint32)
    assert np.unique(colours).size > 100


@pytest.mark.long
def test_plot_needs_at_least_one_row(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    save_history_plot(make_history(1, slice(0, 0)), tmp_path / "one.png")
    with pytest.raises(NotReady):
        save_history_plot(build_table("a", TimeRange(T0, T0 + 60.0), 60, [], EVENTS, 2), tmp_path / "none.png")
    with pytest.raises(ConfigError, match="cannot write"):
        save_history_plot(make_history(), tmp_path / "nowhere" / "h.png")


def test_sparkline_keeps_gaps_and_shows_a_constant_as_level() -> None:
    nan = math.nan
    t_s = np.arange(4.0)
    assert history_text.sparkline(np.array([nan] * 4), t_s, (0.0, 4.0), 4) == "····"
    assert history_text.sparkline(np.array([1.0, nan, 1.0, 1.0]), t_s, (0.0, 4.0), 4) == "▅·▅▅"
