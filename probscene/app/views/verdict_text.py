"""A verdict in a terminal and in the report."""

import html
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from probscene.inference.statistics.trust import Trust
from probscene.inference.statistics.two_sample import EnergyTest
from probscene.inference.statistics.verdict import Gap

from ..evaluation.components import ABSENT
from ..evaluation.diagnose import FitDiagnostics
from ..evaluation.source_features import LEARNT, PRIOR, STRUCTURE

HEAD = ("", "this fit", "the floor")
FLOOR = "The floor is what chance alone leaves between two halves of the real images."
PARTS = ("", "verdict", "this fit", "structure alone", "prior", "the floor")
DISTANCES = (LEARNT, STRUCTURE, PRIOR, "floor")
OVERALL = (
    "Energy distances from the target: of the run's features, of where objects stand in images with as many of them, "
    "and of EfficientNet's features; sizes are medians of boxes. The whole is as good as its worst part. "
    f"{FLOOR}"
)


def show(judged: FitDiagnostics, console: Console) -> None:
    """Print the verdict, why, what to do, its parts, what the labels say, and the figures of structure."""
    record = judged.record()
    show_parts(record, console)
    if judged.trust is None:
        return
    for text in _sentences(judged):
        console.print(text, soft_wrap=True)
    table = Table(title="Can this structure be trusted? Without labels", title_justify="left", title_style="bold")
    for name in HEAD:
        table.add_column(name, justify="right" if name else "left")
    for row in rows(judged.trust):
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(FLOOR, style="dim", soft_wrap=True)
    if judged.names:
        console.print(f"Least like any generated scene: {', '.join(judged.names)}.", style="dim", soft_wrap=True)
    console.print()


def show_parts(record: dict[str, Any], console: Console) -> None:
    """Print the verdict and its parts, of what ``FitDiagnostics.record`` gives, as it was kept."""
    if record["verdict"] is None:
        console.print(f"No verdict. {record['because']}", soft_wrap=True)
        console.print()
        return
    console.print(f"Verdict: {record['verdict']}.", style="bold", soft_wrap=True)
    for text in (record["because"], record["remedy"], *judged_by(record)):
        console.print(text, soft_wrap=True)
    if "parts" not in record:  # of a run of before
        return
    table = Table(title="Structure, layout and looks", title_justify="left", title_style="bold")
    for i, name in enumerate(PARTS):
        table.add_column(name, justify="left" if i < 2 else "right", no_wrap=i != 1)
    for row in parts(record):
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(OVERALL, style="dim", soft_wrap=True)
    for text in (*what_to_do(record), *by_class(record), *sites(record)):
        console.print(text, soft_wrap=True)


def section(judged: FitDiagnostics, real: str, generated: str) -> str:
    """HTML for the report; ``real`` and ``generated`` are its pictures."""
    record = judged.record()
    if judged.trust is None or record["verdict"] is None:
        return f"<p>No verdict. {html.escape(judged.absent)}</p>"
    said = (record["because"], record["remedy"], *judged_by(record))
    more = (*what_to_do(record), *by_class(record), *sites(record), *_sentences(judged))
    return (
        f'<div class="card">Verdict<b>{html.escape(record["verdict"])}</b></div>{_paragraphs(said)}'
        f'{_table(PARTS, parts(record))}<p class="soft">{OVERALL}</p>{_paragraphs(more)}'
        f'<div class="row two">{real}{generated}</div><h3>Structure</h3>{_table(HEAD, rows(judged.trust))}'
    )


def judged_by(record: dict[str, Any]) -> list[str]:
    """Which images a verdict is about; nothing for those of before."""
    if not (basis := record.get("basis")):
        return []
    images, folder, scenes = basis["images"], basis["folder"], basis["scenes"]
    which = (
        f"the {images} images that it was fitted to"
        if basis["fitted_to"]
        else f"{images} images that it was not fitted to, in {folder}"
    )
    return [f"Judged by {which}, {scenes} scenes of the fit and as many of the prior."]


def parts(record: dict[str, Any]) -> list[tuple[str, ...]]:
    """A row for each part: what, its verdict, and distances from the target."""
    found = []
    for name, part in record["parts"].items():
        distances = part.get("distances", {})
        each = (f"{distances[key]:.3g}" if key in distances else "-" for key in DISTANCES[:-1])
        floor = f"up to {distances['floor']:.3g}" if distances else "-"
        found.append((name, part["verdict"], *each, floor))
    return found


