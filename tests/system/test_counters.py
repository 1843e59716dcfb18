"""Test of simulated sensors with counters through a pseudo-terminal, the decoder and the service.

The line loses and damages frames. Every sample is received, rejected or counted as lost, and the Allan deviations equal
those of a batch computation.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import CounterTimedFormat, concatenate_blocks
from monitor.daemon.service import Service
from tests.contracts.decoder_examples import EXAMPLES, Example
from tests.support.paced_sensor import follow_reader
from tests.support.waiting import wait_for
from tests.system.rig import check_deviations_equal_batch, run_service

SAMPLES = 1000
RATE_HZ = 100.0
CONFIG = """
[[device]]
name = "imu"
rate = {rate}
window = 600.0
restart = false
[device.driver]
link = "virtual"
speed = {speed}
silence = 0.0
decoder = "{decoder}"
decoder_options = {{ {options} }}
faults = {{ lost = 0.02, flipped = 0.02 }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""


def has_counter_and_checksum(example: Example) -> bool:
    timing = example.carrier == "bytes" and example.checksum and example.build(Path()).timing
    return isinstance(timing, CounterTimedFormat)


def follow_readers(service: Service) -> None:
    for worker in service.workers:
        assert worker.simulated is not None
        follow_reader(worker.simulated, worker.driver)


@pytest.mark.parametrize("example", [one for one in EXAMPLES if has_counter_and_checksum(one)], ids=str)
def test_every_sample_is_received_rejected_or_lost(example: Example, tmp_path: Path) -> None:
    options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in example.settings.items())
    timing = example.build(Path()).timing
    assert isinstance(timing, CounterTimedFormat)
    ticks_per_sample = 1.0 if timing.tick_s is None else 1.0 / (RATE_HZ * timing.tick_s)
    # On a busy machine, the sensor pauses. A pause of one turn of the counter cannot be told from lost samples.
    turn_s = timing.modulus / ticks_per_sample / RATE_HZ
    text = CONFIG.format(rate=RATE_HZ, speed=min(10.0 * turn_s, 10.0), decoder=example.name, options=options)
    with run_service(tmp_path, text, prepare=follow_readers) as run:
        worker = run.worker("imu")
        counts = worker.driver.counts
        wait_for(lambda: counts.received >= SAMPLES, lambda: (worker.driver.text, counts))
    blocks = run.output.blocks["imu"]
    steps = np.rint(np.diff(concatenate_blocks(blocks).ticks) % timing.modulus / ticks_per_sample).astype(np.int64)
    assert counts.received == sum(map(len, blocks)) == steps.size + 1
    assert counts.received + counts.bad + counts.lost == steps.sum() + 1
    assert min(counts.bad, counts.lost) > 0
    check_deviations_equal_batch(run.output, "imu", np.concatenate([[0], np.cumsum(steps)]))
