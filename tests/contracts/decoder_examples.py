"""Examples of settings for the tests of all decoders, with the resolution of each format.

A decoder that is not listed is tested with its default settings and a coarse resolution.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers import decoders
from drivers.decoders.base import Decoder
from drivers.validation import module_lookup
from tests.support.settings import read_settings

DEGREE = math.pi / 180.0
G = 9.80665

CAN_DATABASE = """VERSION ""
BS_:
BU_: IMU
BO_ 80 Temperature: 2 IMU
 SG_ temp : 7|16@0- (0.00390625,0) [-128|127] "degC" IMU
BO_ 50 RateOfTurn: 6 IMU
 SG_ gyrX : 7|16@0- (0.001953125,0) [-64|64] "rad/s" IMU
 SG_ gyrY : 23|16@0- (0.001953125,0) [-64|64] "rad/s" IMU
 SG_ gyrZ : 39|16@0- (0.001953125,0) [-64|64] "rad/s" IMU
BO_ 52 Acceleration: 6 IMU
 SG_ accX : 7|16@0- (0.00390625,0) [-128|127] "m/s^2" IMU
 SG_ accY : 23|16@0- (0.00390625,0) [-128|127] "m/s^2" IMU
 SG_ accZ : 39|16@0- (0.00390625,0) [-128|127] "m/s^2" IMU
"""
CAN_SIGNALS = {
    **{f"g{axis}": f"RateOfTurn.gyr{axis.upper()}" for axis in "xyz"},
    **{f"a{axis}": f"Acceleration.acc{axis.upper()}" for axis in "xyz"},
    "temperature": "Temperature.temp",
}


@dataclass(frozen=True)
class Example:
    """Settings of a decoder and the properties of its format."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    gyro_step: float | None = 1e-3  # rad/s; value of the last bit or digit; None if the format has no angular rates
    accel_step: float = 1e-2  # m/s²
    temperature_step: float | None = 0.5  # °C; None if the format has no temperature
    checksum: bool = False  # True if every damaged byte is detected
    unchecked_tail: int = 0  # number of bytes at the end of a frame that its checksum does not cover

    def __str__(self) -> str:
        keys = [str(v) for k, v in self.settings.items() if k not in ("columns", "file", "signals")]
        return "-".join([self.name, *keys])

    @property
    def carrier(self) -> str:
        """Kind of the decoder's input: bytes, frames or messages."""
        module = module_lookup.import_module(decoders, self.name)
        carriers = [getattr(attribute, "carrier", None) for attribute in vars(module).values()]
        return str(next(carrier for carrier in carriers if isinstance(carrier, str)))

    def build(self, folder: Path) -> Decoder:
        """Return the decoder. Write the file that its settings name to ``folder``."""
        settings = dict(self.settings)
        if self.name == "dbc":
            (folder / "imu.dbc").write_text(CAN_DATABASE)
            settings["file"] = str(folder / "imu.dbc")
        module = module_lookup.import_module(decoders, self.name)
        decoder: Decoder = module.build(read_settings(module.Settings, settings))
        return decoder


FLOAT32_STEP = 2.0**-22  # step of a float32 for numbers from 2 to 4
COLUMNS = ("gx", "gy", "gz", "ax", "ay", "az", "temperature")
TEXT = Example("text", {"columns": COLUMNS}, 1e-14, 1e-13, 1e-13)
OTHER_UNITS = {"gyro_unit": "deg/s", "accel_unit": "mg", "temperature_unit": "K", "delimiter": ";"}
EPSON = Example("epson_uart", {"model": "g366pdg0"}, DEGREE / 66, 0.25e-3 * G, 2.0**-8, checksum=True)
RAW_UNITS = {"gyro_unit": "deg/s/131", "accel_unit": "g/16384"}
STIM300 = Example("stim300", {}, DEGREE / 2**14, G / 2**19, 2.0**-8, checksum=True)
VECTORNAV = Example("vectornav_binary", {}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True)
XSENS = Example("xsens_mtdata2", {}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True)
WITMOTION = Example("witmotion", {}, 2000 * DEGREE / 2**15, 16 * G / 2**15, 0.01, checksum=True)

