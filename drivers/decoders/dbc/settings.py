"""Keys of the ``dbc`` decoder."""

from typing import Annotated, Literal

import msgspec

from drivers.decoders.base import DecoderSettings
from drivers.discovery import FileOrName
from drivers.quantities import DELAY_S, SCALE, SOURCE_ADDRESS, TICK_S


class SignalSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal in full, where a name alone does not say all."""

    signal: str
    unit: str = ""
    """Absent: the DBC's own."""
    factor: Annotated[float, SCALE.meta] = 1.0
    """Applied last: a sign, or a correction."""


class Settings(DecoderSettings, frozen=True, kw_only=True):
    """Keys of a CAN database."""

    file: FileOrName
    """A path, or the name of a shipped one: "j1939_imu", "canmod_gps", "xsens_mti", "bosch_mm7"."""
    signals: dict[str, str | SignalSettings]
    """Axis (gx … az, temperature) = "Message.Signal", "-Message.Signal", or a table."""
    valid: str = ""
    """A signal that is 1 where the sample holds."""
    counter: str = ""
    """"Message.Signal", or with join = "counter" a bare name that every message of a sample has."""
    tick: Annotated[float, TICK_S.meta] | None = None
    """Seconds a count; absent: the counter counts samples."""
    join: Literal["time", "counter"] = "time"
    window: Annotated[float, DELAY_S.meta] = 0.0
    """Seconds within which the frames of one sample come, at most half a sample period; 0 = any."""
    partial: bool = False
    j1939: bool | None = None
    source: Annotated[int, SOURCE_ADDRESS.meta] | None = None
    """J1939 source address, 0 to 255."""
    not_available: bool | None = None
    """Absent: as the message is J1939 or not."""
