"""Topics of a recording: the choice of the topic to read, and the join of a gyroscope with an accelerometer.

A log of a robot or of an autopilot contains messages of many kinds. A topic is a stream of messages of one kind, such
as the ROS topic ``/imu/data`` or the second instance of the PX4 topic ``sensor_gyro``.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Times
from drivers.errors import ConfigError, RecordingError
from drivers.recordings.table import TIME_NS, Columns, column_seconds, format_name_list
from drivers.validation.module_lookup import format_choices_by_similarity

JOIN: Final = "+"
"""Separator of two topics that are read as one IMU."""
GYROS: Final = AXES[:3]
BLOCK_ROWS: Final = 4096
"""Number of rows that are converted to arrays at once. As Python objects, a row needs about 400 bytes."""
MAX_RATE_DIFFERENCE: Final = 0.1
"""Largest relative difference of the mean rates of two topics that are joined. Lost messages reduce a mean rate."""
MIN_STATED_DELAY: Final = 0.02
"""Smallest delay between joined samples that is stated, as a fraction of the sampling interval."""
MIN_COMMON_SHARE: Final = 0.5
"""Smallest share of the rows that a joined topic needs to contain."""
HOW_TO_CHOOSE: Final = "choose with --topic (in a configuration file: topic)"


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic of a file."""

    name: str
    message_type: str
    columns: tuple[str, ...]  # columns of a recording that the messages contain; empty for other messages
    rows: int  # number of messages according to the file


def select_topics(
    path: Path,
    topics: Sequence[RecordedTopic],
    imus: Sequence[Sequence[str]],
    wanted: str | None,
    expected: str,
    notes: list[str],
) -> list[str]:
    """Return the names of the topics to read.

    Parameters
    ----------
    path
        Path of the file, used in error messages.
    topics
        All topics of the file.
    imus
        Names of the IMUs of the file, grouped by the kind of message. The preferred kind is first. A name may join two
        topics.
    wanted
        Name of a topic, or of several topics separated by JOIN. None selects the only IMU of the file.
    expected
        Description of the expected messages, used in error messages.
    notes
        List to which a note is appended if the file contains the samples of the IMU in several kinds of messages.

    Raises
    ------
    ConfigError
        If the topic does not exist or contains other messages, or if the user must choose a topic.
    RecordingError
        If the file contains no samples of an IMU.
    """
    readable = [topic.name for topic in topics if topic.columns and topic.rows]
    if wanted is None:
        if not any(set(topic.columns) & {*AXES} for topic in topics if topic.rows):
            found = [f"{topic.name} ({topic.message_type})" for topic in topics]
            has = f"found {format_name_list(found)}" if found else "found no messages"
            raise RecordingError(f"{path}: contains no samples of an IMU; expected {expected}, {has}")
        wanted = _select_only_imu(path, imus, readable, notes)
    known = {topic.name: topic for topic in topics}
    chosen = [_find_topic(path, known, name, readable, expected) for name in wanted.split(JOIN)]
    if not any(axis in topic.columns for topic in chosen for axis in AXES):
        raise ConfigError(
            f'{path}: topic "{wanted}" contains no gyroscope and no accelerometer; '
            f"add one, as in --topic {readable[0]}{JOIN}{wanted}"
        )
    return list(dict.fromkeys(topic.name for topic in chosen))


def _select_only_imu(path: Path, imus: Sequence[Sequence[str]], readable: Sequence[str], notes: list[str]) -> str:
    every = [name for group in imus for name in group]
    if not every or max(map(len, imus)) > 1:
        among = every or readable
        listed = f"contains {len(among)} IMU topics: {format_name_list(among)}"
        raise ConfigError(f"{path}: {listed}; {HOW_TO_CHOOSE}, such as {among[0]}")
    if len(every) > 1:
        notes.append(f"Topic {every[0]} is read; the file also contains {format_name_list(every[1:])}.")
    return every[0]


def _find_topic(
    path: Path, topics: Mapping[str, RecordedTopic], name: str, readable: Sequence[str], expected: str
) -> RecordedTopic:
    topic = topics.get(name) or topics.get(name.removesuffix(":0"))
    choices = format_choices_by_similarity(name, readable) if readable else ""
    if topic is None:
        raise ConfigError(f'{path}: contains no topic "{name}"{choices or f"; it contains no {expected}"}')
    if not topic.columns:
        raise ConfigError(f'{path}: topic "{name}" contains {topic.message_type}, expected {expected}{choices}')
    if not topic.rows:
        raise RecordingError(f'{path}: topic "{name}" contains no messages')
    return topic


