"""Settings of the ``dbc`` decoder."""

from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.validation.number_ranges import DELAY_S, SCALE, SOURCE_ADDRESS, TICK_S, format_value
from drivers.validation.settings_model import Conflict, FileOrName, SettingsModel, one_of

TEMPERATURE: Final = "temperature"
COLUMNS: Final = (*AXES, TEMPERATURE)


class SignalSettings(SettingsModel):
    """CAN signal of one axis: name, unit and additional factor."""

    signal: str = Field(examples=["RateOfTurn.RateX"], description='"Message.Signal"')
    unit: str = Field("", examples=["rad/s"], description="unit of the signal; absent: as stated in the DBC file")
    factor: Annotated[float, SCALE] = Field(
        1.0, description="factor that is applied last: a sign, a correction, or the size of a raw count"
    )


def _signal(value: Any) -> Any:
    """Convert the short form "Message.Signal" or "-Message.Signal" to a table of settings."""
    if isinstance(value, str):
        return {"signal": value.removeprefix("-"), "factor": -1.0 if value.startswith("-") else 1.0}
    if not isinstance(value, dict | SignalSettings):
        raise ConfigError(f"expected text in quotes or a table, got {format_value(value)}")
    return value


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]`` for a sensor that is described by a DBC file."""

    file: FileOrName = Field(
        examples=["xsens_mti"],
        description="path of a DBC file, or j1939_imu, j1939_imu_xyz, bosch_mm7, canmod_gps, dis_qg65d, oxts_rt, "
        "sick_tmm61, xsens_mti",
    )
    signals: dict[Annotated[str, one_of(COLUMNS)], Annotated[SignalSettings, BeforeValidator(_signal)]] = Field(
        examples=[{"gx": "RateOfTurn.RateX", "gy": "-RateOfTurn.RateY", "gz": {"signal": "RateOfTurn.RateZ"}}],
        description='signal of each axis and of temperature: "Message.Signal", "-Message.Signal", or a table',
    )
    valid: str = Field("", examples=["Message.Signal"], description="signal that is 1 if the sample is valid")
    counter: str = Field(
        "",
        examples=["SampleTime.SampleTimeFine"],
        description='sample counter, "Message.Signal"; with join = "counter": signal in all messages of a sample',
    )
    tick: Annotated[float, TICK_S] | None = Field(
        None, examples=[1e-4], description="duration of one count in s; absent: the counter counts samples"
    )
    join: Literal["time", "counter"] = Field(
        "time",
        description="frames that form a sample: frames that arrive together, or frames with equal counts",
    )
    window: Annotated[float, DELAY_S] = Field(
        0.0, description="time in s within which the frames of one sample arrive, at most half a sample period; 0 = any"
    )
    partial: bool = Field(
        False, description="true: keep samples with missing frames; the axes of these frames are not measured"
    )
    j1939: bool | None = Field(
        None,
        examples=[True],
        description="true: identify messages by their parameter group; absent: as stated in the DBC file",
    )
    source: Annotated[int, SOURCE_ADDRESS] | None = Field(
        None, examples=[128], description="J1939 source address; absent: the sender of the first message"
    )
    not_available: bool | None = Field(
        None,
        examples=[True],
        description="true: values in the top 2/256 of their range count as not measured; absent: true for J1939 only",
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if no axis is configured, or if ``join = "counter"`` is set without ``counter``."""
        if not self.signals:
            yield Conflict("signals", 'empty; it maps axes to signals: gz = "Message.Signal"')
        elif set(self.signals) == {TEMPERATURE}:
            yield Conflict("signals", f"no axis but temperature; axes are {', '.join(AXES)}")
        if self.join == "counter" and not self.counter:
            yield Conflict("counter", 'missing; join = "counter" needs counter = "Message.Signal"', ("join",))
