"""Publish a recording over zenoh: python -m tests.system.publisher FILE.npz KEY ENDPOINT ROWS.

The program publishes ROWS rows for each line on its standard input, so that a reader on a loaded machine can keep up.
It ends when its standard input is closed.
"""

import sys
from pathlib import Path

import zenoh

from drivers.recordings import iter_blocks, load_samples
from drivers.zenoh.sample_message import encode_samples
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_session

BLOCK_ROWS = 1000


def main() -> None:
    path, key, endpoint, rows = Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
    with open_session(connect=[endpoint]) as opened:
        publisher = opened.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_for(lambda: publisher.matching_status.matching, "a subscriber")
        sent = allowed = 0
        for samples in iter_blocks(load_samples(path), BLOCK_ROWS):
            while sent + len(samples) > allowed:
                if not sys.stdin.readline():
                    return
                allowed += rows
            sent += len(samples)
            publisher.put(encode_samples("run1", sent, samples))
        sys.stdin.read()


if __name__ == "__main__":
    main()
