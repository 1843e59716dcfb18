"""Tests of the direction of leaks, with axes whose noise has different spectra, and with leaks in the model."""

from math import log

import numpy as np
import pytest

from monitor.noise.effects import CrossAxis
from monitor.reconcile.diagnostics.null_distribution import AxisNull
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_fewest_changes
from monitor.reconcile.search.leak_direction import (
    _describe_leak,
    add_opposite_leaks_as_alternatives,
    find_leaks_in_wrong_direction,
)
from monitor.reconcile.search.search import AxisSearchResult, search_missing_effects
from tests.monitor.reconcile.axes import MODEL, RATE_HZ, TERMS, WALK, WHITE, axes, make_null, white

n = 20_000


def search_both_axes(values, effects, seed=0) -> tuple[dict[str, AxisSearchResult], dict[str, AxisNull]]:
    prepared = axes(values, effects)
    null = {name: make_null(n) for name in values}
    rng = np.random.default_rng(seed)
    return {name: search_missing_effects(one, effects[name], null[name], rng) for name, one in prepared.items()}, null
