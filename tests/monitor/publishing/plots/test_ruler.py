"""Ticks that people read, and curves of fewer points without a lost spike."""

import numpy as np
import pytest

from monitor.publishing.plots.ruler import Ruler, thinned


@pytest.mark.parametrize(
    ("low", "high", "log", "labels"),
    [
        (1e-4, 50.0, True, ["10⁻⁴", "0.001", "0.01", "0.1", "1", "10"]),
        (3.0, 200.0, True, ["5", "10", "20", "50", "100", "200"]),
        (0.9, 3.1, True, ["1.0", "1.5", "2.0", "2.5", "3.0"]),
        (1e-12, 1e3, True, ["10⁻¹²", "10⁻⁹", "10⁻⁶", "0.001", "1", "1000"]),
        (-40.0, 42.0, False, ["−40", "−20", "0", "20", "40"]),
        (0.0, 0.41, False, ["0", "0.1", "0.2", "0.3", "0.4"]),
        (0.0, 3e-6, False, ["0", "1·10⁻⁶", "2·10⁻⁶", "3·10⁻⁶"]),
    ],
)
def test_ticks(low: float, high: float, log: bool, labels: list[str]) -> None:
    ruler = Ruler(low, high, log, 160.0, 0.0)
    assert [label for _, label in ruler.ticks()] == labels
    places = [px for px, _ in ruler.ticks()]
    assert places == sorted(places, reverse=True)  # upwards
    assert all(-1e-6 <= px <= 160.0 + 1e-6 for px in places)


def test_fine_lines_stand_between_decades_and_only_where_these_are_few() -> None:
    fine = Ruler(1.0, 100.0, True, 0.0, 200.0).fine()
    assert fine[:2] == pytest.approx([100 * np.log10(2), 100 * np.log10(3)])
    assert len(fine) == 16
    assert Ruler(1e-6, 1.0, True, 0.0, 200.0).fine() == []
    assert Ruler(0.0, 1.0, False, 0.0, 200.0).fine() == []


def test_what_has_no_logarithm_has_no_place() -> None:
    assert np.isnan(Ruler(1.0, 10.0, True, 0.0, 1.0).at(np.array([0.0, -1.0]))).all()


def test_a_spike_of_one_sample_is_kept() -> None:
    rng = np.random.default_rng(1)
    x, y = np.linspace(0.0, 300.0, 100_000), rng.standard_normal(100_000)
    y[40_000], y[60_000] = 50.0, -60.0
    few_x, few_y = thinned(x, y)
    assert few_x.size <= 2 * 301
    assert (np.diff(few_x) > 0).all()
    assert few_y.max() == 50.0
    assert few_y.min() == -60.0
    assert few_x[np.argmax(few_y)] == x[40_000]


def test_what_is_not_finite_is_left_out() -> None:
    x, y = thinned(np.array([1.0, np.nan, 3.0, 4.0]), np.array([1.0, 2.0, np.inf, 4.0]))
    assert x.tolist() == [1.0, 4.0]
    assert y.tolist() == [1.0, 4.0]
