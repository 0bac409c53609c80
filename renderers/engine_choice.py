"""Which engine compiles the kernels: Taichi, or its fork Quadrants, which gives the same bytes."""

import os
from importlib.metadata import version
from importlib.util import find_spec

from probscene.errors import MachineError, ProbsceneError

ENGINES = ("taichi", "quadrants")
VARIABLE = "PROBSCENE_ENGINE"


def engine_name() -> str:
    """What ``PROBSCENE_ENGINE`` says; where it is not set, the first of ``ENGINES`` that is installed.

    Raises:
        ProbsceneError: it says something else.
        MachineError: the engine that it names, or any if it is not set, is not installed.
    """
    named = os.environ.get(VARIABLE)
    if named and named not in ENGINES:
        raise ProbsceneError(
            f"expected {' or '.join(ENGINES)} in the variable {VARIABLE}, got {named!r}; correct it, or unset it."
        )
    wanted = (named,) if named else ENGINES
    for name in wanted:
        if find_spec(name) is not None:
            return name
    other = f", or unset {VARIABLE}" if named else ""
    raise MachineError(
        f"expected the package {' or '.join(wanted)}, which draws images, got none; pip install {wanted[0]}{other}."
    )


def engine_version() -> str:
    """The engine's name and version, such as ``taichi 1.7.4``; see ``engine_name`` for errors."""
    name = engine_name()
    return f"{name} {version(name)}"
