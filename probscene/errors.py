"""One family of errors: every fault that a person can fix is a ``ProbsceneError`` with one clear message.

A message says what was expected, what came, and what to do. The command line prints it without a traceback and exits
with ``exit_code``: 2 where the input is at fault, 1 where the machine is.
"""


class ProbsceneError(Exception):
    """The input is at fault; the message says how to fix it."""

    exit_code = 2


class GrammarError(ProbsceneError):
    """A grammar, or a distribution over its derivations, is malformed."""


class ModelError(ProbsceneError):
    """A scene model does not import, exports nothing, or draws something that cannot be rendered."""


class GeneratorError(ProbsceneError):
    """A model's generator does not start, or cannot draw a scene."""


class DataError(ProbsceneError):
    """A folder of images, or a file in it, cannot be used."""


class RunError(ProbsceneError):
    """A run folder is missing, incomplete, or was written by another version."""


class SamplingError(ProbsceneError):
    """A policy hardly ever finishes a derivation within ``max_steps``."""


class MachineError(ProbsceneError):
    """The machine is at fault: a full disk, an unwritable folder."""

    exit_code = 1
