"""Detect spectral lines that begin, end or change their amplitude, and measure their frequency and amplitude.

The samples of each axis are divided into overlapping segments of about 5 s. The periodogram of each segment is compared
with the mean periodogram since the last change, which is the reference.

- **Evidence.** For each frequency bin, Page's CUSUM adds up the log-likelihood ratio x (1 − 1/r) − ln r of a rise of
  the power by a factor r, where x is the power relative to the reference. The power of noise in a bin is exponentially
  distributed, and segments that overlap by half are nearly independent (Welch 1967). A line whose amplitude is a third
  of the standard deviation of the noise is found within half a minute.
- **Large lines** also raise an alarm of the change detector, within a second. The periodogram of the samples since the
  alarm then shows whether a line explains the change.
- **A line** is a peak that exceeds the bins on both sides and contains most of the power above them. A step of the
  noise level, a random walk and a wide resonance are not lines. A line whose frequency drifts has not begun.
"""

from dataclasses import dataclass
from math import log, log2
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.validation.number_ranges import DAY_S

SEGMENT_S: Final = 5.0
"""Length of a segment in seconds, approximately, because the number of samples is a power of two."""
MIN_SEGMENT, MAX_SEGMENT = 256, 4096
"""Limits of the number of samples in a segment."""
MIN_SAMPLES: Final = 128
"""Minimum number of samples after an alarm from which a line is identified."""
MAX_MISSING_SHARE: Final = 0.3
"""Maximum share of missing samples in a segment."""
RATIOS: Final = np.array([4.0, 16.0])[:, None, None]
"""Ratios between the power after and before the onset of a line, for which the evidence is computed."""
MIN_SEGMENTS_BEFORE, MIN_SEGMENTS_AFTER = 4, 2
"""Minimum numbers of segments before and after the onset of a line."""
MIN_LASTING_POWER: Final = 0.25
"""Minimum ratio of the power of a line in the newest segment to its mean power."""
MIN_LASTING_AMPLITUDE: Final = 0.4
"""Minimum amplitude of a line in each half of the newest samples, relative to the whole."""
FIRST_BIN: Final = 6
"""First bin of a segment that is searched. Random walk and drift have most of their power in lower bins."""
SMEAR_BINS: Final = 2
"""Number of bins by which a line may have moved in the reference without counting as a new line."""
LEVEL_BINS: Final = 32
"""Number of bins whose median shows a change of the noise level, which is not evidence for a line."""
MEDIAN: Final = log(2.0)
"""Median of the χ² distribution with two degrees of freedom, relative to its mean."""
MIN_PEAK_RATIO: Final = 5.0
"""Minimum ratio of the mean power of a line to the bins beside it."""
MIN_SINGLE_PEAK_RATIO: Final = 12.0
"""Minimum ratio of the power of a line to the bins beside it in a single periodogram."""
MIN_CONCENTRATION: Final = 0.7
"""Minimum share of the power above the surrounding noise that a line contains, within four times its width."""
MIN_SHARE: Final = 0.5
"""Minimum share of the change of the variance that is explained by a line."""
MIN_POWER_BEFORE: Final = 0.05
"""Minimum ratio of the power of a line before a rise to that after the rise, if the line did not begin."""
MAX_POWER_BEFORE: Final = 0.6
"""Maximum ratio of the power of a line before and after a rise, and after and before a fall."""

MAX_MOVED_POWER: Final = 0.25
"""Maximum ratio of the power that other lines within ``LEVEL_BINS`` bins have lost to the power of a line that begins.

A line whose frequency drifts loses its power at the earlier frequencies.
"""


@dataclass(frozen=True, slots=True)
class LineChange:
    """Change of a spectral line of one axis."""

    axis: int  # index into AXES
    frequency_hz: float  # frequency after sampling, possibly an alias
    before: float  # amplitude before the change, rad/s or m/s²; 0 means no line
    after: float  # amplitude after the change
    age: int  # number of samples since the onset; 0 if the caller knows the onset
    evidence: float  # log-likelihood ratio; 0 if the caller knows the evidence


