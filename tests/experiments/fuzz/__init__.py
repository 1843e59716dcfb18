"""Fuzz every reader of external bytes or text: ``python -m tests.experiments.fuzz``.

See ``docs/measurements/fuzzing.md``.

A target is a function of bytes in ``tests/experiments/fuzz/targets``, marked with ``@target``. It passes the bytes to
one reader and raises an exception if the reader violates a condition. Examples are an exception that the docstring of
the reader does not name, an impossible value, or a result that depends on how the bytes are divided. ``limits`` adds
the limits of processor time, memory and warnings. atheris generates inputs guided by coverage if the extra ``fuzz`` is
installed. Otherwise ``mutations`` generates random inputs. Inputs that caused a fault are stored in
``tests/experiments/cases/fuzz/<target>/`` and repeated in every run of the tests.
"""
