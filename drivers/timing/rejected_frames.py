"""Test whether rejected frames were samples, from the arrival times of the valid samples around them.

A frame that was damaged on the line takes the place of a sample. A frame of another sender, or a line of text between
the samples, does not. If rejected frames were samples, the time between two reads is longer by one sample period for
each of them. The likelihood ratio of the two hypotheses is accumulated over the reads with rejected frames, for errors
with a normal distribution. Without a decision, rejected frames do not count as samples.
"""

from math import inf, sqrt
from typing import Final

DECISION: Final = 5.0
"""Log likelihood ratio at which the hypothesis changes, equivalent to odds of 148 to 1."""
MAX_LOG_RATIO: Final = 10.0
"""Limit of the accumulated log likelihood ratio, so that the hypothesis can change again."""
MAX_STEP: Final = 6.0
"""Limit of the log likelihood ratio of one read."""
MIN_VARIANCE: Final = 0.01
"""Minimum assumed variance of the number of samples per read, in square sample periods."""
MIN_READS: Final = 50
"""Number of reads from which the variance is estimated before the first decision."""
VARIANCE_WEIGHT: Final = 1.0 / MIN_READS
"""Minimum weight of the newest read in the variance. The first reads have equal weights."""
OUTLIER_SIGMA: Final = 3.0
"""Deviation in standard deviations, plus one sample period, above which a read is late and is not used."""


class RejectedFrameTest:
    """Sequential test whether rejected frames were samples.

    Examples
    --------
    >>> test = RejectedFrameTest()
    >>> [test.count_missing(0.01 * i, samples=1, rejected=5, period_s=0.01) for i in range(4)]  # no time for samples
    [0, 0, 0, 0]
    >>> test = RejectedFrameTest()
    >>> sum(test.count_missing(0.03 * i, samples=1, rejected=2, period_s=0.01) for i in range(200)) > 250
    True
    """

    def __init__(self) -> None:
        self._were_samples = False
        self._log_ratio = 0.0
        self._variance = 1.0
        self._reads = 0  # number of reads in the variance
        self._previous_s = self._read_s = -inf  # arrival times of the last two reads
        self._samples = self._rejected = self._missing = 0  # in the newest read

    def count_missing(self, arrived_s: float, samples: int, rejected: int, period_s: float | None) -> int:
        """Return how many of the frames that were rejected before the newest samples count as missing samples.

        Parameters
        ----------
        arrived_s : float
            Arrival time of the samples in s. Samples with the same arrival time belong to one read.
        samples : int
            Number of samples.
        rejected : int
            Number of frames that were rejected before the samples.
        period_s : float or None
            Sample period in s; None if unknown.
        """
        if arrived_s > self._read_s:
            if period_s is not None and self._previous_s > -inf:
                self._add_newest_read(period_s)
            self._previous_s, self._read_s = self._read_s, arrived_s
            self._samples = self._rejected = self._missing = 0
        self._samples += samples
        self._rejected += rejected
        if not rejected or period_s is None or self._previous_s == -inf:
            return 0
        excess = self._excess_periods(period_s)
        log_ratio = self._log_ratio + self._read_log_ratio(excess)
        if log_ratio <= (-DECISION if self._were_samples else DECISION):
            return 0
        missing = min(rejected, max(int(excess + self._max_deviation()) - self._missing, 0))
        self._missing += missing
        return missing

    def _excess_periods(self, period_s: float) -> float:
        """Return the time since the previous read in sample periods minus the number of samples."""
        return (self._read_s - self._previous_s) / period_s - self._samples

    def _max_deviation(self) -> float:
        return 1.0 + OUTLIER_SIGMA * sqrt(self._variance)

    def _read_log_ratio(self, excess: float) -> float:
        """Return the log likelihood ratio of the newest read, or 0 for an outlier or without a variance."""
        most = self._max_deviation()
        if self._reads < MIN_READS or not -most < excess < self._rejected + most:
            return 0.0
        ratio = self._rejected * (excess - 0.5 * self._rejected) / self._variance
        return min(max(ratio, -MAX_STEP), MAX_STEP)

    def _add_newest_read(self, period_s: float) -> None:
        excess = self._excess_periods(period_s)
        if self._rejected:
            log_ratio = self._log_ratio + self._read_log_ratio(excess)
            self._log_ratio = min(max(log_ratio, -MAX_LOG_RATIO), MAX_LOG_RATIO)
            self._were_samples = self._log_ratio > (-DECISION if self._were_samples else DECISION)
        deviation = min(abs(excess), abs(excess - self._rejected), 2.0 * self._max_deviation())
        self._reads += 1
        weight = max(VARIANCE_WEIGHT, 1.0 / self._reads)
        self._variance += weight * (max(deviation * deviation, MIN_VARIANCE) - self._variance)
