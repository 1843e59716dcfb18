"""Tests of the Rerun recording of a reconciliation: curves, steps, texts and layout."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from tests.monitor.reconcile import samples

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.reports import reconcile_rrd
from monitor.publishing.rerun.allan_chart_geometry import HEIGHT, WIDTH


def read_cells(path: Path) -> dict[str, list[object]]:
    """Map entity and component to rows; entities on the timeline also have ``<entity> step``."""
    found: dict[str, list[object]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.chunk import RrdReader

        for chunk in RrdReader(str(path)).stream():
            batch = chunk.to_record_batch()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if ":" in name or name == "step":
                    found.setdefault(f"{chunk.entity_path} {name}", []).extend(column.to_pylist())
    return found


@pytest.fixture(scope="module")
def explained_cells(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[object]]:
    path = tmp_path_factory.mktemp("rrd") / "reconcile.rrd"
    reconcile_rrd.write_rrd(samples.explained(), path)
    return read_cells(path)


def test_curves_after_each_step_are_on_the_timeline(explained_cells: dict[str, list[object]]) -> None:
    for diagnostic in ("psd", "allan"):
        for part in ("expected", "measured", "band"):
            assert sorted(set(explained_cells[f"/gz/{diagnostic}/after/{part} step"])) == [0, 1, 2]
            assert f"/gz/{diagnostic}/before/{part} step" not in explained_cells  # the curve before is static
            assert explained_cells[f"/gz/{diagnostic}/before/{part} LineStrips2D:strips"]
    assert not any(name.startswith("/gx/psd/after") for name in explained_cells)


def test_curve_is_at_its_logarithmic_position(explained_cells: dict[str, list[object]]) -> None:
    (positions,) = explained_cells["/gz/allan/before/points Points2D:positions"]
    points = np.array(positions)
    view = samples.explained().axes["gz"].start.plots[1]
    x = (np.log10(view.x) + 2.0) / 5.0 * WIDTH  # from 0.01 s to 1000 s
    assert points[:, 0] == pytest.approx(x, abs=1e-4)
    sigma = np.log10(view.measured * np.degrees(3600.0))
    assert points[:, 1] == pytest.approx((3.0 - sigma) / 3.0 * HEIGHT, abs=1e-4)  # from 1 to 1000 °/h
    for name, rows in explained_cells.items():
        if "LineStrips2D:strips" in name and "key" not in name:
            y = np.concatenate([np.array(strip)[:, 1] for row in rows for strip in row])
            assert y.min() > -1e-4, name
            assert y.max() < HEIGHT + 1e-4, name


def test_relative_gap_of_each_diagnostic_is_plotted_over_the_steps(explained_cells: dict[str, list[object]]) -> None:
    assert np.ravel(explained_cells["/gz/gap/psd Scalars:scalars"]) == pytest.approx([41.2 / 2.6, 4.6 / 2.6, 0.6 / 2.6])
    assert np.ravel(explained_cells["/gz/gap/threshold Scalars:scalars"]).tolist() == [1.0, 1.0, 1.0]


def test_only_the_largest_gaps_of_many_diagnostics_are_plotted(tmp_path: Path) -> None:
    reconciliation = samples.unexplained()
    more = tuple(
        replace(reconciliation.axes["ax"].start.gaps[0], diagnostic=f"diagnostic_{i}", gap=0.1 * i) for i in range(30)
    )
    start = replace(reconciliation.axes["ax"].start, gaps=more)
    reconcile_rrd.write_rrd(
        replace(reconciliation, axes={"ax": replace(reconciliation.axes["ax"], start=start)}), tmp_path / "a.rrd"
    )
    shown = {name.split()[0] for name in read_cells(tmp_path / "a.rrd") if name.startswith("/ax/gap/diagnostic")}
    assert shown == {f"/ax/gap/diagnostic_{i}" for i in range(24, 30)}


def test_steps_are_described_in_words(explained_cells: dict[str, list[object]]) -> None:
    (text,) = np.ravel(explained_cells["/gz/steps TextDocument:text"])
    for part in (
        "**Step 1: added sinusoidal** (99.8 %)", "- amplitude **30.94 ± 0.54 °/h**", "gap **41.2 → 4.60**",
        samples.explained().axes["gz"].steps[0].because, "**Step 2: retuned angle random walk**",
    ):  # fmt: skip
        assert part in text
    (overview,) = np.ravel(explained_cells["/overview TextDocument:text"])
    assert "| **gx** | agrees | — | — |" in overview
    assert "note: 12 missing samples" in overview


def test_axes_have_units(explained_cells: dict[str, list[object]]) -> None:
    labels = np.ravel(explained_cells["/gz/psd/before/grid/labels Points2D:labels"][0])
    assert {"spectral density, (°/h)²/Hz", "frequency, Hz", "measured", "model", "95 %", "10"} <= set(labels)


def test_remaining_gap_is_framed_and_described(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    reconcile_rrd.write_rrd(samples.unexplained(), path)
    found = read_cells(path)
    ((frame,),) = found["/ax/psd/before/place LineStrips2D:strips"]
    view = samples.unexplained().axes["ax"].start.plots[0]
    left, right = np.floor(np.log10(view.x[0])), np.ceil(np.log10(view.x[-1]))
    ends = (np.log10([6.0, 11.0]) - left) / (right - left) * WIDTH
    assert sorted({x for x, _ in frame}) == pytest.approx(ends.tolist(), abs=1e-4)
    assert "**Left over**" in np.ravel(found["/ax/steps TextDocument:text"])[0]


def test_axes_with_findings_come_first() -> None:
    names = [tab.name for tab in reconcile_rrd.blueprint(samples.explained()).root_container.contents]
    assert names == ["gz: explained", *(f"{a}: agrees" for a in ("gx", "gy", "ax", "ay", "az")), "All axes"]


def test_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot write"):
        reconcile_rrd.write_rrd(samples.agrees(), tmp_path / "absent" / "a.rrd")
