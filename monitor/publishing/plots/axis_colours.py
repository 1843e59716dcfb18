"""Colours of the x, y and z axes in the viewer, which colour-blind people can distinguish.

The colours are vermilion, bluish green and blue of the Okabe-Ito palette, as in the reports. The contrast of each
colour is at least 3:1 on the white background of the light theme and on the black background of the dark theme. The
gyroscope and the accelerometer of an axis have the same colour, because they never appear in the same plot.
"""

from typing import Final

Colour = tuple[int, int, int]

VERMILION: Final[Colour] = (213, 94, 0)
GREEN: Final[Colour] = (0, 158, 115)
BLUE: Final[Colour] = (0, 114, 178)
AXIS_COLOURS: Final[dict[str, Colour]] = {
    "gx": VERMILION, "gy": GREEN, "gz": BLUE, "ax": VERMILION, "ay": GREEN, "az": BLUE,
}  # fmt: skip
GREY: Final[Colour] = (124, 129, 134)  # labels, keys, models, predictions, and fits that do not describe the curve
FRAME: Final[Colour] = (135, 139, 143)
PALE: Final[Colour] = (226, 228, 230)  # middle of a colour scale between two colours
TEMPERATURE: Final[Colour] = (204, 121, 167)  # reddish purple of the same palette


def blend_colours(colour: Colour, colour_share: float, background: Colour = GREY) -> Colour:
    """Return a mixture of two colours. By default, the colour becomes greyer.

    Parameters
    ----------
    colour
        First colour as red, green and blue, 0 to 255.
    colour_share
        Share of the first colour, 0 to 1.
    background
        Second colour as red, green and blue, 0 to 255.
    """
    r, g, b = (round(colour_share * c + (1 - colour_share) * d) for c, d in zip(colour, background, strict=True))
    return r, g, b
