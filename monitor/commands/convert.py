"""Command ``convert``: reads a recording in any format and writes the samples in another format."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.host.safe_file_reading import real_path
from drivers.recordings import Recording, save_samples
from drivers.recordings.file_formats.mcap_writer import IMU_TOPIC, TEMPERATURE_TOPIC
from drivers.recordings.formats import find_writer
from drivers.recordings.topic_selection import JOIN
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording


def run_conversion(
    path: Path,
    out: Path,
    loading: LoadingOptions = DEFAULT_LOADING,
    report_progress: ProgressCallback = ignore_progress,
) -> Recording:
    """Read a recording, write its samples, and return the recording.

    Times and values are written without rounding, except that MCAP stores times in whole nanoseconds. If the recording
    has no times, the times begin at 0 and follow from the sample rate.

    Parameters
    ----------
    path, out : Path
        Recording to read, and file to write.
    loading : LoadingOptions, optional
        Options for reading the recording.
    report_progress : callable, optional
        Function that receives the progress.

    Raises
    ------
    ConfigError, RecordingError
        If the recording cannot be read, or if the file cannot be written.
    """
    find_writer(out)
    if real_path(path) == real_path(out):
        raise ConfigError(f"{out}: is the recording itself; choose another name")
    found = load_recording(path, loading, report_progress)
    axes = [axis for axis in found.axes if not np.isnan(found.values[:, AXES.index(axis)]).all()] or found.axes
    times = found.times
    if times is None:
        assert found.rate_hz is not None
        times = np.arange(len(found)) / found.rate_hz
    save_samples(out, times, found.values, found.temperature_c, axes, partial(report_progress, "writing"))
    if has_temperature(found) and out.suffix.lower() == ".mcap":
        topic = JOIN.join((IMU_TOPIC, TEMPERATURE_TOPIC))
        note = f"The temperature has a topic of its own; read both with --topic {topic}."
        return replace(found, notes=(*found.notes, note))
    return found


def has_temperature(recording: Recording) -> bool:
    """Return True if at least one sample has a temperature."""
    return not np.isnan(recording.temperature_c).all()
