"""Result of a reconciliation as a Rerun recording, ``reconcile.rrd``, with its own layout.

Each axis has a tab. On the left are the steps as text and the gap of each diagnostic relative to its threshold. On the
right, each logarithmic diagnostic is drawn twice, with the first model and after the steps. The timeline ``step`` is
the index of the model. Index 0 is the model that was given or fitted first, and the others are the models after each
step. The right plot of a pair follows this timeline. Rerun has no logarithmic axes, so plots are drawn as lines by
``allan_chart``. The stream is separate from that of the live view. Importing this module imports Rerun.

Entities: ``/<axis>/steps``, ``/<axis>/gap/<lens>``, ``/<axis>/<lens>/before``, ``/<axis>/<lens>/after``, ``/overview``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from drivers.errors import ConfigError
from drivers.sample import AXES, Floats
from monitor.common.units import format_duration
from monitor.publishing.plots import colours
from monitor.publishing.plots.diagnostic_figure import MAX_MARKERS, DiagnosticPlot, to_field_units, value_limits
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.rerun.allan_chart import (
    FILL_STEPS,
    HEIGHT,
    WIDTH,
    Scale,
    band,
    clip,
    decades,
    finite_sections,
    grid,
)
from monitor.reconcile.result import AxisResult, DiagnosticSnapshot, Reconciliation

APPLICATION: Final = "imu-monitor"
TIMELINE: Final = "step"
MAX_PLOTTED_DIAGNOSTICS: Final = 2  # number of diagnostics drawn per axis; the first ones are used
BAND_COLOUR: Final = colours.blend(colours.FRAME, 0.55)
LEGEND_X: Final = (8.6, 12.2, 15.4)  # positions of the names of the curves, above the box
RANGE_COLOUR: Final = colours.TEMPERATURE  # orange, as on the HTML page
GAP_LINE_COLOURS: Final = (  # more lines would not fit into the legend
    *(colours.AXIS_COLOURS[axis] for axis in AXES[:3]), colours.TEMPERATURE, (190, 130, 230), (150, 160, 170),
)  # fmt: skip


def write_rrd(r: Reconciliation, path: Path) -> None:
    """Write the recording.

    Parameters
    ----------
    r
        Result of the reconciliation.
    path
        File to write.

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
    stream.log("overview", _markdown(_overview(r)), static=True)
    for axis in _axes(r):
        _log_axis(stream, r, r.axes[axis])
    stream.flush()
    stream.disconnect()


def blueprint(r: Reconciliation) -> rrb.Blueprint:
    """Return the layout: a tab per axis, those that differ from the model first, and a tab for all axes."""
    axes = sorted(_axes(r), key=lambda axis: r.axes[axis].verdict == "agrees")
    tabs: list[rrb.View | rrb.Container] = [_tab(r.axes[axis]) for axis in axes]
    tabs.append(rrb.TextDocumentView(origin="/overview", contents="$origin", name="All axes"))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _overview(r: Reconciliation) -> str:
    """Return the overview of all axes as Markdown."""
    rows = []
    for axis in _axes(r):
        result = r.axes[axis]
        steps = "; ".join(f"{step.kind} {words.describe_step(step, axis, r.baseline)}" for step in result.steps)
        left_over = "; ".join(words.describe_gap(one, axis) for one in result.left_over)
        rows.append(f"| **{axis}** | {words.RESULT_TEXTS[result.verdict]} | {steps or '—'} | {left_over or '—'} |")
    head = "| axis | verdict | added or retuned | left over |\n|:--|:--|:--|:--|"
    recorded = f"{r.samples:,} samples at {r.rate_hz:.6g} Hz, {format_duration(r.duration_s)}"
    notes = [f"note: {note}" for note in r.notes]
    faults = [f"recording: {finding.sentence}" for finding in r.recording_findings]
    title, table = f"## {words.RESULT_TEXTS[r.verdict]}", "\n".join([head, *rows])
    return "\n\n".join([title, *faults, words.summarize(r), recorded, table, *notes])


def _steps_text(r: Reconciliation, result: AxisResult) -> str:
    """Return the steps and the unexplained differences of one axis as Markdown."""
    parts = [f"## {result.axis}: {words.RESULT_TEXTS[result.verdict]}", words.describe_result(result)]
    for count, step in enumerate(result.steps, start=1):
        known = words.format_parameters(step, result.axis, r.baseline)
        parts += [
            "---",
            f"**Step {count}: {step.kind} {words.readable_name(step.effect)}** "
            f"({words.format_probability(step.confidence)})",
            "\n".join(f"- {words.readable_name(one.name)} **{one.short}**" for one in known),
            f"{words.diagnostic_name(step.found.lens)}, {words.format_range(step.found.where, result.axis)}: gap "
            f"**{words.format_gap(step.before.gap)} → {words.format_gap(step.after.gap)}**, "
            f"threshold {words.format_gap(step.after.threshold)}",
            step.because,
            words.describe_alternatives(step),
        ]
    if result.left_over:
        parts += ["---", "**Left over**", *(f"- {words.describe_gap(one, result.axis)}" for one in result.left_over)]
    return "\n\n".join(parts)


