"""Command line with which the program starts itself in a child process."""

import sys
from pathlib import Path
from typing import Final

PROGRAM: Final = (sys.executable, "-P", str(Path(__file__).resolve().parents[2] / "imu_monitor.py"))
"""Interpreter and path of the program. The option -P keeps the folder of the program out of the module path.

A foreign module with the name ``monitor`` is therefore never imported. The caller appends the name of a command.
"""
