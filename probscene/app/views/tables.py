"""Evaluations and comparisons as tables of text."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

from probscene.inference.statistics.count_metrics import Histogram, Interval, Tally, bin_ranges, histogram_interval

from ..evaluation.compare import Comparison, Row
from ..evaluation.evaluate import Evaluation
from ..evaluation.image_distances import caveat
from ..evaluation.likelihood import Likelihood
from ..evaluation.sources import ESTIMATE, LEARNT, READ, SAMPLED_SOURCES, START, Source
from ..evaluation.structure_counts import ALL, GROUPS, PARENTS, group_label

if TYPE_CHECKING:
    from probscene.inference.statistics.image_metrics import ImageDistance  # torchmetrics takes seconds to import

NAMES = {START: "initialisation", READ: "read *", ESTIMATE: "estimate *", "floor": "noise floor"}
"""Sources whose names are others on the screen than in records."""
FOOTNOTE = (
    "* An estimate without labels: what the feature network counts in the target's images, rounded; not the truth. It "
    "is compared with what the same network reads in renders."
)
LEGEND = "TV: total variation, 0 to 1. W-1: Wasserstein-1, in objects."

ALL_OBJECTS, SHARES = "all objects", "class shares"
MAX_WIDTH = 1000  # characters
MIN_WIDTH_FOR_INTERVALS = 140  # characters
REFERENCES = {"truth": "the truth", "estimate": "what the feature network reads *"}
FLOOR = (
    "The noise floor is the distance of two halves of the target. FID depends on the number of images, KID does not."
)


def show(evaluation: Evaluation, console: Console) -> None:
    """Print the distances, then the histograms in percent with half the width of their 95 % intervals."""
    spread = console.width >= MIN_WIDTH_FOR_INTERVALS
    more = (*errors(evaluation), *nested(evaluation, spread), *likelihoods(evaluation), *images(evaluation))
    for table in (*distances(evaluation, spread), _numbers(evaluation), _classes(evaluation), *more):
        _print(table, console)
        console.print()
    distances_of_images = (one for of in evaluation.images.values() for found in of.values() for one in found)
    caveats = {caveat(one) for one in distances_of_images} - {""}
    if "estimate" in evaluation.sources:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)
    for line in evaluation.readings:
        console.print(f"Read: {line}", style="dim", soft_wrap=True)
    if evaluation.images:
        console.print(FLOOR, style="dim", soft_wrap=True)
    for note in evaluation.notes:
        console.print(f"Note: {note}", style="dim", soft_wrap=True)
    for note in sorted(caveats):
        console.print(f"Mind: {note}.", style="dim", soft_wrap=True)
    for warning in (*evaluation.kept, *evaluation.warnings):
        console.print(warning, soft_wrap=True)


def distances(evaluation: Evaluation, spread: bool = False) -> list[Table]:
    """``distance_tables`` with the means of every source."""
    measured = evaluation.distances()
    means = {
        b: {
            name: {ALL_OBJECTS: float(source.total.mean())}
            | {kind: found.mean() for kind, found in zip(evaluation.classes, source.kinds, strict=True)}
            for name, source in evaluation.compared_with(b).items()
        }
        for b in measured
    }
    for of_source in means.get(ESTIMATE, {}).values():
        of_source |= dict.fromkeys((ALL_OBJECTS, *evaluation.unread) if evaluation.unread else ())
    return distance_tables(measured, means, spread)


def distance_tables(
    measured: dict[str, Any], means: Mapping[str, Mapping[str, Mapping[str, Any]]] | None = None, spread: bool = False
) -> list[Table]:
    """Distances of prior, initialisation and learnt structures from the truth and from the estimate: a table each, with
    a row for all objects, one for each class's count, and one for the classes' shares.

    Args:
        measured: ``Evaluation.distances()``.
        means: by what is compared with, source and row, where they are to be shown.
        spread: also half the width of the 95 % intervals that are known.
    """
    tables = []
    for b, found in measured.items():
        shown = () if means is None else (*found, b)
        table = _distances(f"Distance to {REFERENCES[b]}", found, shown, "" if tables else LEGEND)
        kinds = {kind: [_both(each["kinds"][kind]) for each in found.values()] for kind in found["learnt"]["kinds"]}
        rows = {ALL_OBJECTS: [(each["number"], each["number_wasserstein"]) for each in found.values()]}
        if len(kinds) > 1:  # one class is all objects
            rows |= kinds | {SHARES: [(each["classes"], None) for each in found.values()]}
        for label, values in rows.items():
            _add(table, label, values, [means[b][name].get(label) for name in shown] if means else [], spread)
        tables.append(table)
    return tables


def _both(found: dict[str, Any] | None) -> tuple[Interval | None, Interval | None]:
    """Total variation and Wasserstein-1 of a record of ``Evaluation.distance``."""
    return (None, None) if found is None else (Interval(**found["total_variation"]), Interval(**found["wasserstein"]))


def _distances(title: str, sources: Iterable[str], shown: Iterable[str], legend: str = "") -> Table:
    """A table with columns of both distances of some sources, and of the means of those that are shown."""
    heads = [f"{what}\n{NAMES.get(name, name)}" for what in ("TV", "W-1") for name in sources]
    table = _table(title, "", [*heads, *(f"mean\n{NAMES.get(name, name)}" for name in shown)])
    if legend:
        table.caption, table.caption_justify = legend, "left"
    return table


def _add(table: Table, label: str, values: list[tuple[Any, Any]], means: list[Any], spread: bool) -> None:
    figures = [pair[i] for i in (0, 1) for pair in values]
    table.add_row(label, *(_figure(x, 3, spread) for x in figures), *(_figure(x, 2, spread) for x in means))


def _numbers(evaluation: Evaluation) -> Table:
    sources = evaluation.shown
    table = _table("Images by number of objects, %", "objects", [NAMES.get(name, name) for name in sources])
    rows = bin_ranges(source.total for source in sources.values())
    firsts = [first for first, _ in rows]
    bins = [np.searchsorted(firsts, source.total, "right") - 1 for source in sources.values()]
    histograms = [histogram_interval(found, len(rows)) for found in bins]
    for k, (first, last) in enumerate(rows):
        label = str(first) if first == last else f"{first} to {last}"
        if first < last and k == len(rows) - 1:
            label = f"{first} or more"
        table.add_row(label, *(_percent(found, k) for found in histograms))
    table.add_section()
    table.add_row("mean", *(f"{source.total.mean():.2f}" for source in sources.values()))
    return table


def _classes(evaluation: Evaluation) -> Table:
    sources = evaluation.shown
    table = _table("Objects by class, %", "class", [NAMES.get(name, name) for name in sources])
    histograms = [source.classes() for source in sources.values()]
    for c, name in enumerate(evaluation.classes):
        table.add_row(name, *(_percent(found, c) for found in histograms))
    return table


def nested_counts(sources: Mapping[str, Source], classes: Sequence[str]) -> dict[str, dict[str, Tally]]:
    """Where kinds nest, the tallies of each source that has such nodes, by the label of what is counted.

    Duplicates are left out: how many parents there are, where they are a class or have been counted below
    their own one parent; the first parent, where no image has a second; the later ones, where there is one alone.
    """
    found: dict[str, dict[str, Tally]] = {}
    whole: list[tuple[str, dict[str, Tally]]] = []
    for relation in dict.fromkeys(r for source in sources.values() for r in source.nested):
        known = {name: source.nested[relation] for name, source in sources.items() if relation in source.nested}
        before = [each for child, each in whole if child == relation[0]]
        for group in GROUPS:
            each = {name: tallies[group] for name, tallies in known.items() if not tallies[group].empty}
            if not each or (group == PARENTS and relation[0] in classes):
                continue
            if not any(_same(each, other) for other in before):
                found.setdefault(group_label(relation, group), each)
            before += [] if group == PARENTS else [each]
            whole += [(relation[1], each)] if group == ALL else []
    return found


def _same(each: dict[str, Tally], other: dict[str, Tally]) -> bool:
    return each.keys() == other.keys() and all(
        np.array_equal(x, y) for name in each for x, y in zip(each[name], other[name], strict=True)
    )


def nested(evaluation: Evaluation, spread: bool = False) -> list[Table]:
    """Where kinds nest: distances of every kind of count from the truth and from the estimate, and its means; without
    either, the means alone.

    Args:
        spread: also half the width of the 95 % intervals.
    """
    tables: list[Table] = []
    title, fitted = "Counts by what they depend on", [name for name in SAMPLED_SOURCES if name in evaluation.sources]
    for b in (name for name in evaluation.sources if name not in SAMPLED_SOURCES):
        table = _distances(f"{title}, distance to {REFERENCES[b]}", fitted, (*fitted, b))
        for name, known in nested_counts(evaluation.compared_with(b), evaluation.classes).items():
            if b in known:
                found = [known[a].distance(known[b]) if a in known else None for a in fitted]
                means = [_mean(known, source) for source in (*fitted, b)]
                _add(table, name, [x or (None, None) for x in found], means, spread)
        if table.row_count:
            tables.append(table)
    rows = nested_counts(evaluation.sources, evaluation.classes)
    if rows and not tables:
        table = _table(f"{title}, means", "", [NAMES.get(name, name) for name in fitted])
        for label, known in rows.items():
            table.add_row(label, *(_figure(_mean(known, name), 2) for name in fitted))
        tables.append(table)
    return tables


def _mean(tallies: dict[str, Tally], name: str) -> Interval | None:
    return tallies[name].mean() if name in tallies else None


def errors(evaluation: Evaluation) -> list[Table]:
    """With labels, the errors of the counts read in each image."""
    if not evaluation.errors:
        return []
    heads = ["mean absolute error", "correlation", "labelled images", "mean of all images, 90 %", "mean of the fit"]
    table = _table("Counts read in each labelled image", "class", heads)
    for name, found in evaluation.errors.items():
        cells = ["-"] * 4
        if found is not None:
            figures, mean = [_figure(x, 2) for x in (found.mean_absolute, found.correlation)], found.mean
            interval = "-" if mean is None else f"{mean.value:.2f} ({mean.low:.2f} to {mean.high:.2f})"
            cells = [*figures, str(found.images), interval]
        learnt = evaluation.sources[LEARNT].counts[:, evaluation.classes.index(name)]
        table.add_row(name, *cells, f"{learnt.mean():.2f}")
    return [table]


def likelihoods(evaluation: Evaluation) -> list[Table]:
    """How likely prior and guide would have derived the truth's structures, where they are known."""
    if not evaluation.likelihoods:
        return []
    table = _table(
        "log q of the labelled structures, nats a scene", "", [NAMES.get(name, name) for name in evaluation.likelihoods]
    )
    table.add_row("mean", *map(_nats, evaluation.likelihoods.values()))
    return [table]


