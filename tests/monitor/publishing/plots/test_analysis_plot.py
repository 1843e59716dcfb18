"""Tests of the plot of an analysis."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.estimation.allan.dynamic_allan import DynamicAllan, compute_dynamic_allan
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.publishing.plots import allan_figure, analysis_plot, dynamic_figure, style
from monitor.publishing.plots.allan_figure import AdditionalDeviation
from monitor.publishing.plots.analysis_plot import AnalysisPlotData
from monitor.publishing.plots.dynamic_figure import ChangeMark
from tests.monitor.publishing import example_results


@pytest.fixture(scope="module")
def changing_noise() -> DynamicAllan:
    """Compute dynamic curves of white noise that doubles halfway on the gyroscopes."""
    values = np.random.default_rng(1).standard_normal((6000, 6))
    values[3000:, :3] *= 2.0
    return compute_dynamic_allan(values, 10.0, 60.0, step_s=9.0)


def read_pixels(path: Path) -> np.ndarray:
    return pytest.importorskip("matplotlib.image").imread(path)


def count_pixels(image: np.ndarray, colour: str) -> int:
    """Count the pixels with this colour."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return int((np.abs(image[..., :3] - rgb).max(axis=-1) < 0.02).sum())


def draw_panel(kind: str = "gyro", **arguments: object):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    axes = figure.subplots()
    allan_figure.draw_allan_panel(axes, arguments.pop("estimate", example_results.make_estimate()), kind, **arguments)
    return axes


@pytest.mark.parametrize(("units", "unit", "factor"), [("si", "m/s²", 1.0), ("datasheet", "µg", 1e6 / 9.80665)])
def test_deviations_are_drawn_in_the_requested_units(units: str, unit: str, factor: float) -> None:
    pytest.importorskip("matplotlib")
    estimate = example_results.make_estimate()
    axes = draw_panel("accel", estimate=estimate, units=UNIT_SYSTEMS[units])
    assert axes.get_ylabel() == f"Allan deviation σ(τ), {unit}"
    [measured] = [line for line in axes.lines if line.get_label() == "ax"]
    np.testing.assert_allclose(measured.get_ydata(), np.sqrt(estimate.curve.avar[:, 3]) * factor)


def find_letters(axes) -> dict[str, list[tuple[float, float]]]:
    """Map each letter to its positions in data units."""
    found: dict[str, list[tuple[float, float]]] = {}
    for text in axes.texts:
        found.setdefault(text.get_text(), []).append(text.xy)
    return found


@pytest.mark.long
def test_plot_has_both_kinds_of_axes_in_all_colours(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "plot.png"
    analysis_plot.save_analysis_plot(AnalysisPlotData(example_results.make_analysis()), path, title="bench-1")
    image = read_pixels(path)
    assert image.shape[1] == round(2 * analysis_plot.INCHES[0] * style.STYLE["figure.dpi"])
    for half in (image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]):
        assert all(count_pixels(half, colour) > 500 for colour in style.COLOURS)


