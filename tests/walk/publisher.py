"""A process that publishes a recording over zenoh: python -m tests.walk.publisher FILE.npz KEY ENDPOINT RATE."""

import sys
import time
from pathlib import Path

import zenoh

from drivers.recording import iter_blocks, load_samples
from drivers.sample_message import pack


def main() -> None:
    path, key, endpoint, rows_per_second = Path(sys.argv[1]), sys.argv[2], sys.argv[3], float(sys.argv[4])
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as session:
        publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        while not publisher.matching_status.matching:
            time.sleep(0.05)
        begun, sent = time.monotonic(), 0
        for samples in iter_blocks(load_samples(path), 1000):
            sent += len(samples)
            publisher.put(pack("run1", sent, samples))
            early = begun + sent / rows_per_second - time.monotonic()
            if early > 0.0:
                time.sleep(early)
        time.sleep(0.5)


if __name__ == "__main__":
    main()
