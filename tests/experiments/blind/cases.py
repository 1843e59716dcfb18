"""Cases of the blind trials: recordings with hidden effects, baseline models and truths.

The name of a case says what is hidden. Examples are a single effect (``sinusoidal``), two effects on one axis
(``bias_step@same+outliers``), two effects on two axes (``sinusoidal+bias_step``), no effect (``null``) and an effect
without a name (``foreign:chirp``). The same name, level, seed and length give the same case.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import numpy as np

from tests.experiments.blind import foreign
from tests.experiments.blind.levels import (
    NotIdentifiable,
    draw_size_target,
    scale_size,
    set_line_amplitudes,
    set_size_for_level,
)
from tests.experiments.blind.oracle import Gains
from tests.experiments.blind.processes import Floats
from tests.experiments.blind.recipes import RECIPES, log_uniform
from tests.experiments.blind.sensors import (
    draw_sensor,
    perturb_baseline,
    with_lines,
    with_temperature,
    with_vibration,
    without_term,
)
from tests.experiments.blind.world import AXES, Effect, ForeignEffect, World, model_text

SINGLES: Final = tuple(RECIPES)
FOREIGN: Final = tuple(f"foreign:{name}" for name in foreign.NAMES)
PAIRS: Final = (
    "sinusoidal+bias_step",
    "sinusoidal@same+outliers",
    "sinusoidal@same+narrowband",
    "sinusoidal@same+rate_random_walk",
    "sinusoidal+cross_axis",
    "narrowband+temperature_bias",
    "narrowband@same+rate_ramp",
    "narrowband@same+exponentially_correlated",
    "exponentially_correlated+random_telegraph",
    "exponentially_correlated@same+temperature_bias",
    "exponentially_correlated@same+outliers",
    "exponentially_correlated@same+bias_step",
    "random_telegraph@same+sinusoidal",
    "random_telegraph+rate_ramp",
    "poisson_steps+temperature_lag",
    "bias_step@same+noise_step",
    "bias_step@same+outliers",
    "noise_step+g_sensitivity",
    "temperature_bias@same+sinusoidal",
    "temperature_lag@same+outliers",
    "turn_on_transient@same+narrowband",
    "turn_on_transient+resolution",
    "rate_ramp@same+resolution",
    "bandwidth_limit+sample_hold",
    "scale_factor+saturation",
    "sample_rate_error+bias_step",
    "cross_axis+quantization_noise",
)
MAX_DRAWS: Final = 6  # draws of a sensor and an effect before a case is given up


@dataclass(frozen=True)
class Case:
    """Recording with its baseline model and the truth for the scorer."""

    name: str
    columns: Mapping[str, Floats]  # in SI units and °C
    rate_hz: float
    model: str  # TOML
    truth: Mapping[str, Any]

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write ``recording.npz`` and ``model.toml``, but not the truth, to a folder and return their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        recording, model = folder / "recording.npz", folder / "model.toml"
        np.savez(recording, fs=np.float64(self.rate_hz), **dict(self.columns))  # type: ignore[arg-type]
        model.write_text(self.model)
        return recording, model

    def truth_json(self) -> str:
        """Return the truth as JSON."""
        return json.dumps(self.truth)


@dataclass
class _Plan:
    """Sensor and hidden effects of a case that is being built."""

    world: World
    rng: np.random.Generator
    level: str
    sizes: tuple[float, float] | None
    factor: float = 1.0
    truths: list[dict[str, Any]] = field(default_factory=list)


def make_case(
    name: str,
    level: str = "plain",
    seed: int = 0,
    *,
    seconds: float = 3600.0,
    rate: float = 100.0,
    axes: int = 6,
    baseline: str = "exact",
    sizes: tuple[float, float] | None = None,
) -> Case:
    """Make one case.

    Parameters
    ----------
    name
        Name of the case.
    level
        "plain" or "faint".
    seed
        Seed of the sensor and of all random numbers.
    seconds, rate
        Length in seconds and stated sample rate in Hz.
    axes
        Number of axes, counted from gx.
    baseline
        "exact", or "off" for N, B and K that are 5 % too large or too small.
    sizes
        Range of the factor on the size, which is drawn evenly on a logarithmic scale. None is the size of the level.
    """
    entropy = [crc32(name.encode()), crc32(level.encode()), seed]
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
    for redrawn in range(MAX_DRAWS):
        plan = _Plan(draw_sensor(rng, seconds, rate, AXES[:axes]), rng, level, sizes)
        try:
            _add_effects(plan, name)
            break
        except NotIdentifiable:
            if redrawn == MAX_DRAWS - 1:
                raise
    world = plan.world
    known_baseline = world.baseline if baseline == "exact" else perturb_baseline(world.baseline, rng)
    truth = {
        "case": name,
        "level": level,
        "size": plan.factor,
        "seed": seed,
        "seconds": seconds,
        "rate": rate,
        "axes": list(world.axes),
        "baseline": baseline,
        "redrawn": redrawn,
        "hidden": plan.truths,
        "foreign": [asdict(effect) for effect in world.foreign_effects],
    }
    return Case(name, world.recording(), rate, model_text(known_baseline, rate), truth)


def _add_effects(plan: _Plan, name: str) -> None:
    if name.startswith("foreign:"):
        _add_foreign_effect(plan, name.removeprefix("foreign:"))
    elif name != "null":
        _hide(plan, name)


def _add_foreign_effect(plan: _Plan, name: str) -> None:
    if name in foreign.NEEDS_TEMPERATURE:
        plan.world = with_temperature(plan.world, plan.rng)
    effect = ForeignEffect(str(plan.rng.choice(plan.world.axes)), name)
    plan.world = replace(plan.world, foreign_effects=(effect,))


def _hide(plan: _Plan, name: str) -> None:
    """Draw the effects of a case, search their sizes, and add them to the sensor.

    The size of each effect of a pair holds for a model that contains the other effect, so the first size is searched
    twice.
    """
    drawn: list[Effect] = []
    for effect_name in name.replace("@same", "").split("+"):
        drawn.append(_draw(plan, effect_name, drawn, same="@same" in name))
    targets = [draw_size_target(plan.world, plan.rng, effect, plan.level) for effect in drawn]
    hidden: dict[int, tuple[Effect, Gains]] = {}
    for _ in drawn:
        for k, effect in enumerate(drawn):
            others = tuple(other for j, (other, _) in hidden.items() if j != k)
            known = replace(plan.world, baseline=(*plan.world.baseline, *others))
            if targets[k].lines:
                plan.world, gains = set_line_amplitudes(plan.world, targets[k].gain)
                hidden[k] = effect.sized(ratio=targets[k].size), gains
            else:
                hidden[k] = set_size_for_level(known, effect, targets[k])
    if plan.sizes is not None:
        plan.factor = log_uniform(plan.rng, *plan.sizes)
        for k in hidden:
            others = tuple(other for j, (other, _) in hidden.items() if j != k)
            known = replace(plan.world, baseline=(*plan.world.baseline, *others))
            if targets[k].lines:
                plan.world, gains = set_line_amplitudes(plan.world, targets[k].gain * plan.factor**2)
                hidden[k] = hidden[k][0], gains
            else:
                hidden[k] = scale_size(known, hidden[k][0], plan.factor)
    plan.truths = [_describe_truth(*hidden[k]) for k in range(len(drawn))]
    plan.world = plan.world.with_hidden(*(effect for effect, _ in hidden.values()))


def _draw(plan: _Plan, name: str, before: list[Effect], same: bool) -> Effect:
    recipe, rng = RECIPES[name], plan.rng
    possible = [axis for axis in plan.world.axes if not recipe.gyros_only or axis in AXES[:3]]
    if before:
        possible = [axis for axis in possible if (axis == before[0].axis) == same]
    axis = str(rng.choice(possible))
    if recipe.needs == "temperature":
        plan.world = with_temperature(plan.world, rng)
    elif recipe.needs == "lines":
        plan.world = with_lines(plan.world, rng)
    elif recipe.needs in RECIPES:
        plan.world = without_term(plan.world, axis, recipe.needs)
    effect = Effect(axis, name, recipe.draw(rng, plan.world, axis))
    if recipe.needs == "shaking source":
        plan.world = with_vibration(plan.world, rng, effect.parameters["source"])
    return effect


def _describe_truth(effect: Effect, gains: Gains) -> dict[str, Any]:
    """Return the entry of a hidden effect in the truth."""
    return {
        "axis": effect.axis,
        "effect": effect.name,
        "parameters": dict(effect.parameters),
        "gain": gains.over_baseline,
        "margin": gains.over_wrong,
        "wrong": gains.wrong,
    }
