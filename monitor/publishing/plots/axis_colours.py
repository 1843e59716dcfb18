"""Colours of the x, y and z axes in all plots, which colour-blind people can distinguish.

The colours are vermilion, bluish green and sky blue of the Okabe-Ito palette. They also differ in lightness.
The gyroscope and the accelerometer of an axis have the same colour, because they never appear in the same plot.
"""

from typing import Final

Colour = tuple[int, int, int]

AXIS_COLOURS: Final[dict[str, Colour]] = {
    "gx": (213, 94, 0),
    "gy": (0, 158, 115),
    "gz": (86, 180, 233),
    "ax": (213, 94, 0),
    "ay": (0, 158, 115),
    "az": (86, 180, 233),
}
BACKGROUND: Final[Colour] = (13, 16, 17)
FRAME: Final[Colour] = (92, 98, 104)
MAJOR: Final[Colour] = (48, 53, 57)
MINOR: Final[Colour] = (23, 27, 29)
TEXT: Final[Colour] = (236, 239, 242)  # legible on label boxes in the dark and in the light theme of the viewer
KEY: Final[Colour] = (150, 160, 170)  # signs in the key of a plot
TEMPERATURE: Final[Colour] = (236, 180, 72)


def blend_colours(colour: Colour, colour_share: float, background: Colour = BACKGROUND) -> Colour:
    """Return the colour in which a translucent area appears on a background.

    Parameters
    ----------
    colour
        Colour of the area as red, green and blue, 0 to 255.
    colour_share
        Opacity of the area, 0 to 1.
    background
        Colour of the background as red, green and blue, 0 to 255.
    """
    r, g, b = (round(colour_share * c + (1 - colour_share) * d) for c, d in zip(colour, background, strict=True))
    return r, g, b