def test_gyroscope_alone_fills_the_plot(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    estimate = example_results.make_estimate()
    estimate.curve.avar[:, [0, 1, 3, 4, 5]] = np.nan
    path = tmp_path / "plot.png"
    analysis_plot.save_analysis_plot(AnalysisPlotData(example_results.make_analysis(estimate)), path)
    image = read_pixels(path)
    assert image.shape[1] == round(analysis_plot.INCHES[0] * style.STYLE["figure.dpi"])
    curves = image[: image.shape[0] // 2]
    assert count_pixels(curves, style.COLOURS[2]) > 300
    assert count_pixels(curves, style.COLOURS[0]) == 0


def test_letters_are_at_their_conventional_averaging_times() -> None:
    estimate = example_results.make_estimate()
    gz = estimate.coefficients.value[:, 2]
    single_axis = replace(estimate, curve=replace(estimate.curve, avar=estimate.curve.avar.copy()))
    single_axis.curve.avar[:, :2] = np.nan
    letters = find_letters(draw_panel(estimate=single_axis))
    degrees_an_hour = np.degrees(1.0) * 3600.0
    assert letters["N"] == [(1.0, pytest.approx(gz[1] * degrees_an_hour))]
    assert letters["K"] == [(3.0, pytest.approx(gz[3] * degrees_an_hour))]
    assert letters["Q"] == [(pytest.approx(3**0.5), pytest.approx(gz[0] * degrees_an_hour))]
    ((at_s, floor),) = letters["B"]
    assert floor == pytest.approx(gz[2] * 0.66432 * degrees_an_hour, rel=1e-4)
    assert at_s == estimate.curve.tau_s[np.argmin(estimate.curve.avar[:, 2])]
    assert "R" not in letters  # R is only bounded


def test_fit_that_does_not_describe_the_curve_is_grey_and_named() -> None:
    panel = draw_panel(estimate=replace(example_results.make_estimate(), poorly_fitted_axes=("gy",)))
    assert "gy: fit (grey) does not describe the curve" in [text.get_text() for text in panel.texts]
    fits = [line.get_color() for line in panel.lines if line.get_zorder() == 3]
    assert fits == [style.COLOURS[0], style.GREY, style.COLOURS[2]]


def test_overlapping_marks_share_a_letter() -> None:
    estimate = example_results.make_estimate()
    value = estimate.coefficients.value.copy()
    value[1, :3] = [1.00e-4, 1.01e-4, 3.0e-4]
    value[3, :3] = [1.0e-6, 2.0e-6, 4.0e-6]
    letters = find_letters(
        draw_panel(estimate=replace(estimate, coefficients=replace(estimate.coefficients, value=value)))
    )
    assert len(letters["N"]) == 2
    assert len(letters["K"]) == 3


def test_asymptotes_have_the_slopes_of_their_letters() -> None:
    axes = draw_panel()
    slopes = set()
    for line in axes.lines:
        x, y = line.get_data()
        if line.get_alpha() == 0.4 and len(x) == 2:
            slopes.add(round(float(np.log(y[1] / y[0]) / np.log(x[1] / x[0])), 6))
    assert slopes == {-1.0, -0.5, 0.0, 0.5}


def test_all_points_and_marks_are_inside_the_panel() -> None:
    axes = draw_panel("accel")
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    for line in axes.lines:
        x, y = (np.asarray(part, float) for part in line.get_data())
        if line.get_alpha() != 0.4 and x.size:
            good = np.isfinite(y)
            assert ((x >= left) & (x <= right) & (y >= bottom) & (y <= top))[good].all()


def test_total_deviation_is_shown_only_beyond_the_allan_deviation() -> None:
    estimate = example_results.make_estimate()
    longest = estimate.curve.tau_s[-1]
    tau_s = longest * np.array([0.5, 1.0, 2.0, 4.0])
    deviation = np.full((4, 6), 3.0e-5)
    total = AdditionalDeviation("total", tau_s, deviation, 0.5 * deviation, np.full((4, 6), np.nan), only_beyond=True)
    axes = draw_panel(estimate=estimate, others=[total])
    open_marks = [line.get_xdata() for line in axes.lines if line.get_markerfacecolor() == "white"]
    beyond = [x.tolist() for x in open_marks if len(x)]
    assert beyond == [(longest * np.array([2.0, 4.0])).tolist()] * 3
    assert axes.get_xlim()[1] > 4.0 * longest
    assert "total" in [text.get_text() for text in axes.get_legend().get_texts()]


def test_description_mentions_missing_samples() -> None:
    estimate = example_results.make_estimate()
    assert analysis_plot.describe_recording(estimate) == "360,000 samples at 100 Hz, 1 h 00 min"
    assert analysis_plot.describe_recording(replace(estimate, samples=359_000)).endswith("1 h 00 min, 1,000 missing")


def test_k_or_r_is_ambiguous_only_for_bounds() -> None:
    estimate = replace(example_results.make_estimate(seconds=1000.0), k_or_r=np.array([True, False] + [True] * 4))
    assert analysis_plot.is_k_r_ambiguous(estimate, "K", "gx")
    assert not analysis_plot.is_k_r_ambiguous(estimate, "K", "gy")
    assert not analysis_plot.is_k_r_ambiguous(estimate, "N", "gx")
    assert not analysis_plot.is_k_r_ambiguous(example_results.make_estimate(), "K", "gx")


@pytest.mark.long
def test_dynamic_curves_are_below_the_analysis(tmp_path: Path, changing_noise: DynamicAllan) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "plot.png"
    estimate = example_results.make_estimate()
    estimate.curve.avar[:, 3:] = np.nan
    drawn = AnalysisPlotData(
        example_results.make_analysis(estimate), dynamic=changing_noise, marks=[ChangeMark(300.0, "gz")]
    )
    analysis_plot.save_analysis_plot(drawn, path, "bench-1")
    image = read_pixels(path)
    dynamic_height = dynamic_figure.dynamic_figure_height_inches(changing_noise, "gyro") * style.STYLE["figure.dpi"]
    assert image.shape[0] == pytest.approx(analysis_plot.INCHES[1] * style.STYLE["figure.dpi"] + dynamic_height, abs=2)
    gyro = image[round(analysis_plot.INCHES[1] * style.STYLE["figure.dpi"]) :, :, :3]
    blue = (gyro[..., 2] - gyro[..., 0] > 0.3).any(axis=0)
    red = (gyro[..., 0] - gyro[..., 2] > 0.3).any(axis=0)
    assert blue.any()
    assert red.any()


def test_colours_show_changes_of_the_deviation_beyond_chance(changing_noise: DynamicAllan) -> None:
    change = np.exp(dynamic_figure.log_changes(changing_noise))
    assert 1.5 < change[-1, 0, 0] / change[0, 0, 0] < 2.0
    assert change[-1, 0, 5] / change[0, 0, 5] == pytest.approx(1.0, abs=0.05)


def test_chance_at_the_longest_averaging_time_does_not_saturate_the_colours() -> None:
    noise = np.random.default_rng(1).standard_normal((6000, 6))
    steady = compute_dynamic_allan(noise, 10.0, 60.0, step_s=9.0)
    by_chance = np.log(steady.deviation / np.nanmedian(steady.deviation, axis=0))
    assert np.abs(by_chance[:, -1]).max() > np.log(2.0)
    assert np.abs(dynamic_figure.log_changes(steady)).max() < np.log(1.25)


def test_only_coefficients_estimated_for_long_have_a_panel(changing_noise: DynamicAllan) -> None:
    status = np.full_like(changing_noise.status, Status.UPPER_BOUND)
    status[:, 1] = Status.ESTIMATED
    assert dynamic_figure._shown_coefficients(replace(changing_noise, status=status), "gyro") == ("N",)
    status[:2, 3, 1] = Status.ESTIMATED  # estimated only briefly
    assert "K" not in dynamic_figure._shown_coefficients(replace(changing_noise, status=status), "gyro")
    status[:20, 3, 1] = Status.ESTIMATED
    assert "K" in dynamic_figure._shown_coefficients(replace(changing_noise, status=status), "gyro")


def test_axis_without_data_has_no_surface(changing_noise: DynamicAllan) -> None:
    deviation = changing_noise.deviation.copy()
    deviation[:, :, 1] = np.nan
    assert dynamic_figure._shown_axes(replace(changing_noise, deviation=deviation), "gyro") == ("gx", "gz")


def test_single_time_step_can_be_drawn() -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure()
    single_step = compute_dynamic_allan(np.random.default_rng(2).standard_normal((600, 6)), 10.0, 60.0, (0.1,))
    assert single_step.t_s.size == 1
    dynamic_figure.draw_dynamic_panels(figure, single_step, "gyro")
    figure.draw_without_rendering()
    low, high = figure.axes[0].get_xlim()
    assert low < 60.0 < high


def test_missing_matplotlib_is_reported_with_the_package_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        analysis_plot.save_analysis_plot(AnalysisPlotData(example_results.make_analysis()), tmp_path / "plot.png")


@pytest.mark.long
def test_missing_folder_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(ConfigError, match="cannot write the plot"):
        analysis_plot.save_analysis_plot(
            AnalysisPlotData(example_results.make_analysis()), tmp_path / "absent" / "plot.png"
        )
