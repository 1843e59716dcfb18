"""Tests of the signal that wakes a waiting thread."""

import threading
import time

from drivers.host.wake_signal import WakeSignal
from tests.support.waiting import PATIENCE_S


def test_signal_set_before_the_wait_is_not_lost_and_wakes_once() -> None:
    signal = WakeSignal()
    signal.set()
    signal.set()
    assert signal.wait_and_clear(0.0)
    assert not signal.wait_and_clear(0.0)


def test_waiting_thread_is_woken_by_another_thread() -> None:
    signal, begun_s = WakeSignal(), time.monotonic()
    thread = threading.Timer(0.01, signal.set)
    thread.start()
    assert signal.wait_and_clear(PATIENCE_S)
    assert time.monotonic() - begun_s < PATIENCE_S
    thread.join()


def test_signal_set_by_many_threads_at_once_is_set() -> None:
    signal = WakeSignal()
    threads = [threading.Thread(target=lambda: [signal.set() for _ in range(1000)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert signal.wait_and_clear(0.0)
    assert not signal.wait_and_clear(0.0)
