"""Reading of recordings that consist of one CSV file per sensor, in a folder or in a zip archive.

phyphox and Sensor Logger write one file per sensor, such as ``Gyroscope.csv`` and ``Accelerometer.csv``. Each file has
times of its own. Each file is treated as a topic, and the topics are joined like those of a log
(``drivers.recordings.topic_selection``).

The layouts are those of phyphox/phyphox-android (``DataExport.java``) and tszheichoi/awesome-sensor-logger
(``UNITS.md``). ``Accelerometer.csv`` of Sensor Logger contains no gravity, so ``TotalAcceleration.csv`` is preferred.
"""

import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Final

from drivers.data_types import AXES
from drivers.errors import ConfigError, RecordingError
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import table
from drivers.recordings.column_names import names_sensor_kind
from drivers.recordings.file_formats.csv_format import (
    CsvSource,
    read_csv_column_names,
    read_csv_source,
)
from drivers.recordings.file_formats.csv_row_kinds import find_row_sources
from drivers.recordings.file_formats.zip_index import IndexSizeLimitedFile
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table_layout import convert_to_si, find_layout
from drivers.recordings.topic_selection import GYROS, JOIN, RecordedTopic, join_topics, select_topics

GYROSCOPES: Final = ("Gyroscope", "GyroscopeUncalibrated")
ACCELEROMETERS: Final = ("TotalAcceleration", "Accelerometer", "AccelerometerUncalibrated", "Linear Acceleration")
"""Names of files, the preferred name first."""
MAX_FILES: Final = 100
"""Maximum number of CSV files that are searched for sensors."""
TABLE_SUFFIXES: Final = (".csv", ".txt", ".dat", ".tsv")
EXPECTED: Final = "CSV files of sensors, such as Gyroscope.csv and Accelerometer.csv"


def is_sensor_folder(path: Path) -> bool:
    """Return True if a folder contains a file of a phone app, or one table of each of the two sensors."""
    if not path.is_dir():
        return False
    if any((path / f"{name}.csv").is_file() for name in (*GYROSCOPES, *ACCELEROMETERS)):
        return True
    kinds = [names_sensor_kind(one.stem) for one in _list_tables(path)]
    return kinds.count("g") == kinds.count("a") == 1


def _list_tables(folder: Path) -> list[Path]:
    return sorted(one for one in folder.iterdir() if one.suffix.lower() in TABLE_SUFFIXES)[:MAX_FILES]


def read_sensor_files(path: Path, options: ReadingOptions) -> table.Table:
    """Read the CSV files of a gyroscope and an accelerometer from a folder or a zip archive.

    Raises
    ------
    RecordingError
        If no file contains an axis, or if a file cannot be read.
    ConfigError
        If the topic is unknown or has to be chosen, or if the samples do not fit into memory.
    """
    notes: list[str] = []
    tables: dict[str, table.Columns] = {}
    stated: dict[str, str] = {}
    of_file = options.model_copy(update={"topic": None})
    with _open_sources(path) as sources:
        for name in _select(path, sources, options.topic, of_file, notes):
            found = convert_to_si(path, read_csv_source(sources[name], of_file), of_file)
            if not {"t", table.TIME_NS} & {*found.columns}:
                raise RecordingError(f"{sources[name].label}: has no times, expected a column such as seconds_elapsed")
            tables[name] = found.columns
            stated |= found.units
            notes += [f"{name}: {note}" for note in found.notes]
    return table.Table(join_topics(path, tables, notes), None, notes, stated)


def _select(
    path: Path, sources: Mapping[str, CsvSource], topic: str | None, options: ReadingOptions, notes: list[str]
) -> list[str]:
    """Return the names of the sensors to read."""
    topics = [_describe(source, name, options) for name, source in sources.items()]
    measured = {topic.name: topic.columns for topic in topics}
    whole = [name for name, columns in measured.items() if {*columns} & {*GYROS} and {*columns} & {*AXES[3:]}]
    single = {name: columns for name, columns in measured.items() if name not in whole}
    gyros = _by_preference(GYROSCOPES, [name for name, columns in single.items() if {*columns} & {*GYROS}])
    others = [name for name, columns in single.items() if {*columns} & {*AXES} and name not in gyros]
    accelerometers = _by_preference(ACCELEROMETERS, others)
    known = bool(gyros) and gyros[0] in GYROSCOPES
    pairs = [JOIN.join((gyro, one)) for gyro in (gyros[:1] if known else gyros) for one in accelerometers]
    names = [*whole, *(pairs or [*gyros, *accelerometers])]
    imus = [[name] for name in names] if known or len(whole) == 1 else [names]
    return select_topics(path, topics, imus, topic, EXPECTED, notes)


def _by_preference(preferred: tuple[str, ...], names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: preferred.index(name) if name in preferred else len(preferred))


def _describe(source: CsvSource, name: str, options: ReadingOptions) -> RecordedTopic:
    """Return the sensor of a CSV file. Files of other sensors have no columns."""
    try:
        names = read_csv_column_names(source, options)
        columns = tuple(find_layout(Path(source.label), names, options, [], sensor=source.sensor).columns)
    except (ConfigError, RecordingError):
        if name in (*GYROSCOPES, *ACCELEROMETERS) or names_sensor_kind(name) == "g":
            raise
        return RecordedTopic(name, "other columns", (), 0)
    return RecordedTopic(name, "CSV", columns, 1)


@contextmanager
def _open_sources(path: Path) -> Iterator[dict[str, CsvSource]]:
    """Yield the CSV files of a folder or a zip archive by name, without the suffix."""
    if path.is_dir():
        files = _list_tables(path)
        yield {one.stem: CsvSource(one, str(one), one.stem, partial(open_regular_file, one)) for one in files}
        return
    if rows := find_row_sources(path):
        yield rows
        return
    with IndexSizeLimitedFile(path) as file:
        try:
            archive = zipfile.ZipFile(file)
        except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise RecordingError(
                f"{path}: is no complete zip archive: {error}{table.describe_suffix_mismatch(path)}"
            ) from error
        with archive:
            members = [one for one in archive.infolist() if one.filename.lower().endswith(".csv")][:MAX_FILES]
            yield {
                (stem := Path(one.filename).stem): CsvSource(
                    path, f"{path}: {one.filename}", stem, partial(_open_member, path, archive, one)
                )
                for one in members
                if one.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) and "meta/" not in one.filename
            }


@contextmanager
def _open_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[IO[bytes]]:
    """Open a file in an archive, and convert errors of zipfile to RecordingError."""
    try:
        with archive.open(member) as file:
            yield file
    except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, UnicodeDecodeError) as error:
        # RuntimeError means that the file is encrypted.
        raise RecordingError(f"{path}: {member.filename} cannot be read: {error}") from error
