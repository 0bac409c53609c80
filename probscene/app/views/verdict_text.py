"""A verdict in a terminal and in the report."""

import html
from typing import Any

from rich.console import Console
from rich.table import Table

from probscene.inference.statistics.energy import EnergyTest
from probscene.inference.statistics.verdict import StructureStatistics, UncoveredShare

from ..evaluation.components import ABSENT
from ..evaluation.diagnose import FitDiagnostics
from ..evaluation.explain import percent
from ..evaluation.source_features import LEARNT, PRIOR, STRUCTURE
from .markup import paragraphs, text_table

STATISTICS_HEAD = ("", "this fit", "noise floor")
FLOOR = "The noise floor is the distance between two halves of the real images."
PARTS_HEAD = ("", "verdict", "this fit", "structure alone", "prior", "noise floor")
DISTANCES = (LEARNT, STRUCTURE, PRIOR)
OVERALL = (
    "Energy distances from the target: structure by the run's features, layout by the positions of objects in images "
    "with equal counts, looks by EfficientNet's features; sizes by the medians of boxes. The verdict is that of the "
    f"worst part. {FLOOR}"
)


def show(found: FitDiagnostics, console: Console) -> None:
    """Print the verdict, why, what to do, its parts, what the labels say, and the figures of structure."""
    record = found.record()
    show_parts(record, console)
    if found.structure is None:
        return
    for text in _sentences(found):
        console.print(text, soft_wrap=True)
    table = Table(title="Statistics of structure, without labels", title_justify="left", title_style="bold")
    for name in STATISTICS_HEAD:
        table.add_column(name, justify="right" if name else "left")
    for row in rows(found.structure.statistics):
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(FLOOR, style="dim", soft_wrap=True)
    if found.names:
        console.print(f"Least like any generated scene: {', '.join(found.names)}.", style="dim", soft_wrap=True)
    console.print()


def show_parts(record: dict[str, Any], console: Console) -> None:
    """Print the verdict and its parts, of what ``FitDiagnostics.record`` gives, as it was kept."""
    if record["verdict"] is None:
        console.print(f"No verdict. {record['because']}", soft_wrap=True)
        console.print()
        return
    console.print(f"Verdict: {record['verdict']}.", style="bold", soft_wrap=True)
    for text in (record["because"], record["remedy"], *basis(record)):
        console.print(text, soft_wrap=True)
    if "parts" not in record:  # of a run of before
        return
    table = Table(title="Structure, layout and looks", title_justify="left", title_style="bold")
    for i, name in enumerate(PARTS_HEAD):
        table.add_column(name, justify="left" if i < 2 else "right", no_wrap=i != 1)
    for row in parts(record):
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(OVERALL, style="dim", soft_wrap=True)
    for text in (*remedies(record), *by_class(record), *sites(record)):
        console.print(text, soft_wrap=True)


def sentence(found: FitDiagnostics) -> str:
    """HTML for the report: the verdict with its reason, and what to do."""
    record = found.record()
    if record["verdict"] is None:
        return f"<p>No verdict. {html.escape(found.absent)}</p>"
    word, reason = record["verdict"], html.escape(record["because"])
    word = html.escape(word[:1].upper() + word[1:])
    return f'<p class="verdict"><b>{word}</b>: {reason}</p>{paragraphs([record["remedy"]])}'


def details(found: FitDiagnostics, pictures: list[str]) -> str:
    """HTML for the report: the verdict's parts and the figures of structure; nothing where there is no verdict."""
    record = found.record()
    if found.structure is None or record["verdict"] is None:
        return ""
    more = (*remedies(record), *by_class(record), *sites(record), *_sentences(found))
    statistics = text_table(STATISTICS_HEAD, rows(found.structure.statistics))
    return (
        f'{paragraphs(basis(record))}{text_table(PARTS_HEAD, parts(record))}<p class="soft">{OVERALL}</p>'
        f'{paragraphs(more)}<div class="charts">{"".join(pictures)}</div>'
        f"<h3>Statistics of structure, without labels</h3>{statistics}"
    )


def basis(record: dict[str, Any]) -> list[str]:
    """The images that a verdict is about; nothing in records of earlier versions."""
    if not (known := record.get("basis")):
        return []
    images, folder, scenes = known["images"], known["folder"], known["scenes"]
    which = (
        f"the {images} images that it was fitted to"
        if known["fitted_to"]
        else f"{images} images that it was not fitted to, in {folder}"
    )
    return [f"Judged by {which}, {scenes} scenes of the fit and as many of the prior."]


