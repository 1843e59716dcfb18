"""Execution of the zenoh commands ``reset`` and ``reconcile``."""

from collections.abc import Mapping

import structlog

from monitor.common.unexpected_errors import log_unexpected_error
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.operations.reconcile_on_request import Reconciler, WindowCopyForReconcile
from monitor.publishing.messages.results import ResetReply
from monitor.publishing.zenoh.publisher import Command, ZenohPublisher

_log = structlog.get_logger("imu-monitor")


class CommandHandler:
    """Handler of the zenoh commands for all devices.

    Parameters
    ----------
    zenoh : ZenohPublisher
        Publisher with the queue of commands.
    reconciler : Reconciler
        Runner of the reconciliations.
    """

    def __init__(self, zenoh: ZenohPublisher, reconciler: Reconciler) -> None:
        self._zenoh = zenoh
        self._reconciler = reconciler

    def handle_commands(self, workers: Mapping[str, DeviceWorker]) -> None:
        """Execute the commands that have arrived since the last call."""
        while not self._zenoh.commands.empty():
            command = self._zenoh.commands.get_nowait()
            if command.device not in workers:
                command.reply_refusal("the device was removed from the configuration")
                continue
            try:
                self._execute(command, workers[command.device])
            except Exception as error:  # noqa: BLE001 - the reply contains the error
                command.reply_refusal(log_unexpected_error(f"command {command.verb} of {command.device}", error))

    def publish_reconciled(self, workers: Mapping[str, DeviceWorker]) -> None:
        """Publish an event for each reconciliation that has finished since the last call."""
        for finished in self._reconciler.take_finished_reconciliations():
            if finished.device in workers:
                workers[finished.device].publish_event("reconciled", finished.text)

    def abort_reconciliations(self) -> None:
        """Kill the running reconciliations, and refuse the pending queries."""
        self._reconciler.abort_reconciliations()

    def _execute(self, command: Command, worker: DeviceWorker) -> None:
        match command.verb:
            case "reset":
                worker.empty_window()
                now_s, received = worker.timeline.now_unix_s(), worker.driver.counts.received
                command.reply_result(
                    ResetReply.from_result(worker.name, now_s, received, "the window is empty").encode()
                )
                _log.info("reset", device=worker.name)
            case "reconcile":
                self._reconcile(command, worker)
            case other:
                command.reply_refusal(f'unknown command "{other}"; known commands are reset and reconcile')

    def _reconcile(self, command: Command, worker: DeviceWorker) -> None:
        """Reconcile a copy of the window in the background."""
        window = worker.copy_window_and_temperature()
        if window is None:
            command.reply_refusal("no samples yet")
            return
        received, device = worker.driver.counts.received, worker.device
        newest_s = worker.timeline.to_unix_s(worker.pipeline.newest_ns)
        job = WindowCopyForReconcile(worker.name, newest_s, received, *window, device.model, device.reconcile_folder)
        self._reconciler.start_reconciliation(job, command)
