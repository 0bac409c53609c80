"""What a fit says of lists at its end."""

from ..fitting.run import RunFolder
from ..progress import Display
from .evaluate import network_counts
from .saturated_lists import SaturatedList, saturated_lists, sentences


def tell(run: RunFolder, show: Display) -> None:
    """Warn of each list that a finished run has filled up to its end."""
    for text in sentences(too_short(run, show)):
        show.say(text)


def too_short(run: RunFolder, show: Display) -> tuple[SaturatedList, ...]:
    """The lists that are too short for the run's own target, by its guide and by what its network has counted."""
    return saturated_lists(run.model, run.guide, network_counts(run, None, show))
