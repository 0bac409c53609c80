"""What made a file, for its record."""

import probscene
from probscene.renderers.engine_choice import engine_version


def versions_record() -> dict[str, str]:
    """The version of the library, and the name and version of the engine that compiles its kernels."""
    return {"version": probscene.__version__, "engine": engine_version()}
