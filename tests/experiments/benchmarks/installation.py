"""Size of an installation: without extras, and what each extra adds.

    python -m tests.experiments.benchmarks.installation [--source FOLDER] [--extra NAME ...]

pip installs the project into a fresh virtual environment, and with each extra into a copy of this environment. Counted
are the sizes of all files that pip adds to site-packages, with the bytecode that it compiles, in MB of 10⁶ bytes. What
a fresh environment holds already (pip, setuptools) is not counted. Needs the package registry and 1.5 GB of disk.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tomllib
import venv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.experiments.benchmarks.machine import console, create_table

ROOT: Final = Path(__file__).parents[3]
DEVELOPMENT: Final = ("test", "fuzz")
"""Extras that a user does not install."""
LARGEST: Final = 6
MB: Final = 1e6


def measure_packages(folder: Path) -> Counter[str]:
    """Return the bytes of each package in a site-packages folder, by the name of its folder or file."""
    found = Counter[str]()
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place, name)
            if not path.is_symlink():
                top = path.relative_to(folder).parts[0]
                found[top.removesuffix(".libs").partition("-")[0]] += path.stat().st_size
    return found


def create_environment(folder: Path) -> Counter[str]:
    """Make a virtual environment with pip, and return the bytes that it holds already."""
    venv.create(folder, with_pip=True)
    return measure_packages(get_site_packages(folder))


def get_site_packages(folder: Path) -> Path:
    """Return the site-packages of an environment."""
    (found,) = folder.glob("lib/python*/site-packages")
    return found


def install(folder: Path, source: Path, extra: str) -> Counter[str]:
    """Install the project into an environment, and return the bytes that this then holds, by package."""
    what = f"{source}[{extra}]" if extra else str(source)
    command = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", what]
    subprocess.run(command, check=True, stdout=sys.stderr)
    return measure_packages(get_site_packages(folder))


def measure_installations(source: Path, extras: Sequence[str]) -> Iterator[tuple[str, Counter[str]]]:
    """Yield the bytes of an installation without extras, named "", and of one with each extra."""
    with TemporaryDirectory(prefix="imu-monitor-") as temporary:
        base, copy = Path(temporary) / "base", Path(temporary) / "extra"
        empty = create_environment(base)
        yield "", install(base, source, "") - empty
        for extra in extras:
            shutil.copytree(base, copy, symlinks=True)
            yield extra, install(copy, source, extra) - empty
            shutil.rmtree(copy)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--source", type=Path, default=ROOT, help="checkout to install")
    parser.add_argument("--extra", action="append", help="only these; else every extra of the project")
    arguments = parser.parse_args()
    project = tomllib.loads((arguments.source / "pyproject.toml").read_text("utf-8"))["project"]
    extras = arguments.extra or [one for one in project["optional-dependencies"] if one not in DEVELOPMENT]
    table = create_table("installed size, MB", "extra", "whole", "it adds", "largest packages of what it adds")
    base = Counter[str]()
    for extra, found in measure_installations(arguments.source.resolve(), extras):
        added = found - base
        largest = ", ".join(f"{name} {size / MB:.0f}" for name, size in added.most_common(LARGEST) if size > 0.5 * MB)
        more = f"{added.total() / MB:.1f}" if extra else ""
        table.add_row(extra or "(none)", f"{found.total() / MB:.1f}", more, largest)
        base = base or found
    console.print(f"Python {sys.version.split()[0]}, {arguments.source.resolve().name}")
    console.print(table)


if __name__ == "__main__":
    main()
