"""Identification of ARMA drift models in the background.

The identification for one axis takes about 50 ms and would delay the samples in the main loop.
"""

import threading

from drivers.data_types import Floats
from drivers.errors import NotReady
from monitor.drift.compensation.arma import ArmaModel, fit_arma
from monitor.drift.compensation.gyro_drift_compensator import Compensator
from monitor.drift.compensation.live_compensation import LiveDriftCompensation


class ArmaWorker:
    """Worker that identifies the ARMA models of one device in the background, one axis at a time.

    Parameters
    ----------
    name : str
        Name of the threads.
    synchronous : bool
        True if models are identified in the calling thread, as for a replayed recording.
    """

    def __init__(self, name: str, synchronous: bool) -> None:
        self._name = name
        self._at_once = synchronous
        self._work: _Identification | None = None

    def adopt_results_and_start_next_identification(self, live: LiveDriftCompensation) -> None:
        """Adopt an identified model, and start the next identification that is due."""
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
    def __init__(self, of: Compensator, axis: int, name: str) -> None:
        self.of, self.axis = of, axis
        self.found: ArmaModel | None = None
        self._window: tuple[Floats, float] = of.means_and_noise_variance_for_identification(axis)
        self.thread = threading.Thread(target=self.identify_model, name=name, daemon=True)

    def identify_model(self) -> None:
        """Identify the model of one axis, and store the model or None in ``found``."""
        try:
            self.found = fit_arma(*self._window)
        except NotReady:  # a later attempt may succeed
            self.found = None
