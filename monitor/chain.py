"""What the samples of one device go through: is it at rest, what is its noise, what do temperature and drift do.

Blocks in, in order; the latest results stand in ``estimator``, ``thermal``, ``compensation`` and ``watch``, and what
was found is taken as events. Nothing is published here, and no clock is read: who owns the chain says when it may
advance and what is told of it. After a restart of the program the same chain lives through the tail of the recording
(``relive``), silently.
"""

from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from threading import Event as Flag
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES, Event, Floats, SampleBlock
from monitor.compiled import interpreted
from monitor.drift.live import LiveThermal, ThermalLook
from monitor.drift.live_compensation import LiveCompensation
from monitor.estimate.estimator import Estimator
from monitor.estimate.held import Held, Temperatures
from monitor.estimate.model_gap import ModelInForce
from monitor.estimate.watch import Watch
from monitor.identifier import Identifier
from monitor.noise.model import NoiseModel
from monitor.settings import Device

MAX_INTERPRETED_HZ: Final = 250.0
"""Samples a second, of all devices, that Python can take while kernels are compiled: half a millisecond each."""
PIECE: Final = 512
"""Samples estimated before it is asked whether the noise has changed: a fast replay brings thousands at once."""


@dataclass(slots=True)
class Ready:
    """Flags of the compiled kernels (``monitor.kernels``), and the sample rate that Python can process until then."""

    window: Flag = field(default_factory=Flag)
    fit: Flag = field(default_factory=Flag)
    all: Flag = field(default_factory=Flag)
    progress: str = ""
    """What is being compiled, one line for people; empty if nothing is."""
    interpretable_hz: float = MAX_INTERPRETED_HZ
    """Rate of samples that Python can still take on, see ``interpreted``."""

    def interpret(self, rate_hz: float) -> bool:
        """Return True if the samples of one more device of this rate can go through interpreted kernels."""
        if rate_hz > self.interpretable_hz:
            return False
        self.interpretable_hz -= rate_hz
        return True


