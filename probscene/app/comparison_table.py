"""A comparison as one table of text."""

import textwrap

from rich.console import Console
from rich.table import Table

from probscene.app.compare import ESTIMATE, Comparison
from probscene.app.likelihood import Likelihood
from probscene.app.tables import FOOTNOTE, NAMES

WIDEST = 1000  # characters
WORDS = {"truth": "the truth", "estimate": "what the feature network sees *"}


def show(comparison: Comparison, console: Console) -> None:
    """Print it as wide as it is: a narrow terminal wraps its lines, a file has them whole."""
    table = made(comparison)
    whole = Console(width=WIDEST).measure(table).maximum
    Console(file=console.file, width=max(console.width, whole), highlight=False).print(table)
    if comparison.reference == ESTIMATE:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)
    for note in comparison.notes:
        console.print(f"Labels: {note}", style="dim", soft_wrap=True)


def made(comparison: Comparison) -> Table:
    """A column for each source; in each cell the total variation to the reference, and the mean in brackets."""
    reference = comparison.reference
    what = "Means" if reference is None else f"Total variation to {WORDS[reference]}, and (means)"
    table = Table(title=what, title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    for name in comparison.sources:
        table.add_column(textwrap.fill(NAMES.get(name, name), 16), justify="right", no_wrap=True)
    rows = comparison.rows()
    if len(comparison.classes) > 1:
        rows.insert(1 + len(comparison.classes), comparison.shares_of_classes())
    for row in rows:
        cells = (_cell(row.apart.get(name), row.means.get(name)) for name in comparison.sources)
        table.add_row(row.label, *cells)
    if comparison.likelihoods:
        table.add_section()
        found = (comparison.likelihoods.get(name) for name in comparison.sources)
        table.add_row("log q of the truth, nats", *("" if one is None else _nats(one) for one in found))
    return table


def _cell(apart: float | None, mean: float | None) -> str:
    said = [] if apart is None else [f"{apart:.3f}"]
    return " ".join(said + ([] if mean is None else [f"({mean:.2f})"])) or "-"


def _nats(found: Likelihood) -> str:
    return "-inf" if found.impossible else f"{found.nats.value:.2f}"
