"""An evaluation as tables of text."""

from typing import Any

from rich.console import Console
from rich.table import Table

from probscene.app.evaluate import Evaluation
from probscene.inference.metrics import Histogram

NAMES = {"prior": "prior", "learnt": "learnt", "truth": "truth", "estimate": "estimate *"}
DISTANCES = {
    "number": "number of objects, total variation",
    "classes": "classes, total variation",
    "number_wasserstein": "number of objects, Wasserstein-1",
}
FOOTNOTE = (
    "* An estimate without labels: what the feature network counts in the target's images, rounded; not the truth."
)


def show(evaluation: Evaluation, console: Console) -> None:
    """Print the distances, then the histograms in percent with half the width of their 95 % intervals."""
    for table in (*distances(evaluation.distances()), _numbers(evaluation), _classes(evaluation)):
        console.print(table)
        console.print()
    if "estimate" in evaluation.sources:
        console.print(FOOTNOTE, style="dim", soft_wrap=True)


def distances(measured: dict[str, Any]) -> list[Table]:
    """How far prior and learnt structures are from the truth and from the estimate, a table each; ``measured`` is
    ``Evaluation.distances()``."""
    tables = []
    for b, found in measured.items():
        what = "the truth" if b == "truth" else "what the feature network sees *"
        table = _table(f"Distance to {what}", "", ["prior", "learnt"])
        for key, label in DISTANCES.items():
            values = (found[a][key] for a in ("prior", "learnt"))
            table.add_row(label, *("-" if value is None else f"{value:.3f}" for value in values))
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


def _table(title: str, first: str, columns: list[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="right")
    return table


def _percent(found: Histogram, k: int) -> str:
    if k >= len(found.share):
        return "0.0"
    return f"{100 * found.share[k]:.1f} ± {50 * (found.high[k] - found.low[k]):.1f}"
