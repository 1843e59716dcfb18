"""Effects that no name of the vocabulary stands for: a report about them must say so, not give the nearest name.

``SERIES`` add to the rate; ``LEVELS`` multiply the white noise. ``size`` is in units of the white noise of a sample,
so that one number serves gyroscopes and accelerometers. ``HONEST`` lists names that are nevertheless right: two
correlated noises may be found as two, and a bias that follows (T − T_r)² as a temperature bias whose quadratic
coefficient is given.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from tests.experiments.blind.processes import Clock, Floats, exponentially_correlated, shaped


def chirp(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """A line that sweeps from 4 to 20 Hz over the recording."""
    seconds = clock.n / clock.rate_hz
    phase = 2.0 * np.pi * (4.0 * clock.t_s + 8.0 * clock.t_s**2 / seconds)
    return 0.25 * size * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi))


def plateau(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """As strong as white noise from 5 to 10 Hz, and nothing elsewhere."""
    return shaped(clock, rng, lambda f: np.where((f > 5.0) & (f < 10.0), size**2 / clock.rate_hz, 0.0))


def amplitude_modulated_line(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """A line of 11.7 Hz that swells and fades every 50 s."""
    swell = 1.0 + 0.8 * np.sin(2.0 * np.pi * clock.t_s / 50.0)
    return 0.15 * size * swell * np.sin(2.0 * np.pi * 11.7 * clock.t_s + rng.uniform(0.0, 2.0 * np.pi))


def quadratic_temperature(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """A bias that follows (T − mean)² and not T."""
    if clock.temperature_c is None:
        raise ValueError("quadratic_temperature needs a temperature")
    away = clock.temperature_c - clock.temperature_c.mean()
    square = away**2
    square -= square.mean() + away * float(np.dot(square - square.mean(), away) / np.dot(away, away))
    return np.asarray(0.4 * size * square / square.std())


def sawtooth(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """A slope that falls back every 2.7 s: a counter that leaks."""
    return 0.4 * size * (np.mod(clock.t_s / 2.7 + rng.uniform(0.0, 1.0), 1.0) - 0.5)


def two_correlated(clock: Clock, rng: np.random.Generator, size: float) -> Floats:
    """Correlated noise of 0.5 s and of 40 s."""
    fast, slow = (exponentially_correlated(clock, rng, 1.0, time_s) for time_s in (0.5, 40.0))
    return 0.4 * size * (fast + slow)


SERIES: Final[dict[str, Callable[[Clock, np.random.Generator, float], Floats]]] = {
    function.__name__: function
    for function in (
        chirp,
        plateau,
        amplitude_modulated_line,
        quadratic_temperature,
        sawtooth,
        two_correlated,
    )
}


def bursts(clock: Clock, rng: np.random.Generator) -> Floats:
    """Three times the noise for four seconds, about every five minutes."""
    seconds = clock.n / clock.rate_hz
    gain = np.ones(clock.n)
    for begin_s in rng.uniform(0.0, seconds - 4.0, max(3, round(seconds / 300.0))):
        gain[round(begin_s * clock.rate_hz) : round((begin_s + 4.0) * clock.rate_hz)] = 3.0
    return gain


def laplace(clock: Clock, rng: np.random.Generator) -> Floats:
    """Laplace's distribution with the variance of the Gaussian: the root of an exponential in front of it."""
    return np.sqrt(rng.exponential(1.0, clock.n))


LEVELS: Final[dict[str, Callable[[Clock, np.random.Generator], Floats]]] = {
    function.__name__: function for function in (bursts, laplace)
}

NAMES: Final = (*SERIES, *LEVELS)
NEEDS_TEMPERATURE: Final = ("quadratic_temperature",)
HONEST: Final = {"two_correlated": ("exponentially_correlated",), "quadratic_temperature": ("temperature_bias",)}
