"""Evaluations and comparisons as tables of text."""

import textwrap
from typing import Any

from rich.console import Console
from rich.table import Table

from probscene.inference.judging.metrics import Histogram
from probscene.inference.judging.tally import Interval, Tally

from ..evaluation.compare import ESTIMATE, Comparison
from ..evaluation.evaluate import Evaluation
from ..evaluation.likelihood import Likelihood
from ..evaluation.sources import Source
from ..evaluation.structure_counts import GROUPS, PARENTS, Relation, label

NAMES = {"prior": "prior", "learnt": "learnt", "truth": "truth", "estimate": "estimate *"}
FITTED = ("prior", "learnt")
DISTANCES = {
    "number": "number of objects, total variation",
    "classes": "classes, total variation",
    "number_wasserstein": "number of objects, Wasserstein-1",
}
FOOTNOTE = (
    "* An estimate without labels: what the feature network counts in the target's images, rounded; not the truth."
)

WIDEST = 1000  # characters
WORDS = {"truth": "the truth", "estimate": "what the feature network sees *"}
FLOOR = "The floor is what two halves of the target are apart; every figure of FID and KID is of as many images a side."


def show(evaluation: Evaluation, console: Console) -> None:
    """Print the distances, then the histograms in percent with half the width of their 95 % intervals."""
    more = (*nested(evaluation), *likelihoods(evaluation), *images(evaluation))
    for table in (*distances(evaluation.distances()), _numbers(evaluation), _classes(evaluation), *more):
        console.print(table)
        console.print()
    notes = {figure.note for each in evaluation.images.values() for found in each.values() for figure in found} - {""}
    if "estimate" in evaluation.sources:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)
    if evaluation.images:
        console.print(FLOOR, style="dim", soft_wrap=True)
    for note in evaluation.notes:
        console.print(f"Labels: {note}", style="dim", soft_wrap=True)
    for note in sorted(notes):
        console.print(f"Mind: {note}.", style="dim", soft_wrap=True)


def distances(measured: dict[str, Any]) -> list[Table]:
    """How far prior and learnt structures are from the truth and from the estimate, a table each; ``measured`` is
    ``Evaluation.distances()``."""
    tables = []
    for b, found in measured.items():
        what = "the truth" if b == "truth" else "what the feature network sees *"
        table = _table(f"Distance to {what}", "", ["prior", "learnt"])
        for key, words in DISTANCES.items():
            values = (found[a][key] for a in ("prior", "learnt"))
            table.add_row(words, *("-" if value is None else f"{value:.3f}" for value in values))
        tables.append(table)
    return tables


def _numbers(evaluation: Evaluation) -> Table:
    sources = evaluation.sources
    table = _table("Images by number of objects, %", "objects", [NAMES[name] for name in sources])
    each = [source.number() for source in sources.values()]
    for k in range(max(len(found.share) for found in each)):
        table.add_row(str(k), *(_percent(found, k) for found in each))
    table.add_section()
    table.add_row("mean", *(f"{source.total.mean():.2f}" for source in sources.values()))
    return table


def _classes(evaluation: Evaluation) -> Table:
    sources = evaluation.sources
    table = _table("Objects by class, %", "class", [NAMES[name] for name in sources])
    each = [source.classes() for source in sources.values()]
    for c, name in enumerate(evaluation.classes):
        table.add_row(name, *(_percent(found, c) for found in each))
    return table


def _rows(source: Source, relations: list[Relation]) -> dict[tuple[Relation, str], Tally]:
    """The tallies of a source, by relation and group, that hold any node."""
    return {
        (relation, group): found
        for relation in relations
        for group, found in source.nested.get(relation, {}).items()
        if not found.empty
    }


