"""Removal of control characters from texts of other origin, such as file names and messages of other programs.

A terminal interprets control characters, and a browser hides them or reverses the direction of the text.
"""

import re
from typing import Final

CONTROL_CHARACTERS: Final = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def remove_control_characters(text: str, kept: str = "") -> str:
    """Replace control characters with spaces.

    Parameters
    ----------
    text : str
        Text of any origin.
    kept : str, optional
        Control characters that are kept, such as line breaks.

    Examples
    --------
    >>> remove_control_characters("link\\x1b[2J lost\\nnow")
    'link [2J lost now'
    """
    return CONTROL_CHARACTERS.sub(lambda found: found[0] if found[0] in kept else " ", text)
