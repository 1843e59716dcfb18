"""Time until a viewer that joins late shows everything: ``python -m tests.experiments.benchmarks.late_viewer``.

The demo runs with the web viewer. After some time, the benchmark reads the messages of the Rerun server as a viewer
reads them. For each group of entities, the table shows when every entity of the group has arrived for the first time.
With the option ``--pictures``, a second viewer without a screen then connects to the server and saves screenshots.

    python -m tests.experiments.benchmarks.late_viewer [--seconds 150] [--pictures FOLDER]
"""

import argparse
import http.client
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pyarrow as pa

from monitor.publishing.rerun import sinks
from monitor.simulator.demo_config import build_demo_config
from tests.experiments.pictures import SIZE, free_port, running, wait_until

READ_S = 10.0
"""Duration of the reading [s]."""
SCREENSHOTS_S = 30.0
"""Time after which no further screenshot is taken [s]."""
GROUPS = {
    "state and table of coefficients": ("status", "coefficients"),
    "curves of the Allan plots": ("allan/??", "allan/*/curves"),
    "axes, labels and key of the Allan plots": ("allan/*/*",),
    "heat maps": ("dynamic/??",),
    "events": ("events",),
    "samples and temperature": ("samples/*", "temperature"),
}
"""Entities of each row of the table, as patterns of their paths below the device."""


def main() -> None:
    """Run the demo, join late and print when the entities arrive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=150.0, help="time between the first result and the late join")
    parser.add_argument("--pictures", type=Path, help="folder for screenshots of a second viewer")
    arguments = parser.parse_args()
    config, port, web_port = build_demo_config(), free_port(), free_port()
    config = replace(
        config,
        viewer=config.viewer.model_copy(update={"mode": "web", "port": port, "web_port": web_port}),
        zenoh=config.zenoh.model_copy(update={"mode": "none"}),
    )
    with mock.patch.object(sinks, "has_desktop", return_value=False), running(config) as service:
        wait_until(lambda: service.workers[0].publisher.latest is not None, 120.0)
        time.sleep(arguments.seconds)
        print_arrivals(config.devices[0].name, port)
        if arguments.pictures is not None:
            save_screenshots(port, arguments.pictures)


def print_arrivals(device: str, port: int) -> None:
    """Join the Rerun server, and print when each group of entities has arrived."""
    arrivals: dict[str, tuple[float, int]] = {}  # time [s] and number of the message, by path
    begun_s, size = time.monotonic(), 0
    for number, message in enumerate(read_messages(port), 1):
        since_s, size = time.monotonic() - begun_s, size + len(message)
        arrivals.setdefault(entity_path(message), (since_s, number))
        if since_s > READ_S:
            print(f"{number} messages with {size / 1e6:.1f} MB in {since_s:.0f} s")
            break
    print("| entities | number | all arrived after | last message |")
    print("| --- | --- | --- | --- |")
    for group, patterns in GROUPS.items():
        found = [
            arrival
            for path, arrival in arrivals.items()
            if any(Path(path).match(f"/{device}/{pattern}") for pattern in patterns)
        ]
        if found:
            print(f"| {group} | {len(found)} | {max(found)[0]:.2f} s | {max(found)[1]} |")


def read_messages(port: int) -> Iterator[bytes]:
    """Yield the messages that a Rerun server sends to a new viewer (gRPC-Web)."""
    service = sinks.PROBE_METHOD.rpartition("/")[0]
    headers = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1"}
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)) as connection:
        connection.request("POST", f"{service}/ReadMessages", bytes(5), headers)
        with connection.getresponse() as reply:
            while head := reply.read(5):
                yield reply.read(int.from_bytes(head[1:], "big"))


def entity_path(message: bytes) -> str:
    """Return the path of the entity in a message of a recording, or an empty text for other messages.

    The fields of the protocol buffers are LogMsg.arrow_msg = 2, and for ArrowMsg store_id = 1, compression = 2,
    uncompressed_size = 3 and payload = 5.
    """
    log_message = protobuf_fields(message).get(1, b"")
    arrow = protobuf_fields(log_message).get(2) if isinstance(log_message, bytes) else None
    if not isinstance(arrow, bytes):
        return ""
    fields = protobuf_fields(arrow)
    payload = fields[5]
    if fields.get(2) == 2:  # LZ4
        payload = pa.decompress(payload, fields[3], "lz4_raw")
    metadata = pa.ipc.open_stream(payload).schema.metadata or {}
    return str(metadata.get(b"rerun:entity_path", b"").decode())


def protobuf_fields(data: bytes) -> dict[int, int | bytes]:
    """Return the last value of each field of a protocol buffer."""
    fields: dict[int, int | bytes] = {}
    at = 0

    def read_varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            value |= (data[at] & 0x7F) << shift
            shift, at = shift + 7, at + 1
            if not data[at - 1] & 0x80:
                return value

    while at < len(data):
        key = read_varint()
        number, kind = key >> 3, key & 7
        if kind == 0:
            fields[number] = read_varint()
            continue
        size = {1: 8, 2: 0, 5: 4}[kind] or read_varint()
        fields[number], at = data[at : at + size], at + size
    return fields


def save_screenshots(port: int, folder: Path) -> None:
    """Connect a viewer without a screen, and save screenshots named after the time since its start."""
    from rerun.experimental import ViewerClient

    folder.mkdir(parents=True, exist_ok=True)
    own_port, begun_s = free_port(), time.monotonic()
    child = sinks.ViewerProcess([
        *("--bind", "127.0.0.1", "--port", str(own_port), "--headless", "--window-size", f"{SIZE[0]}x{SIZE[1]}"),
        *("--hide-welcome-screen", sinks.server_url(port)),
    ])  # fmt: skip
    try:
        wait_until(lambda: sinks.is_listening(own_port), 30.0)
        client = ViewerClient(sinks.server_url(own_port))
        while time.monotonic() - begun_s < SCREENSHOTS_S:
            client.save_screenshot(str(folder / "newest.png"))
            (folder / "newest.png").rename(folder / f"{time.monotonic() - begun_s:04.1f}s.png")
    finally:
        child.terminate()


if __name__ == "__main__":
    main()
