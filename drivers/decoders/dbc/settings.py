"""Settings of the ``dbc`` decoder."""

from typing import Annotated, Literal

import msgspec

from drivers.decoders.base import DecoderSettings
from drivers.discovery import FileOrName
from drivers.quantities import DELAY_S, SCALE, SOURCE_ADDRESS, TICK_S


class SignalSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Description of one signal, if a name alone is not sufficient."""

    signal: str
    unit: str = ""
    """Unit of the signal. If it is absent, the unit of the DBC is used."""
    factor: Annotated[float, SCALE.meta] = 1.0
    """Factor that is applied last: a sign, or a correction."""


class Settings(DecoderSettings, frozen=True, kw_only=True):
    """Keys of ``[device.driver.decoder_options]`` for a CAN database."""

    file: FileOrName
    """Path of a DBC file, or name of a shipped database: "j1939_imu", "canmod_gps", "xsens_mti", "bosch_mm7"."""
    signals: dict[str, str | SignalSettings]
    """Signal of each axis (gx … az, temperature): "Message.Signal", "-Message.Signal", or a table."""
    valid: str = ""
    """Signal that is 1 if the sample is valid."""
    counter: str = ""
    """"Message.Signal", or with join = "counter" the name of a signal that every message of a sample contains."""
    tick: Annotated[float, TICK_S.meta] | None = None
    """Length of a count in s. If it is absent, the counter counts samples."""
    join: Literal["time", "counter"] = "time"
    window: Annotated[float, DELAY_S.meta] = 0.0
    """Time in s within which the frames of one sample arrive, at most half a sample period; 0 = any."""
    partial: bool = False
    j1939: bool | None = None
    source: Annotated[int, SOURCE_ADDRESS.meta] | None = None
    """J1939 source address, 0 to 255."""
    not_available: bool | None = None
    """True if the J1939 rule for unavailable values is used. If it is absent, the rule is used for J1939 messages."""
