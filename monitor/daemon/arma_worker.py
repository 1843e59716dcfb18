"""Identifies models of drift beside the loop: some 50 ms of work that no sample is to wait for."""

import threading

from drivers.errors import NotReady
from drivers.sample import Floats
from monitor.drift.compensation.arma import Arma, identify
from monitor.drift.compensation.compensator import Compensator
from monitor.drift.compensation.live_compensation import LiveCompensation


class Identifier:
    """For one device: one axis after the other, each in a thread of its own that ends with it.

    Args:
        name: of the threads
        at_once: work where it is asked, as a recording waits for it
    """

    def __init__(self, name: str, at_once: bool) -> None:
        self._name = name
        self._at_once = at_once
        self._work: _Work | None = None

    def renew(self, live: LiveCompensation) -> None:
        """Take over what is found, and begin what is due."""
        if self._work is not None:
            if self._work.thread.is_alive():
                return
            if self._work.of is live.compensator:  # it may have begun anew meanwhile
                live.adopt(self._work.axis, self._work.found)
            self._work = None
        for axis in live.compensator.due:
            work = _Work(live.compensator, axis, self._name)
            if not self._at_once:
                self._work = work
                work.thread.start()
                return
            work.run()
            live.adopt(axis, work.found)


class _Work:
    """One axis."""

    def __init__(self, of: Compensator, axis: int, name: str) -> None:
        self.of, self.axis = of, axis
        self.found: Arma | None = None
        self._window: tuple[Floats, float] = of.window(axis)
        self.thread = threading.Thread(target=self.run, name=name, daemon=True)

    def run(self) -> None:
        try:
            self.found = identify(*self._window)
        except NotReady:  # all the same, or far too few: asked again later
            self.found = None