def parts(record: dict[str, Any]) -> list[tuple[str, ...]]:
    """A row for each part: what, its verdict, and distances from the target."""
    rows = []
    for name, part in record["parts"].items():
        distances = part.get("distances", {})
        cells = (f"{distances[key]:.3g}" if key in distances else "-" for key in DISTANCES)
        floor = f"up to {distances['floor']:.3g}" if distances else "-"
        rows.append((name, part["verdict"], *cells, floor))
    return rows


def remedies(record: dict[str, Any]) -> list[str]:
    """Of the parts that do not give the verdict and that are not good: why, and what else to do. Structure, with the
    difference that would be detected, and sizes have their figures in any case."""
    return [
        f"{name.capitalize()}: {part['because']} {part['remedy'].removeprefix(record['remedy']).strip()}".strip()
        for name, part in record["parts"].items()
        if (part["word"] != "good" or name in ("structure", "sizes")) and part["because"] != record["because"]
    ]


def by_class(record: dict[str, Any]) -> list[str]:
    """For which classes counts and layout can be used, a sentence each; none for models of one class."""
    classes, sentences = record["classes"], []
    if len(classes) < 2:
        return []
    for what in ("counts", "layout"):
        by_grade: dict[str, list[str]] = {}
        for name, grades in classes.items():
            by_grade.setdefault(grades[what], []).append(name)
        if set(by_grade) != {ABSENT}:
            text = "; ".join(f"{grade} for {', '.join(names)}" for grade, names in by_grade.items())
            sentences.append(f"{what.capitalize()} by class: {text}.")
    return sentences


def sites(record: dict[str, Any]) -> list[str]:
    """The sites that keep the prior, and why."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in record["sites_not_learnt"].items():
        by_reason.setdefault(reason, []).append(name)
    text = "; ".join(f"{', '.join(names)}, as {reason}" for reason, names in by_reason.items())
    return [f"Sites that keep the prior: {text}."] if text else []


def rows(x: StructureStatistics) -> list[tuple[str, ...]]:
    """The statistics of structure: name, of this fit, and the noise floor."""
    collapsed = x.modes.collapsed
    shares = f"{int(collapsed.sum())} of {len(collapsed)}, {percent(float(x.modes.real[collapsed].sum()))} of real"
    looks = "looks" if x.by_patches else "features"
    farthest = x.feature_names[x.marginal.feature]
    out = [
        ("energy distance, all features", *_energy(x.joint)),
        (f"energy distance, {farthest} (the farthest)", *_energy(x.marginal.largest, 1.0)),
    ]
    if x.from_prior is not None:
        out.append(("energy distance of generated and prior", *_energy(x.from_prior)))
    detectable = "-" if x.difference.detectable is None else f"{x.difference.detectable:.2f}"
    out += [
        ("detectable total variation of one feature", detectable, ""),
        ("p-value, all images", f"{x.p_value:.3f}", ""),
        ("real images like no generated one", *_uncovered(x.real_uncovered)),
        ("real images like no generated or prior one", *_uncovered(x.real_out_of_support)),
        ("generated images like no real one", *_uncovered(x.generated_uncovered)),
        ("collapsed clusters", shares, "0"),
        (f"real images with a domain shift, by {looks}", percent(x.domain_shift_share), "50.0 %"),
        ("effective sample size / N", f"{x.ess_fraction:.2f}", f"{x.ess_fraction_floor:.2f}"),
    ]
    for name in ("precision", "recall", "density", "coverage"):
        out.append((name, f"{getattr(x.fidelity, name):.2f}", f"{getattr(x.fidelity_floor, name):.2f}"))
    return out


def _sentences(found: FitDiagnostics) -> list[str]:
    """What else is known: which classes can be read, what labels say, what the model is too narrow for."""
    sentences = [found.usable] if found.usable else []
    if found.agreement is not None and found.structure is not None:
        text = found.agreement.sentence(found.structure.verdict)
        sentences += [] if text.startswith(found.record()["because"]) else [text]
    return [*sentences, found.prior_warning] if found.prior_warning else sentences


def _energy(found: EnergyTest, unit: float | None = None) -> tuple[str, str]:
    unit = unit or found.floor or 1.0
    return f"{found.distance / unit:.2f} noise floors", f"{found.low / unit:.2f} to {found.high / unit:.2f}"


def _uncovered(found: UncoveredShare) -> tuple[str, str]:
    spread = 50 * (found.high - found.low)
    return f"{100 * found.share:.1f} ± {spread:.1f} %", f"up to {percent(found.floor)}"
