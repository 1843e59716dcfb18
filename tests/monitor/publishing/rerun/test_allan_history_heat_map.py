"""Tests of the heat maps of the Allan deviation over time, and of the history that the heat maps show."""

import io
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

import rerun as rr
from PIL import Image

from drivers.data_types import AXES, Event
from monitor.estimation.estimate import Estimate
from monitor.publishing.rerun import allan_history_heat_map
from monitor.publishing.rerun.allan_history_heat_map import COLUMNS, AllanHistory
from monitor.publishing.rerun.viewer_scene import AllDevicesScene
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription
from tests.monitor.publishing import example_results

ESTIMATE = example_results.make_estimate()


def scale_estimate(factor: float) -> Estimate:
    """Return the estimate with an Allan deviation that is larger by a factor, and with narrow 95 % intervals."""
    deviation = np.sqrt(ESTIMATE.curve.avar) * factor
    curve = replace(ESTIMATE.curve, avar=deviation**2, lo=0.99 * deviation, hi=deviation / 0.99)
    return replace(ESTIMATE, curve=curve)


def test_column_is_the_geometric_mean_of_its_estimates() -> None:
    history = AllanHistory(column_s=2.0)
    done = [
        history.add_estimate_and_check_column_complete(float(t), scale_estimate(factor))
        for t, factor in enumerate((1.0, 4.0, 2.0, 8.0, 8.0))
    ]
    assert done == [False, False, True, False, True]
    assert history.ends_s == [2.0, 4.0]
    first, second = history.log_changes()[:, 3, 2]
    assert second - first == pytest.approx(np.log(8.0 / 2.0 * 0.99**2))
    assert first == pytest.approx(-second)  # the median of two values is their mean


def test_history_is_bounded_and_covers_its_whole_span() -> None:
    history = AllanHistory(column_s=1.0)
    max_columns = 0
    for t in range(5000):
        history.add_estimate_and_check_column_complete(float(t), scale_estimate(2.0 if t < 2500 else 6.0))
        max_columns = max(max_columns, len(history.ends_s))
    assert COLUMNS / 2 <= len(history.ends_s) < COLUMNS
    assert max_columns < COLUMNS
    assert history.column_s == 32.0
    assert history.ends_s[0] < 40.0
    assert history.ends_s[-1] > 4960.0
    ratios = history.log_changes()[:, 0, 0]
    ends = np.array(history.ends_s)
    step = ratios[ends > 2600].mean() - ratios[ends < 2400].mean()
    assert step == pytest.approx(np.log(3.0), abs=0.03)
    assert np.ptp(ratios[ends < 2400]) == pytest.approx(0.0, abs=1e-12)


def test_different_tau_or_an_earlier_time_restart_the_history() -> None:
    history = AllanHistory(column_s=1.0)
    for t in range(10):
        history.add_estimate_and_check_column_complete(float(t), ESTIMATE)
    assert len(history.ends_s) == 9
    history.add_estimate_and_check_column_complete(4.0, ESTIMATE)
    assert history.ends_s == []
    history.add_estimate_and_check_column_complete(5.0, ESTIMATE)
    assert history.ends_s == [5.0]
    history.add_estimate_and_check_column_complete(6.0, example_results.make_estimate(seconds=60.0))
    assert history.ends_s == []
    assert history.tau_s.size < ESTIMATE.curve.tau_s.size


def test_unmeasured_values_are_nan() -> None:
    avar = ESTIMATE.curve.avar.copy()
    avar[:, 4] = np.nan
    avar[-1, 0] = 0.0
    partial = replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=avar))
    history = AllanHistory(column_s=1.0)
    assert history.log_changes().shape == (0, 0, 6)
    for t in range(3):
        history.add_estimate_and_check_column_complete(float(t), partial)
    relative = history.log_changes()
    assert np.isnan(relative[:, :, 4]).all()
    assert np.isnan(relative[:, -1, 0]).all()
    assert np.isfinite(relative[:, :-1, :4]).all()


T0 = 1.76e9


