"""Effects of a noise model, with their parameters in SI units (docs/reference/effects.md)."""

from monitor.noise.effects import *  # noqa: F403 - every effect is public
