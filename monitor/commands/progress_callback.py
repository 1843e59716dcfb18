"""Callback that reports the progress of a command."""

from collections.abc import Callable

ProgressCallback = Callable[[str, float | None], None]
"""Callback that receives the current step and its completed fraction from 0 to 1, which is None if unknown."""


def ignore_progress(_step: str, _share: float | None) -> None:
    """Ignore the progress of a command."""
