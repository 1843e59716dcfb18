"""Test of recorded VN-100 sentences through a pseudo-terminal, the serial link, the decoder and the service."""

import gzip
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import Chunk
from drivers.links.base import Link
from monitor.estimation.allan.batch import overlapping_avar
from tests.support.recordings import recordings
from tests.support.waiting import wait_for
from tests.system.rig import PluggableTerminal, run_service, send_at_rate

CONFIG = """
[[device]]
name = "vn100"
rate = {rate}
window = 800.0
restart = false  # the whole recording is compared, and its vibration changes
driver = {{ link = "serial", port = "{port}", decoder = "vectornav_ascii" }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
RATE_HZ = 40.0
SPEED = 55.0


def stamp_by_sentence(link: Link) -> None:
    """Give each chunk the time at which its last complete sentence is due at the rate of the sensor.

    The sentences have no counter, so a pause of a loaded machine would count as lost samples.
    """
    begun_ns, sentences = time.monotonic_ns(), 0
    read = link.wait_for_chunks_or_timeout

    def read_and_stamp(timeout_s: float) -> list[Chunk] | None:
        nonlocal sentences
        chunks = []
        for chunk in read(timeout_s) or ():
            sentences += chunk.data.count(b"\n")
            chunks.append(replace(chunk, t_ns=begun_ns + round(sentences / RATE_HZ * 1e9)))
        return chunks or None

    link.wait_for_chunks_or_timeout = read_and_stamp  # type: ignore[method-assign]


@pytest.mark.data
def test_every_sentence_of_a_real_sensor_becomes_a_sample(tmp_path: Path) -> None:
    folder = recordings() / "vn100-serial"
    with gzip.open(folder / "vnymr-sentences.txt.gz", "rb") as file:
        lines = [line.rstrip(b"\r\n") + b"\r\n" for line in file]
    parsed = np.array([line.split(b"*")[0].split(b",")[7:13] for line in lines], float)
    parsed = parsed[:, [3, 4, 5, 0, 1, 2]]  # the sentence has acceleration before rate
    terminal = PluggableTerminal(tmp_path)
    with run_service(tmp_path, CONFIG.format(rate=RATE_HZ, port=terminal.port)) as run:
        worker = run.worker("vn100")
        wait_for(lambda: worker.driver.link._port is not None, "the port")
        stamp_by_sentence(worker.driver.link)
        iterations = worker.driver.iterations
        wait_for(lambda: worker.driver.iterations >= iterations + 2, "a read with the new time stamps")
        send_at_rate(terminal.write, lines, RATE_HZ * SPEED)
        counts = worker.driver.counts
        wait_for(lambda: counts.received + counts.bad + counts.lost >= len(lines), "the last sentence")
    assert (counts.received, counts.bad, counts.lost) == (len(lines), 0, 0)
    np.testing.assert_array_equal(run.output.values("vn100"), parsed)
    curve = run.output.estimates["vn100"].curve
    assert curve.n == len(lines)
    avar, terms = overlapping_avar(parsed, curve.factors)
    np.testing.assert_array_equal(curve.terms, terms)
    np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(avar), rtol=1e-9)
    with np.load(folder / "static-12min.npz") as npz:
        rounded = np.column_stack([npz[axis] for axis in ("gx", "gy", "gz", "ax", "ay", "az")])
    np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(overlapping_avar(rounded, curve.factors)[0]), rtol=1e-5)
