"""Compilation of the service kernels in the background, with flags that show which kernels are compiled."""

import threading
import time
from dataclasses import dataclass, field
from typing import Final

import structlog

from drivers.host.wake_signal import WakeSignal
from monitor.daemon.kernels import kernel_compilation, kernel_groups

MAX_INTERPRETED_HZ: Final = 250.0
"""Maximum total sample rate of devices with interpreted kernels, which need up to 0.8 ms per sample."""

_log = structlog.get_logger("imu-monitor")


@dataclass(slots=True)
class KernelReadiness:
    """Flags that show which kernels are compiled."""

    window: threading.Event = field(default_factory=threading.Event)
    """Set once the kernels for the Allan deviation are compiled."""
    fit: threading.Event = field(default_factory=threading.Event)
    """Set once the kernels for the noise coefficients are compiled."""
    all: threading.Event = field(default_factory=threading.Event)
    """Set once all kernels of the service are compiled."""
    progress: str = ""
    """Progress of the compilation as one line of text, or "" after the compilation."""
    interpretable_hz: float = MAX_INTERPRETED_HZ
    """Total sample rate that is still available for interpreted kernels."""

    def reserve_interpreted_rate(self, rate_hz: float) -> bool:
        """Reserve interpreted kernels for a device, and return False if the total sample rate would be too high."""
        if rate_hz > self.interpretable_hz:
            return False
        self.interpretable_hz -= rate_hz
        return True

    def compile_kernels(self, wake: WakeSignal) -> None:
        """Compile the kernels, and set a flag and ``wake`` for each compiled part.

        All flags are set even if the compilation fails, because the main loop would otherwise wait forever.
        """
        begin_s = time.monotonic()

        def show_progress(progress: kernel_compilation.CompilationProgress) -> None:
            if not self.progress:
                _log.info("compiling kernels, because this version has not run on this machine before")
            self.progress = f"{progress} {progress.bar_of_block_characters}"
            wake.set()

        try:
            for part in kernel_compilation.prepare_kernels(kernel_groups.SERVICE, show_progress):
                flag = {kernel_groups.WINDOW: self.window, kernel_groups.FIT: self.fit}.get(part)
                if flag is not None:
                    flag.set()
                    wake.set()
            if self.progress:
                _log.info(
                    "kernels are compiled and stored for the next start", seconds=round(time.monotonic() - begin_s)
                )
        except OSError as error:
            _log.warning("compiled kernels cannot be stored; the next start will be slow again", error=str(error))
        finally:
            self.progress = ""
            for flag in (self.window, self.fit, self.all):
                flag.set()
            wake.set()
