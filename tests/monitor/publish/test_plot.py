"""The Allan plot as a picture."""

import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.publish import plot
from tests.monitor.publish import made


def pixels(path: Path) -> np.ndarray:
    return pytest.importorskip("matplotlib.image").imread(path)


def near(image: np.ndarray, colour: str) -> int:
    """How many pixels have this colour."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return int((np.abs(image[..., :3] - rgb).max(axis=-1) < 0.02).sum())


def test_both_kinds_side_by_side_in_all_colours(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "plot.png"
    plot.allan_plot(made.estimate(), path, title="bench-1")
    image = pixels(path)
    assert image.shape[1] == round(2 * plot.INCHES[0] * plot.DPI)
    for half in (image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]):
        assert all(near(half, colour) > 500 for colour in plot.COLOURS)


def test_a_gyroscope_alone_fills_the_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    estimate = made.estimate()
    estimate.curve.avar[:, [0, 1, 3, 4, 5]] = np.nan
    path = tmp_path / "plot.png"
    plot.allan_plot(estimate, path)
    image = pixels(path)
    assert image.shape[1] == round(plot.INCHES[0] * plot.DPI)
    curves = image[: image.shape[0] // 2]
    assert near(curves, plot.COLOURS[2]) > 300
    assert near(curves, plot.COLOURS[0]) == 0


def test_without_matplotlib_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        plot.allan_plot(made.estimate(), tmp_path / "plot.png")


def test_a_folder_that_is_not_there_is_a_wrong_request(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(ConfigError, match="cannot write the plot"):
        plot.allan_plot(made.estimate(), tmp_path / "absent" / "plot.png")
