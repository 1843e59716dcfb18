"""Tests of simulated faults: their rates, their independence of block sizes, and their effect on bytes."""

import numpy as np
import pytest

from drivers.data_types import Chunk
from monitor.settings.loading import FaultsTable
from monitor.simulator.faults import FaultCounts, FaultKind, Faults

SHARES = FaultsTable(lost=0.01, repeated=0.02, flipped=0.03, cut=0.04, unplugged=0.05)
DATA = bytes(range(40))


def test_faults_occur_at_the_configured_rates() -> None:
    n = 200_000
    draws = Faults(SHARES, 1, "bytes").draw_faults(n)
    share = np.bincount(draws.kind, minlength=5) / n
    assert share == pytest.approx([0.01, 0.02, 0.03, 0.04, 0.9], abs=4 * np.sqrt(0.04 / n))
    assert draws.pulled.mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 / n))
    pulled_share_of_cut = draws.pulled[draws.kind == FaultKind.CUT].mean()
    assert pulled_share_of_cut == pytest.approx(0.05, abs=4 * np.sqrt(0.05 / (0.04 * n)))


def test_no_faults_occur_by_default() -> None:
    draws = Faults(FaultsTable(), 1, "bytes").draw_faults(10_000)
    assert (draws.kind == FaultKind.WHOLE).all()
    assert not draws.pulled.any()


def test_all_samples_may_be_lost() -> None:
    assert (Faults(FaultsTable(lost=1.0), 1, "bytes").draw_faults(10_000).kind == FaultKind.LOST).all()


@pytest.mark.parametrize("cuts", [(1,), (7, 8, 500), (999,)])
def test_faults_do_not_depend_on_block_sizes(cuts: tuple[int, ...]) -> None:
    whole = Faults(SHARES, 5, "bytes").draw_faults(1000)
    faults = Faults(SHARES, 5, "bytes")
    parts = [faults.draw_faults(n) for n in np.diff((0, *cuts, 1000)).tolist()]
    for name in ("kind", "position", "pulled"):
        assert np.array_equal(getattr(whole, name), np.concatenate([getattr(part, name) for part in parts]))
    assert not np.array_equal(whole.position, Faults(SHARES, 6, "bytes").draw_faults(1000).position)


def test_jitter_does_not_change_other_faults() -> None:
    faults = Faults(FaultsTable(lost=0.5, jitter=0.1), 5, "bytes")
    delays_s = [faults.draw_delay_s() for _ in range(100)]
    assert 0.0 <= min(delays_s) < 0.02 < 0.08 < max(delays_s) <= 0.1
    without_jitter = Faults(FaultsTable(lost=0.5), 5, "bytes")
    assert without_jitter.draw_delay_s() == 0.0
    assert np.array_equal(faults.draw_faults(100).kind, without_jitter.draw_faults(100).kind)


@pytest.mark.parametrize("position", [0.0, 0.37, 1.0 - 2**-53])
def test_faults_change_the_bytes_as_described(position: float) -> None:
    faults = Faults(SHARES, 1, "bytes")
    chunks = [Chunk(b"first", 7), Chunk(DATA, 7, address=3)]
    assert faults.apply_fault(FaultKind.WHOLE, position, chunks) == chunks
    assert faults.apply_fault(FaultKind.LOST, position, chunks) == []
    assert faults.apply_fault(FaultKind.REPEATED, position, chunks) == [*chunks, *chunks]
    first, flipped = faults.apply_fault(FaultKind.FLIPPED, position, chunks)
    assert first == chunks[0]
    assert (flipped.address, flipped.t_ns) == (3, 7)
    difference = int.from_bytes(flipped.data, "big") ^ int.from_bytes(DATA, "big")
    assert difference.bit_count() == 1
    first, cut = faults.apply_fault(FaultKind.CUT, position, chunks)
    assert first == chunks[0]
    assert DATA.startswith(cut.data)
    assert 1 <= len(cut.data) < len(DATA)


def test_flipped_can_frame_does_not_arrive() -> None:
    chunks = [Chunk(b"a" * 8, 1, address=1), Chunk(b"b" * 8, 1, address=2)]
    assert Faults(SHARES, 1, "frames").apply_fault(FaultKind.FLIPPED, 0.5, chunks) == chunks[:1]


def test_fault_counts_add_up() -> None:
    truth = FaultCounts()
    for kind in FaultKind:
        truth.count_sample(kind, all_sent=True)
        truth.count_sample(kind, all_sent=False)
    assert (truth.sent, truth.repeated, truth.lost, truth.flipped, truth.cut) == (2, 1, 1, 1, 1)
    assert truth.dropped == len(FaultKind)
    assert truth.total_simulated_samples == 2 * len(FaultKind)
