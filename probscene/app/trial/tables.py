"""A trial's results as text."""

import io

from rich.console import Console
from rich.table import Table

from .bootstrap import Estimate
from .results import MEAN, Column, Results

WIDE = 160  # characters of the file


def show(results: Results, console: Console) -> None:
    """Print precision by set, then the differences to every baseline."""
    console.print(precision(results))
    for other in results.baselines:
        if len(results.rows) > 1:
            console.print()
            console.print(differences(results, other))
    console.print(legend(results), style="dim", soft_wrap=True)


def text(results: Results) -> str:
    """The same for a file."""
    out = io.StringIO()
    show(results, Console(file=out, width=WIDE, highlight=False, no_color=True))
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def shown(results: Results) -> list[Column]:
    """Columns of a table: each class by the first measure and their mean, then the mean by the other measures; of a
    single class all of its measures."""
    classes = list(dict.fromkeys(name for name, _ in results.columns if name != MEAN))
    measures = list(dict.fromkeys(measure for _, measure in results.columns))
    if len(classes) == 1:
        return [(classes[0], measure) for measure in measures]
    first = [(name, measures[0]) for name in (*classes, MEAN)]
    return [*first, *((MEAN, measure) for measure in measures[1:])]


def precision(results: Results) -> Table:
    """Average precision in percent, with intervals, and worth."""
    columns = shown(results)
    table = _table(results, columns, "Average precision in %, tested on real images")
    worth = any(results.worth(row) for row in results.rows)
    table.add_column("COCO AP", justify="right", no_wrap=True)
    if worth:
        table.add_column("worth", justify="right", no_wrap=True)
    for row in results.rows:
        cells = [_cell(results.precision(row, column)) for column in columns]
        cells.append(f"{100 * results.coco[row]['AP']:.1f}")
        if worth and (known := results.worth(row)):
            cells.append(f"{known.number}\n{known.low}…{known.high}" if row not in results.photographs else "")
        table.add_row(row, *cells)
    return table


def differences(results: Results, other: str) -> Table:
    """Each row less a baseline, in points."""
    columns = shown(results)
    table = _table(results, columns, f"Points more than {other!r}")
    for row in results.rows:
        if row != other:
            table.add_row(row, *(_cell(results.difference(row, other, column), sign=True) for column in columns))
    return table


def legend(results: Results) -> str:
    """What the figures are of."""
    counts = results.counts
    return (
        f"{counts['test_images']} test images, {counts['seeds']} seeds, {results.budget} for every set. Below each "
        f"figure its 95 % interval: {counts['resamples']:,} resamples of test images and seeds, the same for all sets. "
        "An * marks a difference whose interval leaves out 0. Worth: as many labelled photographs alone reach the mean."
    )


def _table(results: Results, columns: list[Column], title: str) -> Table:
    table = Table(title=title, title_justify="left", show_lines=False, pad_edge=False)
    table.add_column("set", overflow="fold")
    single = len({name for name, _ in results.columns}) == 2
    first = results.columns[0][1]
    for name, measure in columns:
        head = measure if single else name if measure == first else f"{name}, {measure}"
        table.add_column(head, justify="right", no_wrap=True)
    return table


def _cell(value: Estimate, sign: bool = False) -> str:
    figure, low, high = (f"{100 * v + 0.0:+.1f}" if sign else f"{100 * v:.1f}" for v in value[:3])
    star = "*" if sign and (value.low > 0 or value.high < 0) else ""
    return f"{figure}{star}\n{low}…{high}"