class LineOnsetDetector:
    """Detector of spectral lines that begin on six axes.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    alarms_per_day : float
        Accepted number of false alarms per day.
    learn_s : float
        Length of the reference in seconds up to which the threshold is higher.
    """

    def __init__(self, rate_hz: float, alarms_per_day: float, learn_s: float) -> None:
        self._rate_hz = rate_hz
        self._n = 1 << round(log2(min(max(SEGMENT_S * rate_hz, MIN_SEGMENT), MAX_SEGMENT)))
        bins, hop = self._n // 2, self._n // 2
        self._newest = np.full((self._n, len(AXES)), np.nan)
        self.samples_to_segment_end = hop
        """Number of samples until the next segment is complete."""
        looks = DAY_S * rate_hz / hop * bins * len(AXES)
        self._threshold = max(log(looks / alarms_per_day), 1.0)
        self._learn_segments = learn_s * rate_hz / hop
        self._sum = np.zeros((len(AXES), bins))  # sum of the periodograms since the last change
        self._count = np.zeros((len(AXES), 1))  # number of these periodograms
        self._evidence = np.zeros((len(RATIOS), len(AXES), bins))
        self._sum1, self._count1 = self._evidence.copy(), self._evidence.copy()  # since the suspected onset

    def append_samples(self, values: Floats) -> None:
        """Append at most ``samples_to_segment_end`` samples [k, 6]."""
        k = len(values)
        self._newest[:-k] = self._newest[k:]
        self._newest[-k:] = values
        self.samples_to_segment_end -= k

    def take_changes(self) -> list[LineChange]:
        """Process a segment that is complete, and return the lines that have begun."""
        if self.samples_to_segment_end:
            return []
        hop = self.samples_to_segment_end = self._n // 2
        usable = np.isfinite(self._newest).mean(axis=0) >= 1.0 - MAX_MISSING_SHARE
        if not usable.any():
            return []
        with np.errstate(all="ignore"):
            power = np.where(usable[:, None], _periodogram(self._newest, self._n), 0.0)
            self._raise_evidence(power, usable)
        changes = []
        # As in the change detector, a short reference does not contain slow fluctuations.
        length = np.minimum((self._count - self._count1) / self._learn_segments, 1.0)
        for axis in np.flatnonzero(usable & (self._evidence * length > self._threshold).any(axis=(0, 2))):
            evidence = self._evidence[:, axis] * length[:, axis]
            ratio = int(np.flatnonzero((evidence > self._threshold).any(axis=1))[-1])  # has the most accurate onset
            top = int(evidence[ratio].argmax())
            count = self._count1[ratio, axis, top]
            if count < MIN_SEGMENTS_AFTER:
                continue
            near = slice(top - SMEAR_BINS, top + SMEAR_BINS + 1)
            # Bins of the line have the same onset. The other bins show the surrounding noise.
            after = np.where(self._count1[ratio, axis] == count, self._sum1[ratio, axis] / count, power[axis])
            share = float(np.isfinite(self._newest[:, axis]).mean())
            found = self._compare(after, self._before(int(axis)), self._n, share, MIN_PEAK_RATIO, near)
            if (
                found
                and count == MIN_SEGMENTS_AFTER
                and not _lasts(self._newest[:, axis], found[0] / self._rate_hz, found[2])
            ):
                continue  # a burst within two overlapping segments, or a small line: the next segment decides
            ended = power[axis, near].max() < MIN_LASTING_POWER * after[near].max()
            if found is None or ended or found[1] > 0.0:  # the power of a narrow resonance fluctuates
                self._evidence[:, axis] = self._sum1[:, axis] = self._count1[:, axis] = 0.0
            else:
                age = round((count + 0.5) * hop)
                changes.append(LineChange(int(axis), *found, age, float(evidence[ratio, top])))
        return changes

    def identify_change(self, axis: int, samples: int) -> LineChange | None:
        """Return the line whose change explains a change of the noise, or None.

        Parameters
        ----------
        axis : int
            Index into ``AXES``.
        samples : int
            Number of samples since the change.
        """
        k = min(samples, self._n)
        part = self._newest[-k:, [axis]]
        share = float(np.isfinite(part).mean())
        if k < max(MIN_SAMPLES, self._n // 16) or not self._count[axis, 0] or not share > 0.5:
            return None
        with np.errstate(all="ignore"):
            after, before = _periodogram(part, self._n)[0], self._before(axis)
            rose = self._compare(after, before, k, share, MIN_SINGLE_PEAK_RATIO)
            if rose is not None and _lasts(part[-2 * MIN_SAMPLES :, 0], rose[0] / self._rate_hz, rose[2]):
                return LineChange(axis, *rose, 0, 0.0)
            fell = self._compare(before, after, k, share, MIN_SINGLE_PEAK_RATIO)
            return None if fell is None else LineChange(axis, fell[0], fell[2], fell[1], 0, 0.0)

    def restart(self, axis: int) -> None:
        """Discard the reference of one axis after a change."""
        self._sum[axis] = self._count[axis] = 0.0
        self._evidence[:, axis] = self._sum1[:, axis] = self._count1[:, axis] = 0.0

    def _before(self, axis: int) -> Floats:
        """Return the mean periodogram of the segments before a suspected rise."""
        n0 = self._count[axis] - self._count1[0, axis]
        return np.asarray((self._sum[axis] - self._sum1[0, axis]) / np.maximum(n0, 1.0))

    def _raise_evidence(self, power: Floats, usable: np.ndarray) -> None:
        """Update the evidence with the periodograms [6, bins] of a segment."""
        n0 = self._count - self._count1
        before = (self._sum - self._sum1) / n0
        blocks = (len(RATIOS), len(AXES), -1, LEVEL_BINS)
        beside = np.repeat(np.median(before.reshape(blocks), axis=3), LEVEL_BINS, axis=2)
        relative = power / np.maximum(_spread(before), beside)
        level = np.median(relative.reshape(blocks), axis=3) / MEDIAN
        # The median fluctuates by a quarter, so only a level that is clearly higher counts.
        relative /= np.repeat(np.maximum(0.8 * level, 1.0), LEVEL_BINS, axis=2)
        gained = self._evidence + relative * (1.0 - 1.0 / RATIOS) - np.log(RATIOS)
        rises = (gained > 0.0) & (n0 >= MIN_SEGMENTS_BEFORE)
        rises[:, :, :FIRST_BIN] = False
        seen = usable[:, None]
        self._evidence = np.where(seen, np.where(rises, gained, 0.0), self._evidence)
        self._sum1 = np.where(seen, np.where(rises, self._sum1 + power, 0.0), self._sum1)
        self._count1 = np.where(seen, np.where(rises, self._count1 + 1.0, 0.0), self._count1)
        self._sum += power
        self._count += seen

    def _compare(
        self, high: Floats, low: Floats, samples: int, share: float, min_ratio: float, near: slice | None = None
    ) -> tuple[float, float, float] | None:
        """Return the frequency of a line that is stronger in one periodogram, and its amplitudes in both, or None.

        If only a share of the samples is present, the power of a line relative to the noise is reduced to this share.
        """
        half = 2 * self._n // samples + 1  # the main lobe of the Hann window has two bins on each side
        side = 4 * half
        first = max(FIRST_BIN, half)
        searched = high - low
        top = first + int(searched[first:].argmax()) if near is None else near.start + int(high[near].argmax())
        left = high[max(top - side, 0) : max(top - half, 0)]
        right = high[top + half + 1 : top + side + 1]
        beside = max(float(np.median(part)) if part.size >= half else 0.0 for part in (left, right)) / MEDIAN
        if not high[top] > min_ratio * max(beside, 0.0) or not 0 < top < high.size - 1:
            return None
        inner, outer = slice(max(top - half, 0), top + half + 1), slice(max(top - side, 0), top + side + 1)
        power = float((high[inner] - beside).sum())
        around = float(np.maximum(high[outer] - beside, 0.0).sum()) if beside else power
        before = float((low[inner] - beside).sum()) if low[inner].max() > MIN_PEAK_RATIO * beside else 0.0
        if not power > MIN_CONCENTRATION * around or before > MAX_POWER_BEFORE * power:
            return None
        wide = slice(max(top - LEVEL_BINS, 0), top + LEVEL_BINS + 1)
        lines = low[wide] > MIN_PEAK_RATIO * np.median(low[wide]) / MEDIAN
        if np.maximum(low[wide] - high[wide], 0.0)[lines].sum() > MAX_MOVED_POWER * power:
            return None
        if near is None and power - before < MIN_SHARE * float((high - low)[FIRST_BIN:].sum()):
            return None
        a, b, c = np.log(high[top - 1 : top + 2])
        frequency = (top + 0.5 * (a - c) / (a - 2.0 * b + c)) * self._rate_hz / self._n
        return (
            float(frequency),
            float(np.sqrt(2.0 * before / share)) if before > MIN_POWER_BEFORE * power else 0.0,
            float(np.sqrt(2.0 * power / share)),
        )


def _periodogram(part: Floats, n: int) -> Floats:
    """Return the mean square per bin [axes, n / 2] of samples [k, axes], padded with zeros to n samples."""
    there = np.isfinite(part)
    mean = np.where(there, part, 0.0).sum(axis=0) / there.sum(axis=0)
    window = np.hanning(len(part) + 2)[1:-1, None]
    turned = np.fft.rfft(np.where(there, part - mean, 0.0) * window, n, axis=0)[:-1]
    weight = n * (window**2 * there).sum(axis=0)  # white noise has the same power with missing samples
    return np.asarray(2.0 * (turned.real**2 + turned.imag**2).T / weight[:, None])


def _lasts(part: Floats, turns: float, amplitude: float) -> bool:
    """Return True if both halves of the samples contain a sinusoid of about the stated amplitude."""
    half = len(part) // 2
    rotation = np.exp(-2j * np.pi * turns * np.arange(half))
    halves = []
    for x in (part[:half], part[-half:]):
        window = np.hanning(half) * np.isfinite(x)
        weight, x = max(window.sum(), 1e-300), np.nan_to_num(x)
        halves.append(2.0 / weight * abs(np.sum(window * (x - window @ x / weight) * rotation)))
    return bool(min(halves) > MIN_LASTING_AMPLITUDE * amplitude)


def _spread(power: Floats) -> Floats:
    """Return the largest power within ``SMEAR_BINS`` bins of each bin."""
    out = power.copy()
    for shift in range(1, SMEAR_BINS + 1):
        np.maximum(out[..., shift:], power[..., :-shift], out=out[..., shift:])
        np.maximum(out[..., :-shift], power[..., shift:], out=out[..., :-shift])
    return out
