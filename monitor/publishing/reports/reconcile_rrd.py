"""Result of a reconciliation as a Rerun recording, ``reconcile.rrd``.

Each axis has a tab with the steps as text, the gap of each diagnostic divided by the threshold, and plots of the
diagnostics. A diagnostic with logarithmic axes is drawn for the first model and for the model after the steps. The
timeline ``step`` selects the model, and index 0 is the first model. Importing this module imports Rerun.

Entities: ``/<axis>/steps``, ``/<axis>/gap/<diagnostic>``, ``/<axis>/<diagnostic>/before``,
``/<axis>/<diagnostic>/after``, ``/overview``.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, format_duration
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.reconcile_figures import (
    MAX_MARKERS,
    DiagnosticPanelCurves,
    common_y_limits,
    to_displayed_units,
)
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.rerun.allan_chart_geometry import (
    HEIGHT,
    WIDTH,
    ChartDecadeRange,
    band_outline,
    clip_to_box,
    decade_range,
    finite_sections,
)
from monitor.publishing.rerun.allan_drawing import log_grid, log_lines
from monitor.publishing.rerun.shared_views import collapsed_blueprint, drawing_view, markdown_document
from monitor.reconcile.result import AxisModelDiagnostics, AxisResult, Reconciliation
from monitor.reconcile.summary.summary_sentences import summarize

APPLICATION: Final = "imu-monitor"
TIMELINE: Final = "step"
MAX_PLOTTED_DIAGNOSTICS: Final = 2  # largest number of drawn diagnostics per axis
BAND_COLOUR: Final = axis_colours.FRAME
LEGEND_X: Final = (8.6, 12.2, 15.4)  # positions of the names of the curves, above the box
RANGE_COLOUR: Final = (230, 159, 0)  # orange, as on the HTML page
GAP_LINE_COLOURS: Final = (  # more lines would not fit into the legend
    *(axis_colours.AXIS_COLOURS[axis] for axis in AXES[:3]), axis_colours.TEMPERATURE, (190, 130, 230), (150, 160, 170),
)  # fmt: skip


def write_rrd(r: Reconciliation, path: Path, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Write the result of a reconciliation as a Rerun recording.

    Parameters
    ----------
    r
        Result of the reconciliation.
    path
        File to write.
    units
        Unit system.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    try:
        path.open("wb").close()
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
    stream = rr.RecordingStream(APPLICATION)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path, default_blueprint=blueprint(r))
    stream.log("overview", markdown_document(_overview(r, units)), static=True)
    for axis in _axes(r):
        _log_axis(stream, r, r.axes[axis], units)
    stream.flush()
    stream.disconnect()


def blueprint(r: Reconciliation) -> rrb.Blueprint:
    """Return the Rerun layout with a tab for each axis and an overview. Axes that differ from the model come first."""
    axes = sorted(_axes(r), key=lambda axis: r.axes[axis].verdict == "agrees")
    tabs: list[rrb.View | rrb.Container] = [_tab(r.axes[axis]) for axis in axes]
    tabs.append(rrb.TextDocumentView(origin="/overview", contents="$origin", name="All axes"))
    return collapsed_blueprint(rrb.Tabs(*tabs, active_tab=0), TIMELINE)


def _overview(r: Reconciliation, units: UnitSystem) -> str:
    rows = []
    for axis in _axes(r):
        result = r.axes[axis]
        steps = "; ".join(f"{step.kind} {words.describe_step(step, axis, r.baseline, units)}" for step in result.steps)
        left_over = "; ".join(words.describe_gap(one, axis, units) for one in result.left_over)
        rows.append(f"| **{axis}** | {words.RESULT_TEXTS[result.verdict]} | {steps or '—'} | {left_over or '—'} |")
    head = "| axis | verdict | changes of the model | left over |\n|:--|:--|:--|:--|"
    recorded = f"{r.samples:,} samples at {r.rate_hz:.6g} Hz, {format_duration(r.duration_s)}"
    notes = [f"note: {note}" for note in r.notes]
    faults = [f"recording: {finding.sentence}" for finding in r.recording_findings]
    title, table = f"## {words.RESULT_TEXTS[r.verdict]}", "\n".join([head, *rows])
    return "\n\n".join([title, " ".join(summarize(r)), *faults, recorded, table, *notes])


def _steps_text(r: Reconciliation, result: AxisResult, units: UnitSystem) -> str:
    parts = [f"## {result.axis}: {words.RESULT_TEXTS[result.verdict]}", words.describe_result(result)]
    for count, step in enumerate(result.steps, start=1):
        known = words.format_parameters(step, result.axis, r.baseline, units)
        parts += [
            "---",
            f"**Step {count}: {step.kind} {words.readable_name(step.effect)}** "
            f"({words.format_probability(step.confidence)})",
            "\n".join(f"- {words.readable_name(one.name)} **{one.short}**" for one in known),
            f"{words.diagnostic_name(step.before.diagnostic)}, "
            f"{words.format_range(step.before.where, result.axis, units)}: "
            f"gap **{words.format_gap(step.before.gap)} → {words.format_gap(step.after.gap)}**, "
            f"threshold {words.format_gap(step.after.threshold)}",
            step.because,
            words.describe_alternatives(step),
        ]
    if result.left_over:
        gaps = [f"- {words.describe_gap(one, result.axis, units)}" for one in result.left_over]
        parts += ["---", "**Left over**", *gaps]
    return "\n\n".join(parts)


def _axes(r: Reconciliation) -> list[str]:
    return [axis for axis in AXES if axis in r.axes]


def _snapshots_by_step(result: AxisResult) -> list[AxisModelDiagnostics]:
    return [result.start, *(step.snapshot_after for step in result.steps[:-1]), *([result.end] if result.steps else [])]


def _drawn_diagnostics(result: AxisResult) -> list[str]:
    return [view.diagnostic for view in result.start.plots if view.log][:MAX_PLOTTED_DIAGNOSTICS]


def _tab(result: AxisResult) -> rrb.Container:
    axis, steps = result.axis, len(result.steps)
    text = rrb.TextDocumentView(origin=f"/{axis}/steps", contents="$origin", name="What was found")
    gaps = rrb.TimeSeriesView(
        origin=f"/{axis}/gap",
        contents="$origin/**",
        name="Gap over its threshold, by step",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )
    left = rrb.Vertical(text, gaps, row_shares=[5, 2]) if steps else text
    rows = [
        rrb.Horizontal(
            *(_diagnostic_view(result, diagnostic, when) for when in (("before", "after") if steps else ("before",)))
        )
        for diagnostic in _drawn_diagnostics(result)
    ]
    name = f"{axis}: {words.RESULT_TEXTS[result.verdict]}"
    return rrb.Horizontal(left, rrb.Vertical(*rows), column_shares=[3, 7], name=name)


def _diagnostic_view(result: AxisResult, diagnostic: str, when: str) -> rrb.View:
    what = words.diagnostic_name(diagnostic)
    what = what[0].upper() + what[1:]
    names = {"before": f"{what}: first model", "after": f"{what}: after the steps"}
    origin = f"/{result.axis}/{diagnostic}/{when}"
    return drawing_view(origin, names[when], "$origin/**", (-2.8, WIDTH + 0.7), (-1.5, HEIGHT + 1.9))


def _log_axis(stream: rr.RecordingStream, r: Reconciliation, result: AxisResult, units: UnitSystem) -> None:
    stream.log(f"{result.axis}/steps", markdown_document(_steps_text(r, result, units)), static=True)
    for diagnostic in _drawn_diagnostics(result):
        _log_diagnostic(stream, result, diagnostic, units)
    _log_gaps(stream, result)


def _log_gaps(stream: rr.RecordingStream, result: AxisResult) -> None:
    snapshots = [
        {score.diagnostic: words.gap_to_threshold_ratio(score) for score in snapshot.gaps}
        for snapshot in _snapshots_by_step(result)
    ]
    path = f"{result.axis}/gap"
    largest = sorted(snapshots[0], key=lambda diagnostic: -max(snapshot.get(diagnostic, 0.0) for snapshot in snapshots))
    for diagnostic, tint in zip(largest, GAP_LINE_COLOURS, strict=False):
        line = rr.SeriesLines(colors=[tint], widths=[2.0], names=[words.diagnostic_name(diagnostic)])
        stream.log(f"{path}/{diagnostic}", line, static=True)
        _log_by_step(stream, f"{path}/{diagnostic}", [snapshot.get(diagnostic, np.nan) for snapshot in snapshots])
    line = rr.SeriesLines(colors=[axis_colours.GREY], widths=[1.0], names=["threshold"])
    stream.log(f"{path}/threshold", line, static=True)
    _log_by_step(stream, f"{path}/threshold", [1.0] * len(snapshots))


def _log_by_step(stream: rr.RecordingStream, path: str, values: Sequence[float]) -> None:
    steps = rr.TimeColumn(TIMELINE, sequence=range(len(values)))
    stream.send_columns(path, [steps], rr.Scalars.columns(scalars=np.array(values)))


def _log_diagnostic(stream: rr.RecordingStream, result: AxisResult, diagnostic: str, units: UnitSystem) -> None:
    axis = result.axis
    views = [
        next((view for view in snapshot.plots if view.diagnostic == diagnostic), None)
        for snapshot in _snapshots_by_step(result)
    ]
    plots = {
        step: to_displayed_units("", view, axis, None, units) for step, view in enumerate(views) if view is not None
    }
    every = list(plots.values())
    scale = ChartDecadeRange(decade_range(plot.x for plot in every), decade_range([np.array(common_y_limits(every))]))
    for when in ("before", "after") if result.steps else ("before",):
        _log_grid(stream, f"{axis}/{diagnostic}/{when}", scale, plots[0], axis)
    stream.reset_time()
    _log_curves(stream, f"{axis}/{diagnostic}/before", scale, plots[0], axis, static=True)
    _log_found_ranges(stream, f"{axis}/{diagnostic}/before", scale, result, diagnostic, units)
    for step, plot in plots.items() if result.steps else ():
        stream.set_time(TIMELINE, sequence=step)
        _log_curves(stream, f"{axis}/{diagnostic}/after", scale, plot, axis, static=False)


def _log_curves(
    stream: rr.RecordingStream, path: str, scale: ChartDecadeRange, plot: DiagnosticPanelCurves, axis: str, static: bool
) -> None:
    # A lower end of zero is drawn below the box, because zero has no logarithm.
    low, high = (scale.to_chart_positions(plot.x, np.maximum(edge, 10.0 ** scale.y[0])) for edge in (plot.lo, plot.hi))
    log = partial(stream.log, static=static)
    log_lines(log, f"{path}/band", band_outline(low, high), [BAND_COLOUR], 0.5, -20.0)
    colour, at = axis_colours.AXIS_COLOURS[axis], _inside(scale.to_chart_positions(plot.x, plot.measured))
    log_lines(log, f"{path}/measured", finite_sections(at), [colour], 0.8, 5.0)
    if len(at) <= MAX_MARKERS:
        log(f"{path}/points", rr.Points2D(at, colors=[colour], radii=rr.Radius.ui_points(3.0), draw_order=20.0))
    expected = finite_sections(_inside(scale.to_chart_positions(plot.x, plot.expected)))
    log_lines(log, f"{path}/expected", expected, [axis_colours.GREY], 1.0, 10.0)


def _log_found_ranges(
    stream: rr.RecordingStream,
    path: str,
    scale: ChartDecadeRange,
    result: AxisResult,
    diagnostic: str,
    units: UnitSystem,
) -> None:
    view = next(view for view in result.start.plots if view.diagnostic == diagnostic)
    founds = [step.before for step in result.steps] + list(result.left_over)
    marks = [
        to_displayed_units("", view, result.axis, found.where, units)
        for found in founds
        if found.diagnostic == diagnostic
    ]
    bounds = [mark.mark for mark in marks if mark.mark is not None]
    if not bounds:
        return
    one = 10.0 ** np.array([scale.y[0], scale.y[0]], float)
    ends = [np.clip(scale.to_chart_positions(np.array(bound), one)[:, 0], 0.0, WIDTH) for bound in bounds]
    frames = [np.array([[a, 0], [b, 0], [b, HEIGHT], [a, HEIGHT], [a, 0]]) for a, b in ends]
    log_lines(partial(stream.log, static=True), f"{path}/place", frames, [RANGE_COLOUR], 0.75, -5.0)


def _log_grid(
    stream: rr.RecordingStream, path: str, scale: ChartDecadeRange, plot: DiagnosticPanelCurves, axis: str
) -> None:
    log = partial(stream.log, static=True)
    key = [("measured", axis_colours.AXIS_COLOURS[axis]), ("model", axis_colours.GREY), ("95 %", BAND_COLOUR)]
    names = [(x, -0.85, name) for x, (name, _) in zip(LEGEND_X, key, strict=True)]
    strokes = [np.array([[x - 1.9, -0.42], [x - 1.2, -0.42]]) for x in LEGEND_X]
    log_lines(log, f"{path}/grid/key", strokes, [tint for _, tint in key], 2.0, 30.0)
    labels = [(WIDTH / 2, HEIGHT + 0.85, plot.x_label), (2.4, -0.85, plot.y_label), *names]
    log_grid(log, f"{path}/grid", scale, f"{path}/grid/labels", labels)


def _inside(at: Floats) -> Floats:
    """Clip a curve to the edges of the chart."""
    return np.column_stack([at[:, 0], clip_to_box(at[:, 1])])
