"""Size of an installation: without extras, and what each extra adds.

    python -m tests.bench.installation [--source FOLDER] [--extra NAME ...]

Each row is a fresh virtual environment, into which pip installs the project with the extra. Counted are the sizes of
all files that pip adds to site-packages, with the bytecode that it compiles, in MB of 10⁶ bytes. What a fresh
environment holds already (pip, setuptools) is not counted. Needs the package registry and room for one environment.
"""

import argparse
import os
import subprocess
import sys
import tomllib
import venv
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.bench.machine import console, table

ROOT: Final = Path(__file__).parents[2]
DEVELOPMENT: Final = ("test", "fuzz")
"""Extras that a user does not install."""
LARGEST: Final = 6
MB: Final = 1e6


def sizes(folder: Path) -> Counter[str]:
    """Return the bytes of each package in a site-packages folder, by the name of its folder or file."""
    found = Counter[str]()
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place, name)
            if not path.is_symlink():
                top = path.relative_to(folder).parts[0]
                found[top.removesuffix(".libs").partition("-")[0]] += path.stat().st_size
    return found


def installed(source: Path, extra: str) -> Counter[str]:
    """Return the bytes that pip adds to a fresh environment, by package."""
    with TemporaryDirectory(prefix="imu-monitor-") as temporary:
        folder = Path(temporary) / "venv"
        venv.create(folder, with_pip=True)
        (packages,) = folder.glob("lib/python*/site-packages")
        before = sizes(packages)
        what = f"{source}[{extra}]" if extra else str(source)
        command = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", what]
        subprocess.run(command, check=True, stdout=sys.stderr)
        return sizes(packages) - before


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--source", type=Path, default=ROOT, help="checkout to install")
    parser.add_argument("--extra", action="append", help="only these; else every extra of the project")
    given = parser.parse_args()
    project = tomllib.loads((given.source / "pyproject.toml").read_text("utf-8"))["project"]
    extras = given.extra or [one for one in project["optional-dependencies"] if one not in DEVELOPMENT]
    shown = table("installed size, MB", "extra", "whole", "it adds", "largest packages of what it adds")
    base = installed(given.source, "")
    for extra in ("", *extras):
        found = installed(given.source, extra) if extra else base
        added = found - base if extra else found
        largest = ", ".join(f"{name} {size / MB:.0f}" for name, size in added.most_common(LARGEST) if size > 0.5 * MB)
        shown.add_row(
            extra or "(none)", f"{found.total() / MB:.1f}", f"{(found.total() - base.total()) / MB:.1f}", largest
        )
    console.print(f"Python {sys.version.split()[0]}, {given.source.resolve().name}")
    console.print(shown)


if __name__ == "__main__":
    main()
