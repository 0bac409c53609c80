"""A trial's results as text."""

import io
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table

from .bootstrap import Estimate
from .results import MEAN, Column, Results

TEXT_WIDTH, MAX_NAME_LENGTH = 160, 28  # characters of the file, and of a name before it is folded


def show(results: Results, console: Console) -> None:
    """Print precision by set, then the differences to every baseline."""
    for table in precision(results, console.width):
        console.print(table)
    for other in results.baselines if len(results.rows) > 1 else ():
        console.print()
        for table in differences(results, other, console.width):
            console.print(table)
    console.print(legend(results), style="dim", soft_wrap=True)


def text(results: Results) -> str:
    """The same for a file."""
    out = io.StringIO()
    show(results, Console(file=out, width=TEXT_WIDTH, highlight=False, no_color=True))
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def shown(results: Results) -> list[Column]:
    """Columns of a table: each class by the first measure and their mean, then the mean by the other measures; of a
    single class all of its measures."""
    classes = list(dict.fromkeys(name for name, _ in results.columns if name != MEAN))
    measures = list(dict.fromkeys(measure for _, measure in results.columns))
    if len(classes) == 1:
        return [(classes[0], measure) for measure in measures]
    main = results.main[1]
    return [*((name, main) for name in (*classes, MEAN)), *((MEAN, m) for m in measures if m != main)]


def precision(results: Results, width: int = TEXT_WIDTH) -> list[Table]:
    """Average precision in percent, with intervals, and worth; tables that fit into so many characters."""
    rows = results.rows
    columns = {_head(results, c): [_cell(results.precision(row, c)) for row in rows] for c in shown(results)}
    columns["COCO AP"] = [f"{100 * results.coco[row]['AP']:.1f}" for row in rows]
    known = {row: found for row in rows if row not in results.photographs and (found := results.worth(row))}
    if known:
        words = {row: f"{found.number}\n{found.low}…{found.high}" for row, found in known.items()}
        columns["worth"] = [words.get(row, "") for row in rows]
    return _tables("Average precision in %, tested on real images", rows, columns, width)


def differences(results: Results, other: str, width: int = TEXT_WIDTH) -> list[Table]:
    """Each row less a baseline, in points."""
    rows = [row for row in results.rows if row != other]
    columns = {
        _head(results, c): [_cell(results.difference(row, other, c), sign=True) for row in rows] for c in shown(results)
    }
    return _tables(f"Points more than {other!r}", rows, columns, width)


def legend(results: Results) -> str:
    """What the figures are of."""
    counts = results.counts
    return (
        f"{counts['test_images']} test images, {counts['seeds']} seeds, {results.budget} for every set. Below each "
        f"figure its 95 % interval: {counts['resamples']:,} resamples of test images and seeds, the same for all sets. "
        "* marks a difference whose interval excludes 0. Worth: as many labelled photographs alone reach the same mean."
    )


def _head(results: Results, column: Column) -> str:
    name, measure = column
    if len({name for name, _ in results.columns}) == 2:  # one class, and the mean, which is the same
        return measure
    return name if measure == results.main[1] else f"{name}, {measure}"


def _tables(title: str, rows: Sequence[str], columns: Mapping[str, list[str]], width: int) -> list[Table]:
    """As many columns side by side as fit, the rest in further tables."""
    lead = min(MAX_NAME_LENGTH, max(len(row) for row in (*rows, "set")))
    tables, left = [], 0
    for head, cells in columns.items():
        wide = 3 + max(len(line) for text in (head, *cells) for line in text.split("\n"))
        if wide > left:
            table = Table(title=None if tables else title, title_justify="left", pad_edge=False)
            table.add_column("set", width=lead, overflow="fold")
            tables.append((table, {}))
            left = width - lead - 3
        tables[-1][1][head] = cells
        left -= wide
    for table, some in tables:
        for head in some:
            table.add_column(head, justify="right", no_wrap=True)
        for i, row in enumerate(rows):
            table.add_row(row, *(cells[i] for cells in some.values()))
    return [table for table, _ in tables]


def _cell(value: Estimate, sign: bool = False) -> str:
    figure, low, high = (f"{100 * v + 0.0:+.1f}" if sign else f"{100 * v:.1f}" for v in value[:3])
    star = "*" if sign and (value.low > 0 or value.high < 0) else ""
    return f"{figure}{star}\n{low}…{high}"