class Chain:
    """The statistics of one device.

    Args:
        device: its settings
        model: the model in force, if there is one
        ready: which kernels are compiled; nothing is compiled in ``advance``, as that would hold up all devices
        patient: samples wait while a model of temperature is being chosen, as a recording's can
        needs_all: begin only when all kernels can be called
        live: samples come at the device's rate, so that at a low rate kernels can be interpreted at first
    """

    def __init__(
        self, device: Device, model: NoiseModel | None, ready: Ready, patient: bool, needs_all: bool, live: bool
    ) -> None:
        self.estimator: Estimator | None = None
        self.watch: Watch | None = None
        self.thermal: LiveThermal | None = None
        self.compensation: LiveCompensation | None = None
        self.in_force: ModelInForce | None = None
        self.refused = ""
        """Why there can be no estimate."""
        self.advanced = False
        """Samples since whoever looks has set it back."""
        self.since_ns: list[int | None] = [None] * len(AXES)
        """Time of the first sample that counts, of axes that began anew."""
        self.newest_ns = 0
        """Time of the newest sample that came in; 0 before the first."""
        self.identifier = Identifier(f"drift of {device.name}", at_once=patient)
        self._device = device
        self._model = model
        self._ready = ready
        self._patient = patient
        self._needs = ready.all if needs_all else ready.window
        self._live = live
        self._interprets = False
        self._temperatures: Temperatures | None = None  # of the samples in the window
        self._looks: list[ThermalLook] = []  # not taken yet
        self._handled = 0  # as often as the watch has said it
        self._pieces: deque[SampleBlock] = deque()  # of a recording, that wait until a model is chosen
        self._reliving = False

    def can_begin(self, rate_hz: float) -> bool:
        """Return True if the kernels that it needs to begin are compiled, or can be interpreted until they are."""
        if not self._interprets and not self._needs.is_set():
            self._interprets = self._live and self._ready.interpret(rate_hz)
        return self._interprets or self._needs.is_set()

    @property
    def can_fit(self) -> bool:
        """True if the kernels of the fit can be called."""
        return self._interprets or self._ready.fit.is_set()

    @property
    def fits_slowly(self) -> bool:
        """True if the kernels of the fit are interpreted. A fit then takes about 0.1 s."""
        return self._interprets and not self._ready.fit.is_set()

    @property
    def can_watch(self) -> bool:
        """True if the kernels of motion and change detection can be called."""
        return self._interprets or self._ready.all.is_set()

    def interpreted(self, rate_hz: float | None) -> AbstractContextManager[None]:
        """Return the context in which the kernels are to be called; until a rate is known none is called."""
        if rate_hz is not None and self.estimator is None:
            self.can_begin(rate_hz)
        return interpreted() if self._interprets and not self._ready.all.is_set() else nullcontext()

    @property
    def waiting(self) -> bool:
        """Whether samples wait until a model of temperature is chosen."""
        return bool(self._pieces)

    def advance(self, blocks: Sequence[SampleBlock], rate_hz: float | None, drain: bool) -> None:
        """Take blocks in; nothing waits when draining. Until a rate is known they leave no trace."""
        if blocks:
            self.newest_ns = int(blocks[-1].t_ns[-1])
        if self.estimator is None and (rate_hz is None or not self._begin(rate_hz)):
            return
        if self.watch is None and self.can_watch:
            self._begin_watching()
        self._pieces += [samples[at : at + PIECE] for samples in blocks for at in range(0, len(samples), PIECE)]
        while self._pieces and (drain or not self._patient or self.thermal is None or not self.thermal.choosing):
            piece = self._pieces.popleft()
            self._estimate(self.watch.update(piece) if self.watch is not None else [piece])
            self._restart()
            self._follow()

    def flush(self) -> None:
        """Take in what is held back, when no more will come."""
        self._estimate(self.watch.flush() if self.watch is not None else [])
        self._restart()
        self._follow()

    def renew(self) -> None:
        """Where an interval of the compensation has just ended: take models over, and have those that are due found."""
        live = self.compensation
        if live is None or not self._ready.all.is_set():  # models are found by a thread, which would compile
            return
        if live.compensator.ahead == live.compensator.interval:
            self.identifier.renew(live)

    def relive(self, samples: SampleBlock, rate_hz: float) -> None:
        """Take a recorded block in; what was found in it was told then, and where an axis began anew is known."""
        self._reliving = True
        self.advance([samples], rate_hz, drain=True)
        self._reliving = False
        live = self.compensation
        if live is not None and np.isfinite(samples.values[:, :3]).any():
            for at in range(0, len(samples), PIECE):
                live.update(samples[at : at + PIECE])
            self.identifier.renew(live)
            live.take()
        self.take_events()
        self.take_looks()

    def reset(self) -> None:
        """Empty the window."""
        if self.estimator is not None:
            self.estimator.reset()
            self.since_ns = [self.newest_ns + 1] * len(AXES)

    def relabel(self, rate_hz: float) -> None:
        """The rate is known better now."""
        if self.estimator is None or rate_hz == self.estimator.rate_hz:
            return
        self.estimator.relabel(rate_hz)
        for one in (self.watch, self.thermal, self.compensation):
            if one is not None:
                one.relabel(rate_hz)

    def held(self) -> tuple[Held, Floats] | None:
        """The samples in the window and their temperature [n], as of now; None while there are none."""
        if self.estimator is None or self._temperatures is None or not self.estimator.filled:
            return None
        return self.estimator.held(), self._temperatures.newest(self.estimator.filled)

    def take_events(self) -> list[Event]:
        """What was found since the last call."""
        found = [source.take_events() for source in (self.watch, self.thermal, self.compensation) if source is not None]
        return [event for events in found for event in events]

    def take_looks(self) -> list[ThermalLook]:
        """Intervals that were held against temperature since the last call."""
        looks, self._looks = self._looks, []
        return looks

    # --- inside

    def _begin(self, rate_hz: float) -> bool:
        if self.refused or not self.can_begin(rate_hz):
            return False
        device = self._device
        try:
            self.estimator = Estimator(rate_hz, device.window_s, device.tau, every_sample=device.refit_s == 0.0)
            self._temperatures = Temperatures(self.estimator.length)
            if self._model is not None:
                self.in_force = ModelInForce(self._model, self.estimator.length)
        except ConfigError as error:  # a list of τ that does not fit the rate found; samples go on
            self.refused = f"no estimate: {error}"
            return False
        return True

    def _begin_watching(self) -> None:
        if self.estimator is None:
            return
        device, rate_hz = self._device, self.estimator.rate_hz
        wanted = device.thermal_s is not None
        self.watch = Watch(rate_hz, device.leave_out_motion, device.alarms_per_day, keep_still=wanted)
        self.thermal = None if device.thermal_s is None else LiveThermal(rate_hz, device.thermal_s)
        self.compensation = LiveCompensation(rate_hz) if device.compensate else None

    def _estimate(self, blocks: Sequence[SampleBlock]) -> None:
        if self.estimator is None or self._temperatures is None:
            return
        for samples in blocks:
            self.estimator.update(samples)
            self._temperatures.push(samples.lost, samples.temperature_c)
            self.advanced = True

    def _restart(self) -> None:
        """Let axes begin anew whose noise was found changed."""
        restarts = self.watch.take_restarts() if self.watch is not None else []
        if self.estimator is None or not self._device.restart or self._reliving:
            return
        for restart in restarts:
            self.estimator.restart(restart.axis, restart.samples)
            back_ns = round((restart.samples - 0.5) / self.estimator.rate_hz * 1e9)
            self.since_ns[restart.axis] = self.newest_ns - back_ns

    def _follow(self) -> None:
        """Hand on what is at rest to the models of temperature."""
        if self.watch is None or self.thermal is None:
            return
        if self.watch.handled != self._handled:
            self._handled = self.watch.handled
            self.thermal.offset_is_new()
        for samples in self.watch.take_still():
            self._looks += self.thermal.update(samples)
