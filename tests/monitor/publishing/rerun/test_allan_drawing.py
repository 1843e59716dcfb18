"""Tests of the Allan plots in the viewer."""

from typing import Any

import numpy as np

from monitor.publishing.plots.allan_figure import READING_TAU_S
from monitor.publishing.rerun.allan_chart_geometry import HEIGHT, WIDTH
from monitor.publishing.rerun.allan_drawing import KEY, AllanPlotPair
from tests.monitor.publishing.example_results import make_estimate


def draw_example() -> dict[str, Any]:
    """Return the Rerun components logged by the plots of an example, by path."""
    logged: dict[str, Any] = {}
    AllanPlotPair(lambda path, *parts: logged.update({path: parts[0]}), "d").draw(make_estimate(), None)
    return logged


def test_key_explains_every_sign() -> None:
    logged = draw_example()
    for kind in ("gyro", "accel"):
        assert tuple(logged[f"d/{kind}/key/text"].labels.as_arrow_array().to_pylist()) == KEY
        assert {"d/gyro/key/fit", "d/gyro/key/band", "d/gyro/key/model", "d/gyro/key/ring"} < set(logged)


def test_ring_of_n_is_at_one_second_and_at_the_level_of_n() -> None:
    logged, estimate = draw_example(), make_estimate()
    (outline, *_) = logged["d/gx/rings"].strips.as_arrow_array().to_pylist()
    x, y = np.mean(outline[:-1], axis=0)
    at_tau = {
        tuple(point): label
        for point, label in zip(
            logged["d/gyro/ticks"].positions.as_arrow_array().to_pylist(),
            logged["d/gyro/ticks"].labels.as_arrow_array().to_pylist(),
            strict=True,
        )
    }
    (x_of_one_second,) = [point[0] for point, label in at_tau.items() if label == "1" and point[1] > HEIGHT]
    assert READING_TAU_S["N"] == 1.0
    np.testing.assert_allclose(x, x_of_one_second, atol=1e-4)
    n_degrees_per_hour = np.degrees(estimate.coefficients.value[1, 0]) * 3600.0
    ticks = [(point[1] + 0.35, float(label)) for point, label in at_tau.items() if point[0] < 0.0]
    heights, levels = np.array(sorted(ticks)).T
    expected = np.interp(np.log10(n_degrees_per_hour), np.log10(levels[::-1]), heights[::-1])
    np.testing.assert_allclose(y, expected, atol=1e-3)
    assert 0.0 < x < WIDTH
