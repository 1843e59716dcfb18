"""Kernels are compiled before the first test: processes that tests start find them on disk, as on any later start.

A thread that identifies a drift ends with its test: pytest and SciPy both set filters of warnings, which are the whole
process's, so that one beyond its test would meet those of the next.
"""

import threading
from collections.abc import Iterator

import pytest

from monitor.drift import compensator, heat
from monitor.estimate.estimator import warm_up


@pytest.fixture(scope="session", autouse=True)
def _kernels() -> None:
    assert list(warm_up()) == ["window", "fit", "all"]
    heat.warm_up()
    compensator.warm_up()


@pytest.fixture(autouse=True)
def _no_identifier_left() -> Iterator[None]:
    yield
    for thread in threading.enumerate():
        if thread.name.startswith("drift of "):
            thread.join(30.0)
