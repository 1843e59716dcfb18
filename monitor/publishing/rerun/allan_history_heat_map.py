"""Heat maps of the Allan deviation of a device over time, under ``/<device>/dynamic/<axis>`` in the viewer.

The history has a table of limited size. Each column contains the mean logarithm of the Allan deviations of all
estimates in a time interval, and of the ends of their 95 % intervals. When the table has COLUMNS columns, neighbouring
columns are averaged in pairs, and later columns cover twice the time. The table therefore covers the whole history with
constant memory.

In a heat map, time increases to the right, and the averaging time τ increases upwards. The colour shows how far the
95 % interval of the Allan deviation lies from its median over time. Each heat map is a PNG image with a palette. Rerun
draws no axes on an image, so labels are drawn as points with text. Importing this module imports Rerun.
"""

import io
from itertools import pairwise
from typing import Final

import numpy as np
import rerun as rr
from PIL import Image  # installed with rerun-sdk

from drivers.data_types import AXES, Floats, Ints
from monitor.common.unit_formatting import format_utc
from monitor.estimation.estimate import Estimate
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.change_beyond_chance import log_change_beyond_chance
from monitor.publishing.rerun.allan_drawing import Log, label_points

COLUMNS = 300
"""Largest number of columns. The number must be even, because columns are averaged in pairs."""
INITIAL_COLUMN_S = 2.0
"""Initial time span of a column [s]."""


