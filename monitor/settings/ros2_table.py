"""Settings of the output to ROS 2, and conversion of device names to ROS names."""

import re
from typing import Annotated, Final, Literal

from pydantic import Field

from drivers.errors import ConfigError
from drivers.validation import number_ranges
from drivers.validation.settings_model import ConvertedFrom, ListOf, SettingsModel, checked_by
from monitor.settings.field_types import Endpoint

ROUTER: Final = "tcp/127.0.0.1:7447"
"""Default address of the router of rmw_zenoh."""
ROS_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""Valid name between two slashes of a topic (design.ros2.org, "Topic and Service name mapping to DDS")."""
FRAME_ID: Final = re.compile(r"(?!/)[!-~]{1,255}")
"""Valid name of a coordinate frame: printable ASCII characters without spaces and without a leading slash."""


def ros_name(device: str) -> str:
    """Return a device name with each ``-`` replaced by ``_``, because ROS does not allow ``-``.

    >>> ros_name("bench-1")
    'bench_1'
    """
    return device.replace("-", "_")


def _namespace(name: str, _: object) -> str:
    """Return a namespace that begins with a slash and does not end with a slash, or "/"."""
    parts = name.strip("/").split("/")
    if parts != [""] and not all(map(ROS_NAME.fullmatch, parts)):
        raise ConfigError(f'"{name}" is not a namespace of ROS; write one such as "/robot1", or "/"')
    return f"/{'/'.join(parts)}"


def _check_frame_id(name: str) -> None:
    if not FRAME_ID.fullmatch(name):
        raise ConfigError(f'"{name}" is not a frame of ROS; write one without spaces and leading slash, as "imu_link"')


FrameId = Annotated[str, checked_by(_check_frame_id)]


class Ros2Table(SettingsModel):
    """Table ``[ros2]``: settings of the output to ROS 2."""

    domain: Annotated[int, number_ranges.ROS_DOMAIN] | None = Field(
        None, examples=[0], description="ROS_DOMAIN_ID of the subscribers; absent: nothing is published"
    )
    connect: ListOf[Endpoint] = Field((ROUTER,), description="endpoint of the rmw_zenoh router")
    namespace: Annotated[str, ConvertedFrom(str, _namespace)] = Field(
        "/", description="namespace of the ROS 2 node and of its imu topics"
    )
    imu: Literal["raw", "compensated", "none"] = Field(
        "raw",
        description="samples: raw = as received, on <namespace>/<device>/imu/data_raw; compensated = without gyroscope "
        "drift, on imu/data_compensated; or none",
    )
