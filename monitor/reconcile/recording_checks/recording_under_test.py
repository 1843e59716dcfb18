"""Recording as the checks see it, with a simulation of the model under test."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from drivers.data_types import Floats
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import RecordingFinding

CheckResult: TypeAlias = tuple[Mapping[str, Floats], list[RecordingFinding]]
"""Samples after the correction of the faults that can be corrected, and the findings."""


@dataclass(frozen=True, slots=True)
class RecordingUnderTest:
    """Samples of a recording, and the model with which they are compared."""

    values: Mapping[str, Floats]  # samples of each axis on a regular grid in rad/s or m/s²; NaN means missing
    rate_hz: float
    model: NoiseModel | None = None
    simulated: Mapping[str, Floats] | None = None  # simulation of the model with the length of the recording
    seed: int = 0  # of random numbers that replace samples

    @property
    def sample_count(self) -> int:
        """Number of samples of each axis."""
        return next(iter(self.values.values())).size
