"""Matplotlib figure that a notebook displays as an image. This module imports matplotlib."""

import io
from typing import Final

from matplotlib.figure import Figure

NOTEBOOK_DPI: Final = 80.0


class NotebookFigure(Figure):
    """Figure that a notebook displays as a picture. A plain figure is displayed only if it was created with pyplot."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=NOTEBOOK_DPI)
        return picture.getvalue()
