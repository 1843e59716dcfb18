"""Progress callback of the commands."""

from collections.abc import Callable

ProgressCallback = Callable[[str, float | None], None]
"""Callback with two arguments: the current step, and its completed share from 0 to 1, or None if unknown."""


def ignore_progress(_step: str, _share: float | None) -> None:
    """Show no progress."""