LISTED_EXAMPLES = (
    Example("aceinna_dmu", {}, 1260 * DEGREE / 2**16, 20 * G / 2**16, 200 / 2**16, checksum=True),
    Example("aceinna_dmu", {"packet": "S0"}, 1260 * DEGREE / 2**16, 20 * G / 2**16, 200 / 2**16, checksum=True),
    Example("aceinna_dmu", {"packet": "z1"}, DEGREE * 2.0**-17, 8 * FLOAT32_STEP, None, checksum=True),
    Example("aceinna_dmu", {"packet": "s1", "accel_unit": "g"}, DEGREE * 2.0**-17, G * FLOAT32_STEP, 1e-5, True),
    Example("bno055", {}, DEGREE / 16, 0.01, 1.0),
    Example("bno08x_rvc", {}, None, 1e-3 * G, None, checksum=True),
    TEXT,
    Example("text", {"columns": ("counter", *COLUMNS), "nmea": True}, 1e-14, 1e-13, 1e-13, True, 2),
    Example("text", {"columns": ("t", "-", *COLUMNS), "time_unit": "ms"}, 1e-14, 1e-13, 1e-13),
    Example("text", {"columns": COLUMNS, **OTHER_UNITS}, 1e-13, 1e-13, 1e-12),
    Example("text", {"columns": COLUMNS, "preset": "mpu6050_raw"}, 1e-13, 1e-12, 1e-12),
    Example("vectornav_ascii", {}, 1e-6, 1e-3, 0.1, checksum=True),
    Example("vectornav_ascii", {"sentence": "VNYMR"}, 1e-6, 1e-3, None, checksum=True),
    VECTORNAV,
    Example("vectornav_binary", {"clock": "arrival"}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True),
    XSENS,
    Example(
        "xsens_mtdata2", {"clock": "packet_counter"}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True
    ),
    Example("xsens_mtdata2", {"format": "fp12.20", "high_rate": True}, 2.0**-20, 2.0**-20, 32 * FLOAT32_STEP, True),
    Example("xsens_mtdata2", {"format": "fp16.32"}, 2.0**-32, 2.0**-32, 32 * FLOAT32_STEP, True),
    Example("xsens_mtdata2", {"format": "float64"}, 1e-15, 1e-14, 32 * FLOAT32_STEP, True),
    STIM300,
    Example("stim300", {"identifier": 0xAF, "crlf": True}, DEGREE / 2**14, G / 2**19, 2.0**-8, True, 2),
    Example(
        "stim300",
        {"gyro_output": "increment", "accelerometer_output": "increment", "rate": 500.0},
        500.0 * DEGREE / 2**21,
        500.0 / 2**22,
        2.0**-8,
        True,
    ),
    WITMOTION,
    Example("witmotion", {"temperature": "jy61"}, 2000 * DEGREE / 2**15, 16 * G / 2**15, 1 / 340, True),
    EPSON,
    Example(
        "epson_uart", {"model": "g364pdca", "bits": 32}, DEGREE * 0.00375 / 2**16, 0.125e-3 * G / 2**16, 1e-7, True
    ),
    Example("microstrain_mip", {}, FLOAT32_STEP, G * FLOAT32_STEP, None, checksum=True),
    Example("microstrain_mip", {"increments": True}, 2 * FLOAT32_STEP, G * FLOAT32_STEP, None, checksum=True),
    Example("sbg_ecom", {}, 2.0**-26, 2.0**-20, 2.0**-8, checksum=True),
    Example("sbg_ecom", {"message": "imu_data"}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True),
    Example("silicon_sensing_dmu", {}, FLOAT32_STEP, G * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True),
    Example("silicon_sensing_dmu", {"length": 40}, FLOAT32_STEP, G * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True),
    Example("ublox_esf", {}, DEGREE / 2**12, 2.0**-10, 0.01, checksum=True),
    Example("ublox_esf", {"message": "esf-meas"}, DEGREE / 2**12, 2.0**-10, 0.01, checksum=True),
    Example("inertial_sense", {}, 2 * FLOAT32_STEP, 8 * FLOAT32_STEP, None, checksum=True),
    Example("inertial_sense", {"data_set": "imu"}, FLOAT32_STEP, 8 * FLOAT32_STEP, None, checksum=True),
    Example("inertial_labs", {}, 1e-5 * DEGREE, 1e-6 * G, 0.1, checksum=True),
    Example("inertial_labs", {"message": "calibrated-hr"}, 1e-5 * DEGREE, 1e-6 * G, 0.1, checksum=True),
    Example("novatel_rawimusx", {}, 125 * DEGREE / 2**21, 125 / 2**22, None, checksum=True),
    Example("dbc", {"signals": CAN_SIGNALS}, 2.0**-9, 2.0**-8, 2.0**-8),
    Example("mavlink", {}, FLOAT32_STEP, 8 * FLOAT32_STEP, 32 * FLOAT32_STEP, checksum=True),
    Example("mavlink", {"message": "SCALED_IMU2", "clock": "arrival"}, 1e-3, 1e-3 * G, 0.01, checksum=True),
    Example("mavlink", {"message": "RAW_IMU", **RAW_UNITS}, DEGREE / 131, G / 16384, 0.01, checksum=True),
    Example("ros2_imu", {}, 1e-15, 1e-14, None),
    Example("samples", {}, 1e-15, 1e-14, 1e-14),
)

DECODER_NAMES = module_lookup.list_modules(decoders)
EXAMPLES = tuple(e for e in LISTED_EXAMPLES if e.name in DECODER_NAMES) + tuple(
    Example(name) for name in DECODER_NAMES if name not in {e.name for e in LISTED_EXAMPLES}
)
"""At least one example for every decoder in the folder."""
