"""Recordings with something hidden in them, baseline models, and truths.

A case is named by what is hidden: an effect (``sinusoidal``), a pair (``bias_step@same+outliers``: on one axis; with
``+`` alone on two), ``null``, or ``foreign:chirp``. The same name, level, seed and length give the same case.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import numpy as np

from tests.experiments.blind import foreign
from tests.experiments.blind.levels import NotIdentifiable, aim, at_level, at_multiple, size_lines
from tests.experiments.blind.oracle import Gains
from tests.experiments.blind.processes import Floats
from tests.experiments.blind.recipes import RECIPES, log_uniform
from tests.experiments.blind.sensors import off, sensor, with_lines, with_shaking, with_temperature, without_term
from tests.experiments.blind.world import AXES, Effect, Foreign, World, model_text

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
REDRAWS: Final = 6  # sensors and shapes tried before a case is given up; how many were needed stands in the truth


@dataclass(frozen=True)
class Case:
    """A recording, its baseline model, and what only the scorer may know."""

    name: str
    columns: Mapping[str, Floats]  # SI, and °C
    rate_hz: float
    model: str  # TOML
    truth: Mapping[str, Any]

    def write(self, folder: Path) -> tuple[Path, Path]:
        """``recording.npz`` and ``model.toml`` in a folder; the truth is not among them."""
        folder.mkdir(parents=True, exist_ok=True)
        recording, model = folder / "recording.npz", folder / "model.toml"
        np.savez(recording, fs=np.float64(self.rate_hz), **dict(self.columns))  # type: ignore[arg-type]
        model.write_text(self.model)
        return recording, model

    def truth_json(self) -> str:
        """For a file kept elsewhere."""
        return json.dumps(self.truth)


@dataclass
class _Plan:
    """A case in the making."""

    world: World
    rng: np.random.Generator
    level: str
    sizes: tuple[float, float] | None
    factor: float = 1.0
    told: list[dict[str, Any]] = field(default_factory=list)


def case(
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

    Args:
        name: what is hidden
        level: plain or faint
        seed: another sensor, other draws
        seconds, rate: length and stated sample rate (Hz) of the recording
        axes: 6, or fewer counted from gx
        baseline: exact, or off: N, B and K 5 % too large or too small
        sizes: range of the multiple of the level's size, drawn evenly on a logarithmic scale; None for the level itself
    """
    entropy = [crc32(name.encode()), crc32(level.encode()), seed]
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
    for redrawn in range(REDRAWS):
        plan = _Plan(sensor(rng, seconds, rate, AXES[:axes]), rng, level, sizes)
        try:
            _fill(plan, name)
            break
        except NotIdentifiable:
            if redrawn == REDRAWS - 1:
                raise
    world = plan.world
    told_baseline = world.baseline if baseline == "exact" else off(world.baseline, rng)
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
        "hidden": plan.told,
        "foreign": [asdict(one) for one in world.strangers],
    }
    return Case(name, world.recording(), rate, model_text(told_baseline, rate), truth)


def _fill(plan: _Plan, name: str) -> None:
    if name.startswith("foreign:"):
        _add_stranger(plan, name.removeprefix("foreign:"))
    elif name != "null":
        _hide(plan, name)


def _add_stranger(plan: _Plan, name: str) -> None:
    if name in foreign.NEEDS_TEMPERATURE:
        plan.world = with_temperature(plan.world, plan.rng)
    stranger = Foreign(str(plan.rng.choice(plan.world.axes)), name)
    plan.world = replace(plan.world, strangers=(stranger,))


def _hide(plan: _Plan, name: str) -> None:
    """Draw effects of a name, give them sizes, put them in.

    Of a pair each is as large as its level asks for where the model has the other already; so the first is sized twice.
    """
    drawn: list[Effect] = []
    for each in name.replace("@same", "").split("+"):
        drawn.append(_draw(plan, each, drawn, same="@same" in name))
    aims = [aim(plan.world, plan.rng, effect, plan.level) for effect in drawn]
    hidden: dict[int, tuple[Effect, Gains]] = {}
    for _ in drawn:
        for k, effect in enumerate(drawn):
            others = tuple(other for j, (other, _) in hidden.items() if j != k)
            known = replace(plan.world, baseline=(*plan.world.baseline, *others))
            if aims[k].lines:
                plan.world, gains = size_lines(plan.world, aims[k].target)
                hidden[k] = effect.sized(ratio=aims[k].size), gains
            else:
                hidden[k] = at_level(known, effect, aims[k])
    if plan.sizes is not None:
        plan.factor = log_uniform(plan.rng, *plan.sizes)
        for k in hidden:
            others = tuple(other for j, (other, _) in hidden.items() if j != k)
            known = replace(plan.world, baseline=(*plan.world.baseline, *others))
            if aims[k].lines:
                plan.world, gains = size_lines(plan.world, aims[k].target * plan.factor**2)
                hidden[k] = hidden[k][0], gains
            else:
                hidden[k] = at_multiple(known, hidden[k][0], plan.factor)
    plan.told = [_told(*hidden[k]) for k in range(len(drawn))]
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
        plan.world = with_shaking(plan.world, rng, effect.parameters["source"])
    return effect


def _told(effect: Effect, gains: Gains) -> dict[str, Any]:
    """For the truth."""
    return {
        "axis": effect.axis,
        "effect": effect.name,
        "parameters": dict(effect.parameters),
        "gain": gains.over_baseline,
        "margin": gains.over_wrong,
        "wrong": gains.wrong,
    }