def nested(evaluation: Evaluation) -> list[Table]:
    """Where kinds nest: the mean of every kind of count, then how far each is from the truth and from the estimate."""
    relations = list(evaluation.sources["learnt"].nested)
    if not relations:
        return []
    each = {name: _rows(source, relations) for name, source in evaluation.sources.items()}
    known = dict.fromkeys(key for found in each.values() for key in found)
    means = _table("Counts by what they depend on, means", "", [NAMES[name] for name in each])
    for key in sorted(known, key=lambda key: _order(key, relations)):
        found = (tallies.get(key) for tallies in each.values())
        means.add_row(label(*key), *("-" if tally is None else _figure(tally.mean(), 2) for tally in found))
    tables = [means]
    for b in evaluation.distances():
        keys = [key for key in each[b] if not (key[1] == PARENTS and key[0][0] in evaluation.classes)]
        for field, title in (("total_variation", "total variation"), ("wasserstein", "Wasserstein-1")):
            what = "the truth" if b == "truth" else "what the feature network sees *"
            table = _table(f"Counts by what they depend on, {title} to {what}", "", ["prior", "learnt"])
            found = {
                f"{name} per image": [(evaluation.sources[a].kinds[c], evaluation.sources[b].kinds[c]) for a in FITTED]
                for c, name in enumerate(evaluation.classes)
            } | {
                label(*key): [(each[a].get(key), each[b][key]) for a in FITTED]
                for key in sorted(keys, key=lambda key: _order(key, relations))
            }
            for words, pairs in found.items():
                apart = (one and one.distance(other) for one, other in pairs)
                table.add_row(words, *(_figure(found and getattr(found, field), 3) for found in apart))
            if each[b]:
                tables.append(table)
    return tables


def _order(key: tuple[Relation, str], relations: list[Relation]) -> tuple[int, int]:
    return relations.index(key[0]), GROUPS.index(key[1])


def likelihoods(evaluation: Evaluation) -> list[Table]:
    """How likely prior and guide would have derived the truth's structures, where they are known."""
    if not evaluation.likelihoods:
        return []
    table = _table("log q of the labelled structures, nats a scene", "", list(evaluation.likelihoods))
    table.add_row("mean", *map(_nats, evaluation.likelihoods.values()))
    return [table]


def _nats(found: Likelihood) -> str:
    if not found.impossible:
        return _figure(found.nats, 2)
    rest = "" if found.nats is None else f"; the others {_figure(found.nats, 2)}"
    return f"-inf ({100 * found.impossible:.1f} % impossible{rest})"


def images(evaluation: Evaluation) -> list[Table]:
    """FID and KID, a table for each network, where they were measured."""
    tables = []
    for name, each in evaluation.images.items():
        table = _table(f"Distance of images in the features of {name}", "", list(each))
        for figures in zip(*each.values(), strict=True):
            title = f"{figures[0].name}, {figures[0].images} images a side"
            table.add_row(title, *(_short(figure) for figure in figures))
        tables.append(table)
    return tables


def _short(figure: Any) -> str:
    return f"{figure.value:.4g} ± {(figure.high - figure.low) / 2:.2g}"


def _figure(found: Interval | None, digits: int) -> str:
    """A figure and half the width of its interval."""
    if found is None:
        return "-"
    return f"{found.value:.{digits}f} ± {(found.high - found.low) / 2:.{digits}f}"


def _table(title: str, first: str, columns: list[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _percent(found: Histogram, k: int) -> str:
    if k >= len(found.share):
        return "0.0"
    return f"{100 * found.share[k]:.1f} ± {50 * (found.high[k] - found.low[k]):.1f}"


def show_comparison(comparison: Comparison, console: Console) -> None:
    """Print it as wide as it is: a narrow terminal wraps its lines, a file has them whole."""
    table = comparison_table(comparison)
    whole = Console(width=WIDEST).measure(table).maximum
    Console(file=console.file, width=max(console.width, whole), highlight=False).print(table)
    if comparison.reference == ESTIMATE:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)
    for note in comparison.notes:
        console.print(f"Labels: {note}", style="dim", soft_wrap=True)


def comparison_table(comparison: Comparison) -> Table:
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
        cells = (_compared(row.apart.get(name), row.means.get(name)) for name in comparison.sources)
        table.add_row(row.label, *cells)
    if comparison.likelihoods:
        table.add_section()
        found = (comparison.likelihoods.get(name) for name in comparison.sources)
        table.add_row("log q of the truth, nats", *("" if one is None else _nats(one) for one in found))
    return table


def _compared(apart: float | None, mean: float | None) -> str:
    said = [] if apart is None else [f"{apart:.3f}"]
    return " ".join(said + ([] if mean is None else [f"({mean:.2f})"])) or "-"
