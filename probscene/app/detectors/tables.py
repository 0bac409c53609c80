"""What was trained and what was found, as text."""

import numpy as np
from rich.console import Console
from rich.table import Table

from .folder import TrainedDetector
from .predict import Predictions


def show_scores(trained: TrainedDetector, console: Console) -> None:
    """Print how good a detector is on held-out photographs; nothing where there were none."""
    scores = trained.scores
    if scores is None:
        return
    table = Table(title=f"Tested on {scores['images']} held-out photographs", title_justify="left", pad_edge=False)
    table.add_column("class")
    table.add_column("objects", justify="right")
    for measure in scores["precision"]:
        table.add_column(f"{measure} in %", justify="right")
    names = next(iter(scores["precision"].values()))
    for name in names:
        objects = scores["objects"].get(name, sum(scores["objects"].values()))
        table.add_row(name, str(objects), *(_percent(of[name]) for of in scores["precision"].values()))
    console.print(table)
    console.print("With 95 % intervals of a bootstrap over these photographs.", style="dim", soft_wrap=True)


def show_predictions(found: Predictions, console: Console) -> None:
    """Print how many objects of each class were found, and what is worth labelling next."""
    table = Table(title=f"{len(found.images)} photographs", title_justify="left", pad_edge=False)
    for head in ("class", "objects", "photographs with any"):
        table.add_column(head, justify="left" if head == "class" else "right")
    for c, name in enumerate(found.classes):
        number = np.array([(each.classes == c).sum() for each in found.found])
        table.add_row(name, str(number.sum()), str((number > 0).sum()))
    console.print(table)
    console.print(f"Scores are at least {found.min_score:.3g}, {found.reason}.", soft_wrap=True)
    if found.label_next:
        console.print(f"Worth labelling next: {', '.join(found.label_next)}", markup=False, soft_wrap=True)


def _percent(figure: dict[str, float | None]) -> str:
    if figure["value"] is None:
        return "no objects"
    words = f"{100 * figure['value']:.1f}"
    if figure["low"] is None or figure["high"] is None:
        return words
    return f"{words} ({100 * figure['low']:.1f}…{100 * figure['high']:.1f})"