def _nats(found: Likelihood) -> str:
    if not found.impossible:
        return _figure(found.nats, 2)
    rest = "" if found.nats is None else f"; the others {_figure(found.nats, 2)}"
    return f"-inf ({100 * found.impossible:.1f} % impossible{rest})"


def images(evaluation: Evaluation) -> list[Table]:
    """KID and FID, a table for each network, where they were measured."""
    tables = []
    for name, sources in evaluation.images.items():
        heads = [NAMES.get(source, source) for source in sources]
        table = _table(f"Distance of images in the features of {name}", "", heads)
        for found in zip(*sources.values(), strict=True):
            sizes = sample_sizes(found[0])
            table.add_row(f"{found[0].name}, {sizes}", *(_image_distance(one, sizes) for one in found))
        tables.append(table)
    return tables


def sample_sizes(found: "ImageDistance") -> str:
    """How many images a distance is of."""
    if found.images == found.generated:
        return f"{found.images} images a side"
    return f"{found.images} real, {found.generated} generated images"


def _image_distance(found: "ImageDistance", sizes: str) -> str:
    own = sample_sizes(found)
    return f"{found.value:.4g} ± {(found.high - found.low) / 2:.2g}{'' if own == sizes else f' ({own})'}"


def _figure(found: Interval | float | None, digits: int, spread: bool = True) -> str:
    """A figure and, if asked for and known, half the width of its interval."""
    if found is None:
        return "-"
    if not isinstance(found, Interval):
        return f"{found:.{digits}f}"
    half = f" ± {(found.high - found.low) / 2:.{digits}f}" if spread else ""
    return f"{found.value:.{digits}f}{half}"


