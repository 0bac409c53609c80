"""Numbers that a person gives, checked; without what takes long to import."""

from probscene.errors import ProbsceneError


def checked_seed(seed: int) -> int:
    """A seed of 0 or more.

    Raises:
        ProbsceneError: it is negative.
    """
    if seed < 0:
        raise ProbsceneError(f"Expected a seed of 0 or more, actual {seed}.")
    return seed


def positive(number: int, what: str) -> int:
    """A number of 1 or more.

    Args:
        what: is counted, for the message.

    Raises:
        ProbsceneError: it is 0 or negative.
    """
    if number < 1:
        raise ProbsceneError(f"Expected a positive number of {what}, actual {number}.")
    return number
