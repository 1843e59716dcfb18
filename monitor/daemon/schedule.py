"""Schedule of the periodic tasks of a device."""

from typing import Literal

Task = Literal["refit", "publish", "samples", "total", "thermal"]


class Schedule:
    """Schedule of the periodic tasks of one device, on the monotonic clock."""

    def __init__(self) -> None:
        self._next_s: dict[Task, float] = {}
        self._now_s = 0.0
        self._drain = False

    def begin_round(self, now_s: float, drain: bool) -> None:
        """Begin a round of the main loop.

        Parameters
        ----------
        now_s : float
            Present time on the monotonic clock, in seconds.
        drain : bool
            True if all tasks run in this round, because the device stops.
        """
        self._now_s, self._drain = now_s, drain

    def is_due(self, task: Task) -> bool:
        """Return True if a task is due in the current round."""
        return self._now_s >= self._next_s.get(task, 0.0)

    def claim_if_due(self, task: Task, interval_s: float) -> bool:
        """Return True if a task must run in the current round, and schedule the next run.

        Parameters
        ----------
        task : Task
            Name of the task.
        interval_s : float
            Interval between two runs in seconds.
        """
        if not self.is_due(task):
            return self._drain
        # missed runs after a pause are skipped
        self._next_s[task] = max(self._next_s.get(task, 0.0) + interval_s, self._now_s + 0.5 * interval_s)
        return True

    def postpone(self, task: Task, delay_s: float) -> None:
        """Postpone a task until at least ``delay_s`` seconds after the start of the current round."""
        self._next_s[task] = max(self._next_s.get(task, 0.0), self._now_s + delay_s)
