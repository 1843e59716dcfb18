"""Check of decoded samples against the configuration of a live stream.

The samples are examined in windows of at least 10 s and 128 samples. If two consecutive windows show that a unit is
impossible (``drivers.impossible_units``) or that the samples of several sensors alternate, the decoder rejects all
samples and reports the problem. Only the first windows are examined, so that the check costs no time later.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats, Ints
from drivers.impossible_units import ImpossibleUnit, find_impossible_unit

MIN_WINDOW_S: Final = 10.0
MIN_WINDOW_SAMPLES: Final = 128
MAX_WINDOW_SAMPLES: Final = 50_000
"""Number of samples that limits the memory of a window."""
MAX_WINDOWS: Final = 60
"""Number of windows after which the samples are no longer examined."""

MAX_SENSORS: Final = 4
MIN_ALTERNATING_HZ: Final = 5.0
"""Sample rate below which one sensor could be turned between two samples."""
MIN_SHARE: Final = 0.1
"""Smallest share of the samples that each of several sensors sends."""
MIN_ALTERNATION: Final = 0.4
"""Smallest share of the samples that come from another sensor than the sample before."""
MAX_STEP_RAD: Final = 0.2
"""Largest rotation between two samples. A larger one may be a fraction of a turn, which repeats itself."""
MIN_DISTANCE: Final = 5.0
"""Smallest distance between the values of two sensors, in units of the range of the values of each sensor."""
MIN_DISTINCT_VALUES: Final = 4
"""Number of distinct values of each sensor, which a single sensor with a coarse resolution does not reach."""


@dataclass(frozen=True, slots=True)
class StreamConfiguration:
    """What the configuration states about a stream, and what the user has to change."""

    units: tuple[str, str]  # units of the angular rates and of the accelerations
    stated: tuple[bool, bool]  # True for a unit that the user states
    describe_unit_remedy: Callable[[ImpossibleUnit], str]
    sensor_remedy: str  # how to select one of several sensors


def configure_si_messages(sensor_remedy: str) -> StreamConfiguration:
    """Return the configuration of messages whose format prescribes rad/s and m/s²."""
    return StreamConfiguration(
        ("rad/s", "m/s²"),
        (True, True),
        lambda found: f"the sender has to convert {found.fits} to {'rad/s' if found.triad == 'gyro' else 'm/s²'}",
        sensor_remedy,
    )


class LiveStreamCheck:
    """Check of the samples of one stream."""

    def __init__(self, configuration: StreamConfiguration) -> None:
        self._configuration = configuration
        self.forget_samples()

    def forget_samples(self) -> None:
        """Begin again, because the configuration or the sender may have changed."""
        self.problem = ""
        """Contradiction between samples and configuration, with the remedy; "" if there is none."""
        self._blocks: list[tuple[Ints, Floats]] = []  # arrival times and values of the window
        self._count = self._windows = 0  # numbers of samples in the window, and of examined windows
        self._suspected = ""  # result of the last window

    def add_samples(self, t_ns: Ints, values: Floats) -> None:
        """Examine samples, whose values [n, 6] are in rad/s and m/s², or infinite if rejected. Update ``problem``."""
        if self.problem or self._windows >= MAX_WINDOWS:
            return
        accepted = ~np.isinf(values).any(axis=1)
        t_ns, values = t_ns[accepted], values[accepted]
        if not t_ns.size:
            return
        self._blocks.append((t_ns, values))
        self._count += t_ns.size
        count, duration_s = self._count, int(t_ns[-1] - self._blocks[0][0][0]) * 1e-9
        if count < MAX_WINDOW_SAMPLES and (duration_s < MIN_WINDOW_S or count < MIN_WINDOW_SAMPLES):
            return
        window = np.concatenate([one for _, one in self._blocks])
        self._blocks, self._count = [], 0
        self._windows += 1
        # A capture that is replayed at once has no usable arrival times.
        problem = self._examine(window, count / duration_s) if duration_s >= MIN_WINDOW_S else ""
        self.problem = problem if problem and self._suspected else ""
        self._suspected = problem

    def _examine(self, values: Floats, rate_hz: float) -> str:
        configuration = self._configuration
        sensors = describe_alternating_sensors(values, rate_hz)
        if sensors:
            return f"{sensors}: {configuration.sensor_remedy}"
        found = find_impossible_unit(values, rate_hz, configuration.units, configuration.stated)
        return f"{found.observation}: {configuration.describe_unit_remedy(found)}" if found is not None else ""


def describe_alternating_sensors(values: Floats, rate_hz: float) -> str:
    """Return a text if samples of several sensors at rest alternate, or an empty text.

    The values of at least two axes then form a few narrow groups, and the samples often change from one group to
    another. Motion has values between the groups, unless the sensor turns far between two samples.

    Parameters
    ----------
    values
        [n, 6] float64 in the order of AXES, in rad/s and m/s².
    rate_hz
        Sample rate in Hz.
    """
    if len(values) < MIN_WINDOW_SAMPLES or rate_hz < MIN_ALTERNATING_HZ:
        return ""
    if not np.median(np.linalg.norm(values[:, :3], axis=1)) < MAX_STEP_RAD * rate_hz:  # also True for NaN
        return ""
    found: dict[bytes, tuple[str, list[Floats]]] = {}  # first axis and groups by the sensor of each sample
    for axis, column in zip(AXES, values.T, strict=True):
        order = np.sort(column)
        for sensors in range(2, MAX_SENSORS + 1) if np.isfinite(column).all() else ():
            cuts = np.sort(np.argpartition(np.diff(order), 1 - sensors)[1 - sensors :]) + 1
            groups = np.split(order, cuts)
            if not _are_separate(groups, column.size):
                continue
            member = np.searchsorted(order[cuts], column, side="right")
            _, first, member = np.unique(member, return_index=True, return_inverse=True)
            member = np.argsort(np.argsort(first))[member]  # numbered in the order in which the sensors appear
            if np.mean(member[1:] != member[:-1]) < MIN_ALTERNATION:
                continue
            if (other := found.get(member.tobytes())) is not None:
                means = ", ".join(f"{group.mean():.3g}" for group in other[1])
                unit = "rad/s" if other[0].startswith("g") else "m/s²"
                return f"the samples of {sensors} sensors alternate ({other[0]} = {means} {unit})"
            found[member.tobytes()] = axis, groups
    return ""


def _are_separate(groups: Sequence[Floats], count: int) -> bool:
    """Return True if sorted groups are large enough, and narrow compared with the distances between them."""
    if min(group.size for group in groups) < MIN_SHARE * count:
        return False
    widest = max(float(group[-1] - group[0]) for group in groups)
    nearest = min(float(after[0] - before[-1]) for before, after in pairwise(groups))
    return nearest >= MIN_DISTANCE * widest and min(np.unique(group).size for group in groups) >= MIN_DISTINCT_VALUES