def decode_pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def test_time_is_to_the_right_and_tau_upwards() -> None:
    relative = np.zeros((6, 15))
    relative[0, 0] = np.log(5.0)  # the oldest, shortest τ is at the bottom left
    relative[5, 14] = -np.log(5.0)  # the newest, longest τ is at the top right
    relative[2, 7] = np.nan
    image = decode_pixels(allan_history_heat_map.encode_heat_map(relative))
    rows = round(allan_history_heat_map.HEIGHT / 15)
    assert image.shape == (15 * rows, COLUMNS, 3)
    palette = allan_history_heat_map.PALETTE
    assert (image[-rows:, 0] == palette[2 * allan_history_heat_map.SHADES]).all()
    assert (image[:rows, -1] == palette[0]).all()
    sixth = COLUMNS // 6  # few columns are drawn wide to fill the image
    assert (
        image[7 * rows : 8 * rows, 2 * sixth + 2 : 3 * sixth - 2] == palette[allan_history_heat_map.NO_VALUE_INDEX]
    ).all()
    assert (image[: 7 * rows, : 5 * sixth - 2] == palette[allan_history_heat_map.SHADES]).all()
    assert (image[:rows, 5 * sixth + 6 :] == palette[0]).all()


def test_colour_scale_ends_at_twice_and_half_the_median() -> None:
    image = decode_pixels(allan_history_heat_map.encode_heat_map(np.log([[2.0, 4.0], [0.5, 0.1], [1.4, 0.7]])))
    bottom, top = image[-1, [0, COLUMNS // 2, COLUMNS - 1]], image[0, [0, COLUMNS // 2, COLUMNS - 1]]
    assert (bottom[0] == top[0]).all()
    assert (bottom[1] == top[1]).all()
    red, blue = bottom[2].astype(int), top[2].astype(int)
    assert red[0] > red[2]
    assert blue[2] > blue[0]


def test_axis_that_is_measured_later_has_a_colour_scale() -> None:
    avar = ESTIMATE.curve.avar.copy()
    avar[:, 4] = np.nan
    partial = replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=avar))
    history, logged = AllanHistory(column_s=1.0), set()
    for t in range(12):
        history.add_estimate_and_check_column_complete(float(t), partial if t < 8 else ESTIMATE)
        allan_history_heat_map.draw_heat_maps(lambda path, *_, **__: logged.add(path), "dynamic", history)
    assert {f"dynamic/{axis}/scale" for axis in AXES} <= logged


def test_recording_has_surfaces_labels_and_marks(tmp_path: Path) -> None:
    path = tmp_path / "scene.rrd"
    stream = rr.RecordingStream("imu-monitor")
    stream.save(path)
    scene = AllDevicesScene(stream)
    scene.set_detailed_devices([ViewerDeviceDescription("bench-1")])
    for i in range(12):
        scene.draw("bench-1", "AllanAndCoefficientPanel", [(T0 + i, example_results.make_estimate(T0 + i, seed=i))])
    what = {"N": {"before": 1.5e-4, "after": 3.0e-4}, "floor": {"after": 1.0}}
    event = Event("noise_changed", 0, "gz is louder", axis="gz", values=what)
    scene.draw("bench-1", "EventsPanel", [(T0 + 9, event)])
    stream.flush()
    stream.disconnect()
    cells: dict[str, list[object]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.chunk import RrdReader

        for chunk in RrdReader(str(path)).stream():
            batch = chunk.to_record_batch()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if ":" in name:  # only components, no times or row numbers
                    cells.setdefault(f"{chunk.entity_path} {name}", []).extend(column.to_pylist())
    for axis in AXES:
        blobs = cells[f"/bench-1/dynamic/{axis} EncodedImage:blob"]
        assert len(blobs) == 2  # after 8 s and 10 s, with columns of 2 s
        assert decode_pixels(bytes(np.array(blobs[-1], np.uint8).ravel())).shape[1] == COLUMNS
    labels = cells["/bench-1/dynamic/gz Points2D:labels"][-1]
    assert {"0.01", "1", "100 s", "× 2", "08:53:22"} <= set(labels)
    (mark,) = [c for c in cells["/bench-1/coefficients/N/gz/changed Scalars:scalars"] if c]
    assert mark == pytest.approx([np.degrees(3.0e-4) * 60])
    assert not any("floor" in name for name in cells)


def test_view_contains_image_and_labels() -> None:
    (left, right), (top, bottom) = allan_history_heat_map.heat_map_bounds(17)
    assert left < -11.0
    assert right > allan_history_heat_map.BAR_X + 11.0
    assert top < -4.0
    assert bottom > 17 * round(allan_history_heat_map.HEIGHT / 17) + 6.0