def what_to_do(record: dict[str, Any]) -> list[str]:
    """Of the parts that the verdict is not called by and that are not good: why, and what to do that was not said.
    Structure, with the difference that would be seen, and sizes have their figures in any case."""
    return [
        f"{name.capitalize()}: {part['because']} {part['remedy'].removeprefix(record['remedy']).strip()}".strip()
        for name, part in record["parts"].items()
        if (part["word"] != "good" or name in ("structure", "sizes")) and part["because"] != record["because"]
    ]


def by_class(record: dict[str, Any]) -> list[str]:
    """For which classes counts and layout can be used, a sentence each; none for models of one class."""
    classes, said = record["classes"], []
    if len(classes) < 2:
        return []
    for what in ("counts", "layout"):
        words: dict[str, list[str]] = {}
        for name, each in classes.items():
            words.setdefault(each[what], []).append(name)
        if set(words) != {ABSENT}:
            each = "; ".join(f"{word} for {', '.join(names)}" for word, names in words.items())
            said.append(f"{what.capitalize()} by class: {each}.")
    return said


def sites(record: dict[str, Any]) -> list[str]:
    """The sites that keep the prior, and why."""
    whys: dict[str, list[str]] = {}
    for name, because in record["sites_not_learnt"].items():
        whys.setdefault(because, []).append(name)
    each = "; ".join(f"{', '.join(names)}, as {because}" for because, names in whys.items())
    return [f"Sites that keep the prior: {each}."] if each else []


def rows(found: Trust) -> list[tuple[str, ...]]:
    """The figures of structure: what, of this fit, and the floor."""
    x = found.figures
    lost = x.modes.lost
    shares = f"{int(lost.sum())} of {len(lost)}, {_percent(float(x.modes.real[lost].sum()))} of real"
    looks = "looks" if x.by_appearance else "features"
    out = [
        ("energy distance, all features", *_apart(x.joint)),
        (f"energy distance, {x.names[x.single.worst]} (the farthest)", *_apart(x.single.largest, 1.0)),
    ]
    if x.from_prior is not None:
        out.append(("energy distance of generated and prior", *_apart(x.from_prior)))
    detectable = "-" if x.difference.detectable is None else f"{x.difference.detectable:.2f}"
    out += [
        ("total variation of one feature that would be seen", detectable, ""),
        ("p-value, all images", f"{x.p_value:.3f}", ""),
        ("real like no generated", *_gap(x.real_unmatched)),
        ("real like no generated or prior", *_gap(x.real_out_of_support)),
        ("generated like no real", *_gap(x.generated_unmatched)),
        ("clusters lost", shares, "0"),
        (f"real of another domain, by {looks}", _percent(x.foreign), "50.0 %"),
        ("effective sample size / N", f"{x.effective:.2f}", f"{x.effective_floor:.2f}"),
    ]
    for name in ("precision", "recall", "density", "coverage"):
        out.append((name, f"{getattr(x.fidelity, name):.2f}", f"{getattr(x.fidelity_floor, name):.2f}"))
    return out


def _sentences(judged: FitDiagnostics) -> list[str]:
    """What else is known: which classes can be read, what labels say, what the model is too narrow for."""
    found = [judged.usable] if judged.usable else []
    if judged.agreement is not None and judged.trust is not None:
        said = judged.agreement.sentence(judged.trust.verdict)
        found += [] if said.startswith(judged.record()["because"]) else [said]
    return [*found, judged.walls] if judged.walls else found


def _paragraphs(texts: Iterable[str]) -> str:
    return "".join(f"<p>{html.escape(text)}</p>" for text in texts)


def _table(head: tuple[str, ...], body: list[tuple[str, ...]]) -> str:
    first = "".join(f"<th>{name}</th>" for name in head)
    rest = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in body)
    return f'<div class="chart"><table><tr>{first}</tr>{rest}</table></div>'


def _apart(found: EnergyTest, unit: float | None = None) -> tuple[str, str]:
    unit = unit or found.floor or 1.0
    return f"{found.distance / unit:.2f} floors", f"{found.low / unit:.2f} to {found.high / unit:.2f}"


def _gap(found: Gap) -> tuple[str, str]:
    spread = 50 * (found.high - found.low)
    return f"{100 * found.share:.1f} ± {spread:.1f} %", f"up to {_percent(found.floor)}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