def _table(title: str, first: str, columns: list[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _percent(found: Histogram, k: int) -> str:
    return f"{100 * found.share[k]:.1f} ± {50 * (found.high[k] - found.low[k]):.1f}"


def _print(table: Table, console: Console) -> None:
    """Print it as wide as its figures are: a narrow terminal wraps its lines, a file has them whole."""
    for column in table.columns:
        if column.no_wrap:
            column.min_width = max(map(cell_len, (*str(column.header).split("\n"), *map(str, column.cells))))
    whole = Console(width=MAX_WIDTH).measure(table).minimum
    Console(file=console.file, width=max(console.width, whole), highlight=False).print(table)


def show_comparison(comparison: Comparison, console: Console) -> None:
    """Print it, whole."""
    _print(comparison_table(comparison), console)
    if comparison.reference == ESTIMATE:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)
    for note in comparison.notes:
        console.print(f"Note: {note}", style="dim", soft_wrap=True)


def comparison_table(comparison: Comparison) -> Table:
    """A column for each source; in each cell the distances to the reference, and the mean in brackets."""
    reference = comparison.reference
    title = "Means" if reference is None else f"TV and W-1 to {REFERENCES[reference]}, and (means)"
    table = Table(title=title, title_justify="left", title_style="bold")
    if reference is not None:
        table.caption, table.caption_justify = LEGEND, "left"
    table.add_column("", no_wrap=True)
    for name in comparison.sources:
        table.add_column(textwrap.fill(NAMES.get(name, name), 16), justify="right", no_wrap=True)
    rows, kinds = comparison.rows(), len(comparison.classes) if len(comparison.classes) > 1 else 0
    known = nested_counts(comparison.sources, comparison.classes)
    deeper = {row.label: row for row in rows[1 + kinds :] if row.label in known}
    for row in (*rows[: 1 + kinds], *([comparison.shares_of_classes()] if kinds else []), *deeper.values()):
        table.add_row(row.label, *(_compared(row, name) for name in comparison.sources))
    if comparison.likelihoods:
        table.add_section()
        found = (comparison.likelihoods.get(name) for name in comparison.sources)
        table.add_row("log q of the truth, nats", *("" if one is None else _nats(one) for one in found))
    return table


def _compared(row: Row, name: str) -> str:
    figures = [f"{found[name]:.3f}" for found in (row.total_variation, row.wasserstein) if name in found]
    return " ".join(figures + ([f"({row.means[name]:.2f})"] if name in row.means else [])) or "-"