def _axes(r: Reconciliation) -> list[str]:
    """Return the axes of the result in the usual order."""
    return [axis for axis in AXES if axis in r.axes]


def _snapshots_by_step(result: AxisResult) -> list[DiagnosticSnapshot]:
    """Return the diagnostics with the first model and after each step; the last one excludes withdrawn effects."""
    return [result.start, *(step.look for step in result.steps[:-1]), *([result.end] if result.steps else [])]


def _drawn_diagnostics(result: AxisResult) -> list[str]:
    """Return the logarithmic diagnostics of an axis that are drawn."""
    return [view.lens for view in result.start.views if view.log][:MAX_PLOTTED_DIAGNOSTICS]


def _tab(result: AxisResult) -> rrb.Container:
    """Return the tab of one axis."""
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
            *(_diagnostic_view(result, lens, when) for when in (("before", "after") if steps else ("before",)))
        )
        for lens in _drawn_diagnostics(result)
    ]
    name = f"{axis}: {words.RESULT_TEXTS[result.verdict]}"
    return rrb.Horizontal(left, rrb.Vertical(*rows), column_shares=[3, 7], name=name)


def _diagnostic_view(result: AxisResult, lens: str, when: str) -> rrb.View:
    """Return the view of one diagnostic, before or after the steps."""
    what = words.diagnostic_name(lens)
    what = what[0].upper() + what[1:]
    names = {"before": f"{what}: beside the first model", "after": f"{what}: after the steps"}
    return rrb.Spatial2DView(
        origin=f"/{result.axis}/{lens}/{when}",
        contents="$origin/**",
        name=names[when],
        background=rrb.Background(color=colours.BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.7, WIDTH + 0.7], y_range=[-1.5, HEIGHT + 1.7]),
    )


def _log_axis(stream: rr.RecordingStream, r: Reconciliation, result: AxisResult) -> None:
    """Log all entities of one axis."""
    stream.log(f"{result.axis}/steps", _markdown(_steps_text(r, result)), static=True)
    for lens in _drawn_diagnostics(result):
        _log_diagnostic(stream, result, lens)
    _log_gaps(stream, result)


def _log_gaps(stream: rr.RecordingStream, result: AxisResult) -> None:
    """Log the gap of each diagnostic relative to its threshold, for the largest gaps, and the threshold, which is 1."""
    snapshots = [
        {score.lens: words.gap_ratio(score) for score in snapshot.scores} for snapshot in _snapshots_by_step(result)
    ]
    path = f"{result.axis}/gap"
    largest = sorted(snapshots[0], key=lambda lens: -max(snapshot.get(lens, 0.0) for snapshot in snapshots))
    for lens, tint in zip(largest, GAP_LINE_COLOURS, strict=False):
        line = rr.SeriesLines(colors=[tint], widths=[2.0], names=[words.diagnostic_name(lens)])
        stream.log(f"{path}/{lens}", line, static=True)
        _log_by_step(stream, f"{path}/{lens}", [snapshot.get(lens, np.nan) for snapshot in snapshots])
    line = rr.SeriesLines(colors=[colours.TEXT], widths=[1.0], names=["threshold"])
    stream.log(f"{path}/threshold", line, static=True)
    _log_by_step(stream, f"{path}/threshold", [1.0] * len(snapshots))


def _log_by_step(stream: rr.RecordingStream, path: str, values: Sequence[float]) -> None:
    """Log values by step."""
    steps = rr.TimeColumn(TIMELINE, sequence=range(len(values)))
    stream.send_columns(path, [steps], rr.Scalars.columns(scalars=np.array(values)))


def _log_diagnostic(stream: rr.RecordingStream, result: AxisResult, lens: str) -> None:
    """Log both plots of one diagnostic with the same scale."""
    axis = result.axis
    views = [
        next((view for view in snapshot.views if view.lens == lens), None) for snapshot in _snapshots_by_step(result)
    ]
    plots = {step: to_field_units("", view, axis, None) for step, view in enumerate(views) if view is not None}
    every = list(plots.values())
    scale = Scale(decades(plot.x for plot in every), decades([np.array(value_limits(every))]))
    for when in ("before", "after") if result.steps else ("before",):
        _log_grid(stream, f"{axis}/{lens}/{when}", scale, plots[0], axis)
    stream.reset_time()
    _log_curves(stream, f"{axis}/{lens}/before", scale, plots[0], axis, static=True)
    _log_found_ranges(stream, f"{axis}/{lens}/before", scale, result, lens)
    for step, plot in plots.items() if result.steps else ():
        stream.set_time(TIMELINE, sequence=step)
        _log_curves(stream, f"{axis}/{lens}/after", scale, plot, axis, static=False)


