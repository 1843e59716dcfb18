"""One colour an axis, in every picture: x red, y green, z blue, in shades that colour-blind eyes tell apart.

Lightness differs as well as hue (deuteranopia and protanopia keep vermilion, bluish green and sky blue
of Okabe & Ito's palette apart; these are close to them). A gyroscope and an accelerometer of the same
direction share the colour: they never share a plot.
"""

from typing import Final

Colour = tuple[int, int, int]

AXIS_COLOURS: Final[dict[str, Colour]] = {
    "gx": (240, 98, 77),
    "gy": (45, 190, 130),
    "gz": (84, 160, 255),
    "ax": (240, 98, 77),
    "ay": (45, 190, 130),
    "az": (84, 160, 255),
}
BACKGROUND: Final[Colour] = (13, 16, 17)
FRAME: Final[Colour] = (92, 98, 104)
MAJOR: Final[Colour] = (48, 53, 57)
MINOR: Final[Colour] = (23, 27, 29)
TEXT: Final[Colour] = (236, 239, 242)  # read on the label boxes of the dark and of the light theme
TEMPERATURE: Final[Colour] = (236, 180, 72)


def mixed(colour: Colour, share: float, ground: Colour = BACKGROUND) -> Colour:
    """``share`` of a colour over a ground: what a translucent fill would look like."""
    r, g, b = (round(share * c + (1 - share) * d) for c, d in zip(colour, ground, strict=True))
    return r, g, b
