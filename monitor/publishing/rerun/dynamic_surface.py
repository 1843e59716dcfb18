"""The Allan surface of a device over time, as the viewer shows it under ``/<device>/dynamic/<axis>``.

In comes a ``Surface``; out go one picture an axis and the labels beside it: time to the right, τ upwards, coloured by
the deviation over its own median over time. Rerun draws a picture one unit a pixel and has no axes, so every τ is a few
pixels high, and labels are points. A picture is a PNG with a palette, a few kB; the scene draws one when a column is
complete, which is the rarer the longer the service runs. Importing this module imports Rerun.
"""

import io
from itertools import pairwise
from typing import Final

import numpy as np
import rerun as rr
from PIL import Image  # rerun-sdk brings it

from drivers.sample import AXES, Floats
from monitor.publishing.plots import colours
from monitor.publishing.rerun.allan_history import COLUMNS, Surface

HEIGHT: Final = 60  # pixels of a picture, about: with COLUMNS the shape of a third of a tab's height
ENDS: Final = 2.0  # of the colour scale: half and twice the median
SHADES: Final = 127  # to either side of the median
NOTHING: Final = 2 * SHADES + 1  # palette entry where there is no deviation
LEAST: Final = 4  # columns before a median says anything
BAR_X: Final = COLUMNS + 9.0
BAR_STEPS: Final = 24
MARGIN: Final = (24.0, 7.0, 32.0, 13.0)  # left, above, right, below the picture, for labels


def bounds(taus: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """What a view must hold in x and in y, for so many τ."""
    left, above, right, below = MARGIN
    return (-left, COLUMNS + right), (-above, _rows(taus) * taus + below)


def draw(stream: rr.RecordingStream, device: str, surface: Surface) -> None:
    """Pictures and labels of all axes that are measured, at the stream's current time."""
    whole = surface.relative()
    if len(whole) < LEAST:
        return
    for i, axis in enumerate(AXES):
        if not np.isfinite(whole[:, :, i]).any():
            continue
        path, height = f"{device}/dynamic/{axis}", _rows(surface.tau_s.size) * surface.tau_s.size
        stream.log(path, rr.EncodedImage(contents=picture(whole[:, :, i]), media_type="image/png", draw_order=-20.0))
        labels = _tau_labels(surface.tau_s, height) + _time_labels(surface, height) + _bar_labels(height)
        stream.log(f"{path}/labels", _points(labels))
        stream.log(f"{path}/scale", _bar(height))


def picture(relative: Floats) -> bytes:
    """A PNG of ln of the deviation over its median [columns, m], stretched to COLUMNS pixels; longest τ on top."""
    share = np.clip(np.nan_to_num(relative) / np.log(ENDS), -1.0, 1.0)
    shade = np.where(np.isfinite(relative), np.rint(SHADES * (1.0 + share)), NOTHING).astype(np.uint8)
    wide = shade[np.arange(COLUMNS) * len(relative) // COLUMNS]
    image = Image.fromarray(np.repeat(wide.T[::-1], _rows(relative.shape[1]), axis=0), "P")
    image.putpalette([part for colour in PALETTE for part in colour])
    data = io.BytesIO()
    image.save(data, "PNG")
    return data.getvalue()


def _palette() -> tuple[colours.Colour, ...]:
    """Blue below the median, dark at it, vermilion above; then what stands for no deviation."""
    below = [colours.mixed(colours.AXIS_COLOURS["gz"], (SHADES - i) / SHADES, colours.MINOR) for i in range(SHADES)]
    above = [colours.mixed(colours.AXIS_COLOURS["gx"], i / SHADES, colours.MINOR) for i in range(SHADES + 1)]
    return (*below, *above, colours.BACKGROUND)


PALETTE: Final = _palette()


def _rows(taus: int) -> int:
    """Pixels in the height of one τ."""
    return max(1, round(HEIGHT / max(taus, 1)))


def _tau_labels(tau_s: Floats, height: int) -> list[tuple[float, float, str]]:
    """Powers of ten, at their place between the rows, and the unit."""
    log = np.log10(tau_s)
    powers = range(int(np.ceil(log[0])), int(np.floor(log[-1])) + 1)
    rows = np.interp(list(powers), log, (np.arange(log.size) + 0.5) / log.size)
    labels = [(-11.0, height * (1.0 - float(row)), f"{10.0**power:g}") for power, row in zip(powers, rows, strict=True)]
    return [*labels, (-11.0, -4.0, "τ, s")]


def _time_labels(surface: Surface, height: int) -> list[tuple[float, float, str]]:
    """The time of the day in UTC at the oldest and the newest column."""
    at = ((12.0, surface.ends_s[0]), (COLUMNS - 1.0, surface.ends_s[-1]))
    return [(x, height + 6.0, _clock_time(t)) for x, t in at]


def _bar_labels(height: int) -> list[tuple[float, float, str]]:
    ends = zip((2.0, height / 2.0, height - 2.0), (f"× {ENDS:g}", "× 1", f"× {1 / ENDS:g}"), strict=True)
    return [(BAR_X + 11.0, y, text) for y, text in ends]


def _bar(height: int) -> rr.LineStrips2D:
    """The colour scale: strokes one above the other."""
    edges = np.linspace(height, 0.0, BAR_STEPS + 1)
    tints = [PALETTE[round(i * 2 * SHADES / (BAR_STEPS - 1))] for i in range(BAR_STEPS)]
    strips = [np.array([[BAR_X, a], [BAR_X, b]]) for a, b in pairwise(edges)]
    return rr.LineStrips2D(strips, colors=tints, radii=[2.0])


def _points(labels: list[tuple[float, float, str]]) -> rr.Points2D:
    return rr.Points2D(
        [(x, y) for x, y, _ in labels],
        labels=[text for _, _, text in labels],
        colors=[colours.TEXT],
        radii=[0.0],
        show_labels=True,
    )


def _clock_time(wall_s: float) -> str:
    """Time of the day in UTC.

    >>> _clock_time(1.76e9)
    '08:53:20'
    """
    return str(np.datetime64(round(wall_s), "s"))[-8:]