class AllanHistory:
    """Allan deviations of one device over time.

    A new history starts if an estimate is earlier than the previous estimate, or has different averaging times.
    """

    def __init__(self, column_s: float = INITIAL_COLUMN_S) -> None:
        """Create an empty history whose columns initially cover ``column_s`` seconds."""
        self._first_s = column_s
        self._reset(np.empty(0), 0.0)

    def _reset(self, tau_s: Floats, wall_s: float) -> None:
        self.column_s = self._first_s
        self.tau_s = tau_s  # [m]
        self.ends_s: list[float] = []  # Unix time [s] of the newest estimate in each column
        self._columns: list[Floats] = []  # [3, m, 6] natural logarithms of the Allan deviation, lo and hi
        self._begin_column(wall_s)

    def _begin_column(self, wall_s: float) -> None:
        self._since_s = self._newest_s = wall_s
        self._sums: Floats = np.zeros((3, self.tau_s.size, len(AXES)))
        self._counts: Ints = np.zeros((self.tau_s.size, len(AXES)), np.int64)

    def add_estimate_and_check_column_complete(self, wall_s: float, estimate: Estimate) -> bool:
        """Add an estimate. Return True if the estimate completes a column.

        Parameters
        ----------
        wall_s
            Unix time of the estimate [s].
        estimate
            Estimate with the Allan deviations to add.
        """
        if wall_s < self._newest_s or not np.array_equal(self.tau_s, estimate.curve.tau_s):
            self._reset(estimate.curve.tau_s, wall_s)
        # Recent Allan deviations use only the newest samples, so that a change of the noise appears without delay.
        curve = estimate.display_curve or estimate.curve
        there = np.isfinite(curve.avar) & (curve.avar > 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._sums[:, there] += np.log([np.sqrt(curve.avar[there]), curve.lo[there], curve.hi[there]])
        self._counts += there
        self._newest_s = wall_s
        if wall_s - self._since_s < self.column_s:
            return False
        self.ends_s.append(wall_s)
        self._columns.append(np.where(self._counts > 0, self._sums / np.maximum(self._counts, 1), np.nan))
        self._begin_column(wall_s)
        if len(self._columns) >= COLUMNS:
            self._merge_pairs()
        return True

    def _merge_pairs(self) -> None:
        pairs = np.stack(self._columns).reshape(COLUMNS // 2, 2, *self._sums.shape)
        there = np.isfinite(pairs)
        means = np.where(there, pairs, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        self._columns = list(np.where(there.any(axis=1), means, np.nan))
        self.ends_s = self.ends_s[1::2]
        self.column_s *= 2.0

    def log_changes(self) -> Floats:
        """Return the changes of the Allan deviations beyond chance, natural logarithms, shape [columns, m, 6].

        The values are NaN where Allan deviations are missing.
        """
        whole = np.stack(self._columns) if self._columns else np.empty((0, *self._sums.shape))
        return log_change_beyond_chance(*np.moveaxis(whole, 1, 0))


HEIGHT: Final = 65  # approximate height of a heat map [pixels]
COLOUR_SCALE_RATIO: Final = 2.0  # ends of the colour scale: half and twice the median
SHADES: Final = 127  # shades on either side of the median
NO_VALUE_INDEX: Final = 2 * SHADES + 1  # palette index of a missing deviation
MIN_COLUMNS: Final = 4  # smallest number of columns that gives a meaningful median
LABEL_ABOVE_PX: Final = 6.0  # distance of the point of a label above the centre of the text
TIME_INSET_PX: Final = 20.0  # distance of the time labels from the ends of the image
BAR_X: Final = COLUMNS + 9.0
BAR_STEPS: Final = 24
LABEL_MARGINS_PX: Final = (44.0, 7.0, 52.0, 23.0)  # left, above, right and below the image, for labels


def heat_map_bounds(tau_count: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the x and y limits of the view of a heat map with the given number of averaging times."""
    left, above, right, below = LABEL_MARGINS_PX
    return (-left, COLUMNS + right), (-above, _rows(tau_count) * tau_count + below)


def draw_heat_maps(log: Log, path: str, allan_history: AllanHistory) -> None:
    """Log the heat maps and labels of all measured axes at the current time of the stream.

    Parameters
    ----------
    log
        Function that logs a Rerun entity.
    path
        Path of the entities with the heat maps.
    allan_history
        Allan deviations over time.
    """
    whole = allan_history.log_changes()
    if len(whole) < MIN_COLUMNS:
        return
    for i, axis in enumerate(AXES):
        if not np.isfinite(whole[:, :, i]).any():
            continue
        height = _rows(allan_history.tau_s.size) * allan_history.tau_s.size
        labels = _tau_labels(allan_history.tau_s, height) + _time_labels(allan_history, height) + _bar_labels(height)
        picture = rr.EncodedImage(contents=encode_heat_map(whole[:, :, i]), media_type="image/png", draw_order=-20.0)
        log(f"{path}/{axis}", picture, label_points(labels))
        if np.isfinite(whole[:, :, i]).any(axis=1).sum() <= MIN_COLUMNS:  # the height is constant afterwards
            log(f"{path}/{axis}/scale", _bar(height), static=True)


def encode_heat_map(log_ratio: Floats) -> bytes:
    """Encode logarithmic changes of Allan deviations, shape [columns, m], as a PNG image."""
    share = np.clip(np.nan_to_num(log_ratio) / np.log(COLOUR_SCALE_RATIO), -1.0, 1.0)
    shade = np.where(np.isfinite(log_ratio), np.rint(SHADES * (1.0 + share)), NO_VALUE_INDEX).astype(np.uint8)
    wide = shade[np.arange(COLUMNS) * len(log_ratio) // COLUMNS]
    image = Image.fromarray(np.repeat(wide.T[::-1], _rows(log_ratio.shape[1]), axis=0), "P")
    image.putpalette([part for colour in PALETTE for part in colour])
    data = io.BytesIO()
    image.save(data, "PNG")
    return data.getvalue()


def _palette() -> tuple[axis_colours.Colour, ...]:
    """Return a palette that is blue below the median, vermilion above the median, and grey for missing values."""
    below = [
        axis_colours.blend_colours(axis_colours.AXIS_COLOURS["gz"], (SHADES - i) / SHADES, axis_colours.PALE)
        for i in range(SHADES)
    ]
    above = [
        axis_colours.blend_colours(axis_colours.AXIS_COLOURS["gx"], i / SHADES, axis_colours.PALE)
        for i in range(SHADES + 1)
    ]
    return (*below, *above, axis_colours.GREY)


PALETTE: Final = _palette()


def _rows(taus: int) -> int:
    """Return the number of pixel rows for each averaging time."""
    return max(1, round(HEIGHT / max(taus, 1)))


def _tau_labels(tau_s: Floats, height: int) -> list[tuple[float, float, str]]:
    log = np.log10(tau_s)
    powers = range(int(np.ceil(log[0])), int(np.floor(log[-1])) + 1, 2)  # more labels would overlap in a small window
    rows = np.interp(list(powers), log, (np.arange(log.size) + 0.5) / log.size)
    return [
        (-23.0, height * (1.0 - float(row)) - LABEL_ABOVE_PX, f"{10.0**power:g}{' s' if power == powers[-1] else ''}")
        for power, row in zip(powers, rows, strict=True)
    ]


def _time_labels(surface: AllanHistory, height: int) -> list[tuple[float, float, str]]:
    at = ((TIME_INSET_PX, surface.ends_s[0]), (COLUMNS - TIME_INSET_PX, surface.ends_s[-1]))
    return [(x, height + 1.0, format_utc(t)[-8:]) for x, t in at]


def _bar_labels(height: int) -> list[tuple[float, float, str]]:
    ends = zip(
        (2.0, height / 2.0, height - 2.0),
        (f"× {COLOUR_SCALE_RATIO:g}", "× 1", f"× {1 / COLOUR_SCALE_RATIO:g}"),
        strict=True,
    )
    return [(BAR_X + 23.0, y - LABEL_ABOVE_PX, text) for y, text in ends]


def _bar(height: int) -> rr.LineStrips2D:
    edges = np.linspace(height, 0.0, BAR_STEPS + 1)
    tints = [PALETTE[round(i * 2 * SHADES / (BAR_STEPS - 1))] for i in range(BAR_STEPS)]
    strips = [np.array([[BAR_X, a], [BAR_X, b]]) for a, b in pairwise(edges)]
    return rr.LineStrips2D(strips, colors=tints, radii=[2.0])
