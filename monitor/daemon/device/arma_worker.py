"""Identification of ARMA drift models in the background.

The identification of one axis takes about 50 ms. In the main loop, the identification would delay the samples.
"""

import threading

from drivers.data_types import Floats
from drivers.errors import NotReady
from monitor.drift.compensation.arma import ArmaModel, fit_arma
from monitor.drift.compensation.compensator import Compensator
from monitor.drift.compensation.live_compensation import LiveCompensation


class ArmaWorker:
    """Worker that identifies the ARMA models of one device, one axis after the other, each in a new thread.

    Parameters
    ----------
    name : str
        Name of the threads.
    synchronous : bool
        True if models are identified in the calling thread, because a replayed recording can wait.
    """

    def __init__(self, name: str, synchronous: bool) -> None:
        self._name = name
        self._at_once = synchronous
        self._work: _Identification | None = None

    def adopt_and_start_models(self, live: LiveCompensation) -> None:
        """Adopt the model that has been identified, and start to identify the next axis that is due."""
        if self._work is not None:
            if self._work.thread.is_alive():
                return
            if self._work.of is live.compensator:  # the compensator may have been replaced since the thread started
                live.apply_identification_result(self._work.axis, self._work.found)
            self._work = None
        for axis in live.compensator.axes_due_for_identification:
            work = _Identification(live.compensator, axis, self._name)
            if not self._at_once:
                self._work = work
                work.thread.start()
                return
            work.identify_model()
            live.apply_identification_result(axis, work.found)


class _Identification:
    """Identification of the model of one axis."""

    def __init__(self, of: Compensator, axis: int, name: str) -> None:
        self.of, self.axis = of, axis
        self.found: ArmaModel | None = None
        self._window: tuple[Floats, float] = of.means_and_noise_variance_for_identification(axis)
        self.thread = threading.Thread(target=self.identify_model, name=name, daemon=True)

    def identify_model(self) -> None:
        """Identify the model; ``found`` stays None if the data do not determine a model."""
        try:
            self.found = fit_arma(*self._window)
        except NotReady:  # all values are equal, or there are too few; a later attempt may succeed
            self.found = None
