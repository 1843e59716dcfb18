"""Real sentences of a VN-100 through a pseudo-terminal, the serial link, the decoder and the whole service."""

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
from tests.system.rig import Cable, paced, running

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
    """Let bytes arrive when their last whole sentence is due at the sensor's rate, whenever the machine read them.

    The sentences carry no counter, so samples count as lost where a loaded machine stops for a while.
    """
    begun_ns, sentences = time.monotonic_ns(), 0
    read = link.wait_for_chunks_or_timeout

    def stamped(timeout_s: float) -> list[Chunk] | None:
        nonlocal sentences
        found = []
        for chunk in read(timeout_s) or ():
            sentences += chunk.data.count(b"\n")
            found.append(replace(chunk, t_ns=begun_ns + round(sentences / RATE_HZ * 1e9)))
        return found or None

    link.wait_for_chunks_or_timeout = stamped  # type: ignore[method-assign]


@pytest.mark.data
def test_every_sentence_of_a_real_sensor_is_accounted_for(tmp_path: Path) -> None:
    folder = recordings() / "vn100-serial"
    with gzip.open(folder / "vnymr-sentences.txt.gz", "rb") as file:
        lines = [line.rstrip(b"\r\n") + b"\r\n" for line in file]
    parsed = np.array([line.split(b"*")[0].split(b",")[7:13] for line in lines], float)
    parsed = parsed[:, [3, 4, 5, 0, 1, 2]]  # the sentence has acceleration before rate
    cable = Cable(tmp_path)
    with running(tmp_path, CONFIG.format(rate=RATE_HZ, port=cable.port)) as run:
        station = run.station("vn100")
        wait_for(lambda: station.driver.link._port is not None, "the port")
        stamp_by_sentence(station.driver.link)
        turns = station.driver.iterations
        wait_for(lambda: station.driver.iterations >= turns + 2, "a read that is stamped")
        paced(cable.write, lines, RATE_HZ * SPEED)
        counts = station.driver.counts
        wait_for(lambda: counts.received + counts.bad + counts.lost >= len(lines), "the last sentence")
    assert (counts.received, counts.bad, counts.lost) == (len(lines), 0, 0)
    np.testing.assert_array_equal(run.caught.values("vn100"), parsed)
    curve = run.caught.estimates["vn100"].curve
    assert curve.n == len(lines)
    avar, terms = overlapping_avar(parsed, curve.factors)
    np.testing.assert_array_equal(curve.terms, terms)
    np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(avar), rtol=1e-9)
    with np.load(folder / "static-12min.npz") as npz:
        rounded = np.column_stack([npz[axis] for axis in ("gx", "gy", "gz", "ax", "ay", "az")])
    np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(overlapping_avar(rounded, curve.factors)[0]), rtol=1e-5)
