"""Test of MAVLink and text lines over UDP through the link, the decoder and the service, with lost and damaged data."""

import socket
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from tests.support.waiting import wait_for
from tests.system.rig import check_deviations_equal_batch, run_service, send_at_rate

CONFIG = """
[[device]]
name = "autopilot"
rate = {rate}
window = 600.0
restart = false
driver = {{ link = "udp", port = 0, {decoder} }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
RATE_HZ = 200.0
SAMPLES = 800
MAVLINK = 'decoder = "mavlink"'
TEXT = (
    'decoder = "text", decoder_options = { columns = ["counter", "gx", "gy", "gz", "ax", "ay", "az"], nmea = true, '
    "counter_modulus = 65536 }"
)
LABELS = (
    'decoder = "text", decoder_options = { columns = ["counter", "gx", "gy", "gz", "ax", "ay", "az"], '
    'first_line = "keep" }'
)
PATTERN = (
    'decoder = "text", decoder_options = { pattern = "no (?P<counter>[0-9]+): '
    r"g = (?P<gx>\\S+) (?P<gy>\\S+) (?P<gz>\\S+), a = (?P<ax>\\S+) (?P<ay>\\S+) (?P<az>\\S+)$"
    '", first_line = "keep" }'
)


def make_values() -> np.ndarray:
    return np.random.default_rng(4).normal(0.0, 0.1, (SAMPLES, 6)).astype(np.float32).astype(np.float64)


def build_mavlink(values: np.ndarray) -> list[bytes]:
    """Return one datagram per sample. Some of them also contain a message without IMU data."""
    sender = common.MAVLink(None, 1, 1)
    datagrams = []
    for i, (gx, gy, gz, ax, ay, az) in enumerate(values):
        messages = [common.MAVLink_highres_imu_message(i * 5000, ax, ay, az, gx, gy, gz, *[0.0] * 6, 20.0, 63)]
        if i % 7 == 0:
            messages.insert(0, common.MAVLink_heartbeat_message(2, 12, 81, 3, 4, 3))
        data = b""
        for message in messages:
            data += message.pack(sender)
            sender.seq = (sender.seq + 1) % 256
        datagrams.append(data)
    return datagrams


def build_text(values: np.ndarray) -> list[bytes]:
    lines = []
    for i, row in enumerate(values):
        body = ",".join([str(i), *map(repr, row.tolist())]).encode()
        lines.append(b"$%b*%02X\r\n" % (body, np.bitwise_xor.reduce(np.frombuffer(body, np.uint8))))
    return lines


def build_labels(values: np.ndarray) -> list[bytes]:
    names = ("counter", "gx", "gy", "gz", "ax", "ay", "az")
    rows = [(i, *row.tolist()) for i, row in enumerate(values)]
    return [("\t".join(f"{n}:{x!r}" for n, x in zip(names, row, strict=True)) + "\r\n").encode() for row in rows]


def build_pattern(values: np.ndarray) -> list[bytes]:
    rows = [row.tolist() for row in values]
    text = "no {}: g = {!r} {!r} {!r}, a = {!r} {!r} {!r}\n"
    return [text.format(i, *row).encode() for i, row in enumerate(rows)]


@pytest.mark.parametrize(
    ("decoder", "build"),
    [(MAVLINK, build_mavlink), (TEXT, build_text), (LABELS, build_labels), (PATTERN, build_pattern)],
    ids=["mavlink", "text", "labels", "pattern"],
)
def test_every_sample_is_received_lost_or_bad(tmp_path: Path, decoder: str, build) -> None:
    values = make_values()
    datagrams = build(values)
    rng = np.random.default_rng(5)
    missing, damaged = np.split(rng.choice(np.arange(100, SAMPLES - 100), 60, replace=False), 2)
    for i in missing:
        datagrams[i] = b""
    for i in damaged:
        datagrams[i] = datagrams[i][:-20] + b"?" + datagrams[i][-19:]
    with run_service(tmp_path, CONFIG.format(rate=RATE_HZ, decoder=decoder)) as run:
        driver = run.worker("autopilot").driver
        wait_for(lambda: driver.link._socket is not None, "the port")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(driver.link._socket.getsockname())
            send_at_rate(lambda data: data and sender.send(data), datagrams, RATE_HZ, burst=1)
        counts = driver.counts
        wait_for(lambda: counts.received + counts.bad + counts.lost >= SAMPLES, lambda: counts)
    assert (counts.received, counts.bad, counts.lost) == (SAMPLES - 60, 30, 30)
    kept = np.delete(np.arange(SAMPLES), np.concatenate([missing, damaged]))
    np.testing.assert_allclose(run.output.values("autopilot"), values[kept], rtol=1e-7)
    check_deviations_equal_batch(run.output, "autopilot", kept)
