"""What an observer who knows the truth gains in log-likelihood, over the baseline and over the best wrong name.

What the gain is of,

- a Gaussian term, a scale factor or a low-pass is worth ln p(y | S true) − ln p(y | S baseline) (Whittle);
- what is known in advance (ramp, line, step, heat, leak) is taken out of y with its true size;
- popcorn and Poisson steps: the path is unknown. Its evidence is the true path's gain, times the prior of the path,
  times the room that the data leave: a jump of height h in white noise N is timed to ∫exp(−v|t|/2 + √v W)dt, v =
  h²/N², of which the mean logarithm is ln(10/v) (Laplace's method; both-sided Dufresne integral, simulated). A jump
  that is timed no better than jumps are spaced gains nothing and costs nothing;
- a wandering line: the path of its phase is unknown too. It is worth the gain of the true line, less two nats for each
  stretch over which the phase can be extrapolated: κ^(−2/3) for a frequency that walks by κ = s√(2/T) in Hz/√s;
- a wandering variance: the logarithms of block variances, filtered by Kalman's filter with the true parameters;
- outliers, noise steps and heavy tails: the samples whitened by 1/√S, then a two-Gaussian mixture, two variances, or
  Student's t;
- what is exact (a grid, repeats, clipping) gains without bound: ``inf``;
- a wrong clock: each line of the model found where it is and missed where it should be.

Wrong names are fitted, the truth is not, so margins err on the low side. They are: the baseline's terms retuned, Q,
N, B, K, correlated noise of up to T/30, and ramp, transient, step, temperature and lag as regressors beside retuned
terms; for a leak any Gaussian noise of that spectrum; for a line a resonance of 10/T and for a resonance the best
line; for popcorn correlated noise, for jumps random walk, and for a wandering line a resonance of its spectrum.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special, stats
from scipy.fft import dct, rfft

from tests.experiments.blind.processes import Floats, modulated
from tests.experiments.blind.rivals import Rivals
from tests.experiments.blind.spectra import SHAPES, coefficients, density, frequencies, log_likelihood
from tests.experiments.blind.world import LEAKS, Effect, World

EXACT: Final = ("saturation", "resolution", "sample_hold")
KNOWN: Final = (
    "rate_ramp",
    "sinusoidal",
    "temperature_bias",
    "temperature_lag",
    "temperature_hysteresis",
    "pulse_train",
    "bias_curve",
    "turn_on_transient",
    "bias_step",
    *LEAKS,
)
TIMING: Final = 10.0
PHASE: Final = 2.0


@dataclass(frozen=True)
class Gains:
    """Of log-likelihood; ``wrong`` names the best wrong name."""

    over_baseline: float
    over_wrong: float
    wrong: str = ""


class Observer:
    """One axis of a sensor, and the effect hidden in it."""

    def __init__(self, world: World, effect: Effect) -> None:
        self.world, self.effect = world, effect
        self.rate = world.rate_hz
        baseline = [one for one in world.baseline if one.axis == effect.axis]
        self.baseline = [one for one in baseline if one.name not in KNOWN]
        self.values = world.with_hidden(effect).measured(effect.axis)
        for one in baseline:
            if one.name in KNOWN:
                self.values = self.values - self._signal(one)
        self.n = self.values.size
        self.f = frequencies(self.n, self.rate)
        self.y = coefficients(self.values)
        self.v = density(self.baseline, self.f, self.rate) * self.rate
        self.base = log_likelihood(self.y, self.v)

    def gain(self) -> float:
        """Over the baseline, with the true parameters."""
        name = self.effect.name
        if name in EXACT:
            return float("inf")
        if name in KNOWN:
            return self._known(coefficients(self._signal(self.effect)))
        if name in ("random_telegraph", "poisson_steps"):
            return self._path()
        if name == "wandering_line":
            return self._wandering()
        if name in ("outliers", "noise_step", "heavy_tails", "variance_modulation", "wandering_variance"):
            return self._samples()
        return self._gaussian([*self.baseline, self.effect])

    def wrong(self) -> tuple[float, str]:
        """Gain over the baseline of the best wrong name, and which."""
        name = self.effect.name
        if name in EXACT:
            return 0.0, ""
        if name == "scale_factor":
            return self._rivals().retuned_one(), "a lone retuned term"
        found = self._rivals().all(without=name)
        if name in LEAKS:
            source = density([one for one in self.world.baseline if one.axis == self._source], self.f, self.rate)
            v = self.v + self.effect.parameters["coefficient"] ** 2 * source * self.rate
            found["noise like the source's"] = log_likelihood(self.y, v) - self.base
        elif name == "sinusoidal":
            found["narrowband"] = self._resonance()
        elif name == "narrowband":
            found["sinusoidal"] = self._best_line()
        elif name in ("random_telegraph", "poisson_steps", "wandering_line"):
            found["its spectrum"] = self._gaussian([*self.baseline, self.effect])
        elif name == "exponentially_correlated":
            found["random_telegraph"] = self._gaussian([*self.baseline, self.effect]) - self._as_popcorn()
        best = max(found, key=lambda one: found[one])
        return found[best], best

    def _rivals(self) -> Rivals:
        return Rivals(self.y, self.v, self.baseline, self.rate, self.world.clock().temperature_c)

    def gains(self) -> Gains:
        """Both."""
        gain = self.gain()
        wrong, name = self.wrong()
        return Gains(gain, gain - max(wrong, 0.0), name)

    @property
    def _source(self) -> str:
        return str(self.effect.parameters["source"])

    def _signal(self, effect: Effect) -> Floats:
        if effect.name in LEAKS:
            return float(effect.parameters["coefficient"]) * self.world.alone(effect.parameters["source"])
        return self.world.series(effect)

    def _known(self, signal: Floats) -> float:
        return float(np.sum((self.y - 0.5 * signal) * signal / self.v))

    def _gaussian(self, effects: Iterable[Effect]) -> float:
        v = density(effects, self.f, self.rate) * self.rate
        # far above a low-pass the ends of the recording leak more than passes: count no more than a hundredth
        return log_likelihood(self.y, np.maximum(v, 0.01 * self.v)) - self.base

    def _path(self) -> float:
        """Evidence for jumps: see the module."""
        path = self.world.series(self.effect)
        heights = np.diff(path)
        heights = heights[heights != 0.0]
        gain = self._known(coefficients(path - path.mean()))
        parameters = self.effect.parameters
        rate = parameters["rate"] if "rate" in parameters else 1.0 / parameters["dwell_time"]
        room = TIMING * self.world.term(self.effect.axis, "angle_random_walk", "N") ** 2 / heights**2
        prior = np.log(np.minimum(rate * room, 1.0)) - 1.0
        if self.effect.name == "poisson_steps":  # a height, too, is learned: to the noise over the time between jumps
            noise = np.sqrt(2.0 * rate) * self.world.term(self.effect.axis, "angle_random_walk", "N")
            spread = parameters["height"]
            prior += np.minimum(0.0, np.log(noise / spread)) - 0.5 * (heights / spread) ** 2 + 0.5
        return gain + float(np.sum(prior))

    def _wandering(self) -> float:
        """Return the gain of the line with its true phase, less the cost of learning the phase (see the module)."""
        parameters = self.effect.parameters
        walk = parameters["frequency_deviation"] * np.sqrt(2.0 / parameters["correlation_time"])
        stretches = self.world.seconds * walk ** (2.0 / 3.0)
        return self._known(coefficients(self.world.series(self.effect))) - PHASE * float(stretches)

    def _samples(self) -> float:
        """Of whitened samples."""
        w = dct(np.concatenate([[0.0], self.y / np.sqrt(self.v)]), norm="ortho", type=3)
        if self.effect.name == "noise_step":
            after = np.arange(self.n) >= self.effect.parameters["time"] * self.rate
            ratio = self.effect.parameters["ratio"]
            return float(np.sum(0.5 * w[after] ** 2 * (1.0 - ratio**-2.0)) - after.sum() * np.log(ratio))
        if self.effect.name == "variance_modulation":
            power = np.maximum(modulated(self.world.clock(), **self.effect.parameters), 1e-3)
            return float(np.sum(0.5 * w**2 * (1.0 - 1.0 / power) - 0.5 * np.log(power)))
        if self.effect.name == "wandering_variance":
            return self._log_variances(w)
        if self.effect.name == "heavy_tails":
            nu = self.effect.parameters["nu"]
            student = stats.t(nu, scale=np.sqrt(1.0 - 2.0 / nu))
            return float(np.sum(student.logpdf(w) - stats.norm.logpdf(w)))
        share = self.effect.parameters["fraction"]
        s2 = 1.0 + (self.effect.parameters["scale"] / self.world.noise(self.effect.axis)) ** 2
        mixed = np.logaddexp(np.log1p(-share) - 0.5 * w**2, np.log(share) - 0.5 * np.log(s2) - 0.5 * w**2 / s2)
        return float(np.sum(mixed + 0.5 * w**2))

    def _log_variances(self, w: Floats) -> float:
        """Of the logarithms of the variances of blocks: a Kalman filter against a constant."""
        size = max(32, self.n // 4096)
        logs = np.log(np.mean(w[: w.size // size * size].reshape(-1, size) ** 2, axis=1))
        logs -= logs.mean()
        error = float(special.polygamma(1, 0.5 * size))
        spread = self.effect.parameters["deviation"] ** 2
        decay = float(np.exp(-size / (self.rate * self.effect.parameters["correlation_time"])))
        gain, state, variance = 0.5 * float(np.sum(np.log(error) + logs**2 / error)), 0.0, spread
        for log in logs.tolist():
            total = variance + error
            gain -= 0.5 * (np.log(total) + (log - state) ** 2 / total)
            state, variance = decay * (state + variance / total * (log - state)), variance * error / total
            variance = decay**2 * variance + (1.0 - decay**2) * spread
        return float(gain)

    def _resonance(self) -> float:
        """The best resonance in place of a line."""
        where, amplitude = self.effect.parameters["frequency"], self.effect.parameters["amplitude"]
        gains = []
        for width in (10.0, 30.0, 100.0):
            unit = SHAPES["narrowband"](self.f, 1.0 / self.rate, 1.0, where, width / self.world.seconds) * self.rate
            near = np.abs(self.f - where) < 100.0 * width / self.world.seconds
            y, v, u = self.y[near], self.v[near], unit[near]
            base = log_likelihood(y, v)
            gains += [log_likelihood(y, v + a * amplitude**2 * u) - base for a in (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)]
        return max(gains)

    def _best_line(self) -> float:
        """The strongest line inside a resonance: power over noise at the best of the frequencies 1/2T apart."""
        half = 3.0 * self.effect.parameters["bandwidth"]
        power = np.abs(rfft(self.values - self.values.mean(), 2 * self.n)) ** 2 / self.n
        f = np.arange(power.size) * self.rate / (2.0 * self.n)
        near = np.abs(f - self.effect.parameters["frequency"]) < half
        return float(np.max(power[near] / (density(self.baseline, f[near], self.rate) * self.rate)))

    def _as_popcorn(self) -> float:
        """How far popcorn of the same spectrum would stand out: what tells one from the other tells the other."""
        p = self.effect.parameters
        twin = Effect(
            self.effect.axis,
            "random_telegraph",
            {"amplitude": 2.0 * p["sigma"], "dwell_time": 2.0 * p["correlation_time"]},
        )
        other = Observer(self.world, twin)
        return other.gain() - other._gaussian([*other.baseline, twin])
