"""Checks of the storage folder: permissions, other processes that use the folder, and disk space."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Final

from drivers.host import safe_file_reading
from drivers.host.extras import install_command
from drivers.validation.number_ranges import DAY_S
from monitor.commands.doctor.finding import DoctorFinding, doubt, user_name, well, wrong
from monitor.common.folder_lock import HISTORY_LOCK, RECORDING_LOCK, describe_lock_holder
from monitor.settings.loading import Config, Storage

SAMPLE_BYTES: Final = 38.0
"""Size in bytes of a sample with six axes, temperature and counter in a compressed recording.

High-resolution sensors need 35.5 to 37.1 bytes per sample. Coarse-resolution sensors need 12 to 16 bytes.
"""


RAW_BYTES: Final = 60.0
"""Approximate number of received bytes per sample. The number depends on the protocol."""


def check_storage(config: Config) -> Iterator[DoctorFinding]:
    """Check the folder of the recordings, other users of the folder, and the disk space."""
    own = config.storage
    if own is None:
        yield doubt("storage", "nothing is stored: after a restart the window is empty", "set folder in [storage]")
        return
    if (own.record or own.raw) and find_spec("pyarrow") is None:
        text = "samples are to be recorded, but pyarrow is not installed"
        yield wrong("storage", text, install_command("imu-monitor[arrow]"))
    folder = next(one for one in (own.folder, *own.folder.parents) if os.path.exists(one))
    try:
        safe_file_reading.check_folder_or_absent(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
        usage = shutil.disk_usage(folder)
    except OSError as error:
        text = f"{own.folder}: cannot be written: {error.strerror or error}"
        yield wrong("storage", text, f"create it, owned by {user_name(os.geteuid())}")
        return
    yield from _check_in_use(own)
    yield check_disk_space(own, recorded_bytes_per_day(config), usage.total, usage.free)


def _check_in_use(own: Storage) -> Iterator[DoctorFinding]:
    wanted = {RECORDING_LOCK: own.record or own.raw, HISTORY_LOCK: own.history}
    do = "no problem if it is this service; otherwise end it, or choose another folder: only one program records"
    for holder in sorted({describe_lock_holder(own.folder, name) for name, on in wanted.items() if on} - {""}):
        yield doubt("storage", f"{own.folder}: in use by {holder}", do)


def recorded_bytes_per_day(config: Config) -> float | None:
    """Return the number of bytes recorded per day for all devices, or None if the sample rate of a device is unknown.

    Examples
    --------
    >>> import dataclasses
    >>> from monitor.common.shipped_config_paths import CONFIG_FOLDER
    >>> from pathlib import Path
    >>> from monitor.settings.loading import load_config
    >>> one = load_config(CONFIG_FOLDER / "demo.toml")
    >>> kept = Storage(folder=Path("kept"))
    >>> recorded_bytes_per_day(dataclasses.replace(one, storage=kept)) == one.devices[0].rate_hz * DAY_S * SAMPLE_BYTES
    True
    """
    own = config.storage
    if own is None:
        return 0.0
    from drivers.links.replay_link import ReplayLink  # slow to import, because it imports all file formats

    each = SAMPLE_BYTES * own.record + RAW_BYTES * own.raw
    rates = [one.rate_hz for one in config.devices if not isinstance(one.link, ReplayLink)]  # replays are not recorded
    known = [rate for rate in rates if rate is not None]
    return None if len(known) < len(rates) else sum(known) * DAY_S * each


def check_disk_space(storage: Storage, bytes_per_day: float | None, total_bytes: int, free_bytes: int) -> DoctorFinding:
    """Check that the disk has enough space for the recordings.

    Parameters
    ----------
    storage : Storage
        Storage settings.
    bytes_per_day : float or None
        Number of bytes that are recorded per day; None if unknown.
    total_bytes : int
        Capacity of the disk in bytes.
    free_bytes : int
        Free space on the disk in bytes.
    """
    allowed = free_bytes - (1.0 - storage.disk_share) * total_bytes
    if bytes_per_day is None:
        text = (
            f"{storage.folder}: {_gb(free_bytes)} free; disk use per day unknown, since a device has no configured rate"
        )
        return doubt("storage", text, "add rate to every device")
    wanted = bytes_per_day * storage.keep_s / DAY_S
    days = max(allowed, 0.0) / bytes_per_day if bytes_per_day else float("inf")
    text = (
        f"{storage.folder}: {_gb(free_bytes)} free, about {_gb(bytes_per_day)} per day, "
        f"{_gb(wanted)} for the whole time of keep"
    )
    if allowed <= 0.0 or days < 1.0:
        do = "free disk space, or record on another disk"
        return wrong("storage", f"{text}: not enough for one day below disk_share", do)
    if wanted > allowed:
        do = "a larger disk, or a shorter keep"
        return doubt("storage", f"{text}: the oldest data will be deleted after about {days:.0f} days", do)
    return well("storage", text)


def _gb(amount: float) -> str:
    return f"{amount / 1e9:.3g} GB"
