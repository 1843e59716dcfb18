"""Descriptions of what the pictures in ``docs/pictures`` show: layout, titles, labels and colours.

``python -m tests.experiments.pictures`` stores a checksum of each description beside the pictures. A test compares the
checksums with those of the present program, and fails if a picture shows an old layout.
"""

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from monitor.publishing.plots import axis_colours, style
from monitor.publishing.plots.allan_figure import draw_allan_panel
from monitor.publishing.reports import html_page
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription
from tests.monitor.publishing.example_results import make_estimate

PICTURES: Final = Path(__file__).resolve().parents[2] / "docs" / "pictures"
CHECKSUMS: Final = PICTURES / "sources.json"
TEMPLATES: Final = Path(html_page.__file__).parent / "templates"
REPORT_TEMPLATES: Final = (TEMPLATES / "page.html.j2", TEMPLATES / "report.html.j2")


def describe_viewer(page: str, *devices: str, fleet: bool = False) -> object:
    """Describe the page that a picture shows, the names of all pages, and the signs and colours of the Allan plots."""
    from monitor.publishing.rerun.allan_drawing import KEY
    from monitor.publishing.rerun.blueprint import blueprint

    listed = [ViewerDeviceDescription(name, has_model=True, has_thermal=True, compensated=True) for name in devices]
    pages = {one.name: one for one in blueprint(listed, fleet).root_container.contents}
    colours = {name: value for name, value in vars(axis_colours).items() if name.isupper()}
    return list(pages), _describe_view(pages[page]), KEY, colours


def _describe_view(part: Any) -> object:
    if hasattr(part, "class_identifier"):
        return part.class_identifier, part.name, part.origin
    shares = [getattr(part, name) for name in ("column_shares", "row_shares", "grid_columns")]
    return type(part).__name__, part.name, shares, [_describe_view(one) for one in part.contents]


def describe_allan_figure() -> object:
    """Describe the labels and colours of the Allan plots of ``analyze``."""
    with style.figure_style():
        figure = style.create_figure(8.0, 4.0)
        for panel, kind in zip(figure.subplots(1, 2), ("gyro", "accel"), strict=True):
            draw_allan_panel(panel, make_estimate(), kind)
        return _describe_texts(figure), style.COLOURS


def _describe_texts(figure: Any) -> list[str]:
    """Return the texts of a figure, without the numbers, because those depend on the data."""
    from matplotlib.text import Text

    texts = {re.sub(r"[\d.,⁰¹²³⁴-⁹⁻−]+", "#", one.get_text()) for one in figure.findobj(Text)}
    return sorted(texts)


SOURCES: Final[dict[str, Callable[[], object]]] = {
    **dict.fromkeys(
        ("viewer", "viewer-history", "viewer-web", "demo-effect"), lambda: describe_viewer("Device", "bench-1")
    ),
    "viewer-dynamic": lambda: describe_viewer("What changed", "bench-1"),
    "viewer-temperature": lambda: describe_viewer("Temperature", "bench-1"),
    "viewer-drift": lambda: describe_viewer("Drift", "bench-1"),
    "viewer-gap": lambda: describe_viewer("Model gap", "bench-1"),
    "viewer-fleet": lambda: describe_viewer("Overview", "a", "b", "c"),
    "view-fleet": lambda: describe_viewer("Fleet", "a", "b", fleet=True),
    **dict.fromkeys(("allan-plot", "dynamic-plot"), describe_allan_figure),
    "report": lambda: (describe_allan_figure(), [path.read_text("utf-8") for path in REPORT_TEMPLATES]),
}
"""Description of each picture, by the name of its file."""


def checksum(picture: str) -> str:
    """Return the checksum of the description of a picture."""
    text = json.dumps(SOURCES[picture](), ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_checksums() -> dict[str, str]:
    """Return the checksums of the pictures, by the name of the file."""
    stored: dict[str, str] = json.loads(CHECKSUMS.read_text("utf-8"))
    return stored


def store_checksum(path: Path) -> None:
    """Store the checksum of a new picture."""
    if path.parent == PICTURES and path.stem in SOURCES:
        stored = read_checksums() | {path.stem: checksum(path.stem)}
        CHECKSUMS.write_text(json.dumps(dict(sorted(stored.items())), indent=1) + "\n", "utf-8")
