"""Fuzz every reader of external bytes or text: ``python -m tests.experiments.fuzz``. See ``docs/fuzzing.md``.

A target is one function of bytes in ``tests/experiments/fuzz/targets``, marked with ``@target``. It hands them to one
reader and raises where the reader broke its word: an exception that its docstring does not name, a value that is no
measurement, another result for another cut of the same bytes. ``limits`` adds what holds for all of them: processor
time, memory, no warning. Inputs come from atheris, guided by coverage, where it is installed (extra ``fuzz``), else
from ``mutations``. What was found is kept as a file in ``tests/experiments/cases/fuzz/<target>/`` and tried in every
run of the tests.
"""