def pair_triads(gyros: Sequence[str], accels: Sequence[str], sensor: Callable[[str], object]) -> list[str]:
    """Return the joined names of gyroscopes and accelerometers of the same sensor. ``sensor`` tells it from a name."""
    return [f"{gyro}{JOIN}{accel}" for gyro in gyros for accel in accels if sensor(gyro) == sensor(accel)]


def join_topics(path: Path, tables: Mapping[str, Columns], notes: list[str]) -> dict[str, Times]:
    """Join the columns of several topics.

    The first topic determines the rows. The gyroscope comes from the first topic that contains one, and the
    accelerometer from the last topic that contains one. Values of another topic belong to the row with the nearest time
    within half a sampling interval. A temperature without axes applies until the next temperature.

    Parameters
    ----------
    path
        Path of the file, used in error messages.
    tables
        Columns of each topic, which include ``t`` or ``t_ns``. The first topic contains at least one axis.
    notes
        A note is appended if samples of two topics that are joined have different times.

    Raises
    ------
    ConfigError
        If two topics with axes have different rates.
    """
    first, *others = tables
    joined = dict(tables[first])
    for name in others:
        columns = tables[name]
        t_s, other_s = column_seconds(joined), column_seconds(columns)
        if any(axis in columns for axis in AXES):
            _check_equal_rates(path, {first: t_s, name: other_s})
            rows = _nearest_rows(t_s, other_s)
            common = int(np.count_nonzero(rows >= 0))
            if common < MIN_COMMON_SHARE * t_s.size:
                raise ConfigError(
                    f"{path}: only {common} of {t_s.size} samples of {first} have a sample of {name} at the same time; "
                    f"{_suggest_two_analyses(path, (first, name))}"
                )
            delay_s = float(np.median((other_s[rows] - t_s)[rows >= 0]))
            if abs(delay_s) > MIN_STATED_DELAY * (t_s[-1] - t_s[0]) / t_s.size:
                notes.append(
                    f"Samples of {name} have the times of {first}, although they are {abs(delay_s) * 1e3:.3g} ms "
                    f"{'later' if delay_s > 0.0 else 'earlier'}; --topic {quote(name)} reads them with their own times."
                )
        else:
            rows = _preceding_rows(t_s, other_s)
        for key, column in columns.items():
            if key in ("t", TIME_NS) or (key in GYROS and key in joined):
                continue
            joined[key] = np.where(rows < 0, np.nan, column[rows])
    return joined


def _check_equal_rates(path: Path, times: Mapping[str, Floats]) -> None:
    rates = {name: (t.size - 1) / max(float(t[-1] - t[0]), 1e-9) for name, t in times.items()}
    if max(rates.values()) > (1.0 + MAX_RATE_DIFFERENCE) * min(rates.values()):
        what = " and ".join(f"{name} {rate:.4g} Hz" for name, rate in rates.items())
        raise ConfigError(
            f"{path}: mixed rates: {what}, and samples are never resampled; {_suggest_two_analyses(path, rates)}"
        )


def _suggest_two_analyses(path: Path, names: Iterable[str]) -> str:
    commands = [
        f"`imu-monitor analyze {quote(str(path))} --topic {quote(name)} --json {number}.json`"
        for number, name in enumerate(names, 1)
    ]
    return (
        f"read each topic with its own command: {' and '.join(commands)}; "
        "`imu-monitor export 1.json 2.json --format kalibr` joins the results"
    )


def _nearest_rows(t: Floats, other: Floats) -> NDArray[np.intp]:
    """Return the row of ``other`` that is nearest to each time. -1 marks a time without such a row.

    No row is returned twice, and the distance is at most half the mean sampling interval.
    """
    order = np.argsort(other, kind="stable")
    after = np.clip(np.searchsorted(other[order], t), 1, max(other.size - 1, 1))
    near = np.minimum(after, other.size - 1)
    before = near - (other.size > 1)
    rows = order[np.where(np.abs(t - other[order][before]) <= np.abs(t - other[order][near]), before, near)]
    distance = np.abs(t - other[rows])
    by_distance = np.argsort(distance, kind="stable")
    _, first_use = np.unique(rows[by_distance], return_index=True)
    used = np.zeros(t.size, np.bool_)
    used[by_distance[first_use]] = True
    half_interval_s = 0.5 * (t[-1] - t[0]) / max(t.size - 1, 1)
    return np.where(used & (distance <= half_interval_s), rows, -1)


def _preceding_rows(t: Floats, other: Floats) -> NDArray[np.intp]:
    """Return the last row of ``other`` that is not later than each time, or -1."""
    order = np.argsort(other, kind="stable")
    at = np.searchsorted(other[order], t, side="right") - 1
    return np.where(at < 0, -1, order[at])
