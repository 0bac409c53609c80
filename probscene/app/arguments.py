"""Numbers that a person gives, checked; without what takes long to import."""

from collections.abc import Mapping

from probscene.errors import ProbsceneError

BoxMargin = int | str | Mapping[str, int]
"""Pixels by which boxes are wider on each side: of all classes, or by class, as ``"plate=2,mug=4"`` or a mapping; other
classes' are not."""


def checked_seed(seed: int) -> int:
    """A seed of 0 or more.

    Raises:
        ProbsceneError: it is negative.
    """
    if seed < 0:
        raise ProbsceneError(f"expected a seed of 0 or more, got {seed}.")
    return seed


def positive(number: int, what: str) -> int:
    """A number of 1 or more.

    Args:
        what: is counted, for the message.

    Raises:
        ProbsceneError: it is 0 or negative.
    """
    if number < 1:
        raise ProbsceneError(f"expected a positive number of {what}, got {number}.")
    return number


def number_or_all(text: str, what: str) -> int | None:
    """A number that was typed, or None for the word ``all``.

    Args:
        what: is counted, for the message.

    Raises:
        ProbsceneError: it is neither.
    """
    if text == "all":
        return None
    if not text.isascii() or not text.isdigit():
        raise ProbsceneError(f"expected a number of {what}, or all, got {text!r}.")
    return int(text)


def range_given(text: str | None) -> tuple[float, float] | None:
    """Two numbers that were typed with a comma between them; None where nothing was.

    Raises:
        ProbsceneError: it is something else.
    """
    if text is None:
        return None
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        raise ProbsceneError(f"expected --range LOW,HIGH such as 0,4095, got {text!r}.") from None
    return low, high


def words_given(text: str) -> list[str]:
    """Words that were typed with commas between them."""
    return [word.strip() for word in text.split(",") if word.strip()]


def size_given(text: str | None) -> tuple[int, int] | None:
    """Height and width of a size that was typed, WIDTHxHEIGHT; None where nothing was.

    Raises:
        ProbsceneError: it is something else.
    """
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ProbsceneError(f"expected a size WIDTHxHEIGHT such as 256x192, got {text!r}.")
    return int(height), int(width)


def checked_box_margin(margin: BoxMargin) -> int | dict[str, int]:
    """A margin as a number, or by class.

    Raises:
        ProbsceneError: it is not a whole number of pixels, 0 or more; two of one class.
    """
    if isinstance(margin, str):
        return _pixels(margin) if "=" not in margin else _margins_given(margin)
    if isinstance(margin, Mapping):
        return {name: _pixels(each) for name, each in margin.items()}
    return _pixels(margin)


def margin_text(margin: Mapping[str, int]) -> str:
    """As ``--box-margin`` takes it."""
    return ",".join(f"{name}={pixels}" for name, pixels in margin.items())


def _margins_given(text: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for part in text.split(","):
        name, _, pixels = (word.strip() for word in part.rpartition("="))
        if not name or name in found:
            raise ProbsceneError(
                f"expected box_margin as pixels, or once for each class as in plate=2,mug=4, got {text!r}."
            )
        found[name] = _pixels(pixels)
    return found


def _pixels(pixels: int | str) -> int:
    try:
        number = float(pixels)
    except ValueError:
        number = -1.0
    if not (number >= 0 and number % 1 == 0):
        raise ProbsceneError(f"expected box_margin as a whole number of pixels, 0 or more, got {pixels}.")
    return int(number)