def _log_curves(
    stream: rr.RecordingStream, path: str, scale: Scale, plot: DiagnosticPlot, axis: str, static: bool
) -> None:
    """Log the band, the measured curve and the expected curve."""
    # A lower end of zero has no logarithm; it is drawn below the box.
    low, high = (scale.to_chart(plot.x, np.maximum(edge, 10.0 ** scale.y[0])) for edge in (plot.lo, plot.hi))
    fill = rr.LineStrips2D(
        list(band(low, high)), colors=[BAND_COLOUR], radii=[WIDTH / FILL_STEPS / 2], draw_order=-20.0
    )
    stream.log(f"{path}/band", fill, static=static)
    colour, at = colours.AXIS_COLOURS[axis], _inside(scale.to_chart(plot.x, plot.measured))
    thin = rr.Radius.ui_points(0.8)
    stream.log(
        f"{path}/measured",
        rr.LineStrips2D(finite_sections(at), colors=[colour], radii=thin, draw_order=5.0),
        static=static,
    )
    if len(at) <= MAX_MARKERS:
        dots = rr.Points2D(at, colors=[colour], radii=rr.Radius.ui_points(3.0), draw_order=20.0)
        stream.log(f"{path}/points", dots, static=static)
    expected = finite_sections(_inside(scale.to_chart(plot.x, plot.expected)))
    line = rr.LineStrips2D(expected, colors=[colours.TEXT], radii=rr.Radius.ui_points(1.0), draw_order=10.0)
    stream.log(f"{path}/expected", line, static=static)


def _log_found_ranges(stream: rr.RecordingStream, path: str, scale: Scale, result: AxisResult, lens: str) -> None:
    """Log a frame around each range in which this diagnostic found a gap."""
    view = next(view for view in result.start.views if view.lens == lens)
    founds = [step.found for step in result.steps] + list(result.left_over)
    marks = [to_field_units("", view, result.axis, found.where) for found in founds if found.lens == lens]
    bounds = [mark.mark for mark in marks if mark.mark is not None]
    if not bounds:
        return
    one = 10.0 ** np.array([scale.y[0], scale.y[0]], float)
    ends = [np.clip(scale.to_chart(np.array(bound), one)[:, 0], 0.0, WIDTH) for bound in bounds]
    frames = [np.array([[a, 0], [b, 0], [b, HEIGHT], [a, HEIGHT], [a, 0]]) for a, b in ends]
    strips = rr.LineStrips2D(frames, colors=[RANGE_COLOUR], radii=rr.Radius.ui_points(0.75), draw_order=-5.0)
    stream.log(f"{path}/place", strips, static=True)


def _log_grid(stream: rr.RecordingStream, path: str, scale: Scale, plot: DiagnosticPlot, axis: str) -> None:
    """Log frame, decade lines, labels and the key to the curves."""
    lines = grid(scale)
    for name, strips, colour, order in (
        ("minor", lines.minor, colours.MINOR, -30.0),
        ("major", lines.major, colours.MAJOR, -29.0),
        ("frame", lines.frame, colours.FRAME, -10.0),
    ):
        strip = rr.LineStrips2D(strips, colors=[colour], radii=rr.Radius.ui_points(0.5), draw_order=order)
        stream.log(f"{path}/grid/{name}", strip, static=True)
    key = [("measured", colours.AXIS_COLOURS[axis]), ("model", colours.TEXT), ("95 %", BAND_COLOUR)]
    at = [(x, -0.85, name) for x, (name, _) in zip(LEGEND_X, key, strict=True)]
    strokes = [np.array([[x - 1.9, -0.42], [x - 1.2, -0.42]]) for x in LEGEND_X]
    strip = rr.LineStrips2D(strokes, colors=[tint for _, tint in key], radii=rr.Radius.ui_points(2.0), draw_order=30.0)
    stream.log(f"{path}/grid/key", strip, static=True)
    labels = [*lines.ticks, (WIDTH / 2, HEIGHT + 0.85, plot.x_label), (2.4, -0.85, plot.y_label), *at]
    points = rr.Points2D(
        [(x, y) for x, y, _ in labels],
        labels=[text for _, _, text in labels],
        colors=[colours.TEXT],
        radii=[0.0],
        show_labels=True,
    )
    stream.log(f"{path}/grid/labels", points, static=True)


def _inside(at: Floats) -> Floats:
    """Limit a curve to the box; outside values are drawn on its edge."""
    return np.column_stack([at[:, 0], clip(at[:, 1])])


def _markdown(text: str) -> rr.TextDocument:
    """Return a Markdown document."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
