"""Command line that starts this program in a child process."""

import sys
from pathlib import Path
from typing import Final

PROGRAM: Final = (sys.executable, "-P", str(Path(__file__).resolve().parents[2] / "imu_monitor" / "__init__.py"))
"""Python interpreter, options and path of the program, to which the caller appends a command.

The Python option -P prevents the import of unrelated modules with the name ``monitor``.
"""
