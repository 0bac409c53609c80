"""``probscene report``: one self-contained HTML page about a run: images, verdict, histograms, the rest folded."""

import html
import json
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError, RunError
from probscene.inference.parameters.sites import site_name
from probscene.policy import Policy
from probscene.sampling import sample
from probscene.threads import threads

from ..chunks import chunk_randomness
from ..evaluation.diagnose import FitDiagnostics, diagnose
from ..evaluation.evaluate import Evaluation, evaluate
from ..evaluation.labels import TargetLabels
from ..evaluation.source_features import LEARNT, PRIOR, STRUCTURE, policies
from ..evaluation.sources import ESTIMATE, READ, START, baseline_policies
from ..evaluation.visible import Visible
from ..files import make_folder, write_text
from ..fitting.given_boxes import given_boxes
from ..fitting.pipeline import open_target
from ..fitting.run import RunFolder
from ..fitting.store import OTHER, timing
from ..labels.boxes import Boxes
from ..pictures import pixels
from ..progress import STAGES, Display
from ..style import style_sheet
from . import charts, tables, verdict_text
from .crops import object_crops
from .markup import folded, paragraphs, picture, table, text_table
from .preview import scenes

SITES = (
    "Skill is the share of a site's variance that can be read in renders. Values are quantiles of the prior, 0 to 1. "
    "Distances are Wasserstein-1 from what is read in images of the target that nothing was learnt from; the noise "
    "floor is the distance between two halves of them."
)
QUANTILES, QUANTILE_SCENES = (0.05, 0.5, 0.95), 1000  # of a site
VALUES = "The last columns give quantiles of the sites' values, in the program's units."
OBJECTS = (
    "From the smallest to the largest, at equal steps of rank. All crops of a class have the same scale. Boxes are in "
    "pixels of the model's canvas."
)
READINGS = "read in renders\nand target, 0 to 1"
OF_SITES = {
    "prior": "read in renders with the prior's parameters",
    "learnt": "with learnt parameters",
    "truth": "in the target",
}
LEGEND = {
    "prior": "prior",
    START: "initialisation: the policy that the guide was pretrained on",
    "learnt": "learnt",
    "truth": "target, truth (labels)",
    READ: "learnt, read: what the feature network counts in learnt renders",
    ESTIMATE: "target, estimate: what it counts in the target's images, without labels",
}


def report(
    run: RunFolder,
    show: Display,
    out: Path | None = None,
    labels: TargetLabels | None = None,
    num: int = 10000,
    judged_by: int | None = None,
    visible: Visible | None = None,
) -> Path:
    """Write the page.

    Args:
        out: ``report.html`` in the run folder where None.
        labels: of the run's target.
        num: structures sampled a source.
        judged_by: scenes rendered for the verdict, none where 0; see ``diagnose``.
        visible: see ``evaluate``.

    Returns:
        Where it is.

    Raises:
        RunError: the fit is not finished.
        DataError: labels that do not fit the target. Without labels, a target that is gone only leaves a gap.
        MachineError: the page cannot be written.
    """
    run.check_finished()
    images, absent = None, ""
    try:
        images = open_target(run, show)
    except (DataError, RunError) as error:
        if labels is not None:
            raise
        absent = str(error)
    truth = None
    if labels is not None and images is not None:
        truth = labels.read(run.model, images)
    evaluation = evaluate(run, images, truth, show, num, visible=visible)
    diagnostics = diagnose(run, images, show, judged_by, evaluation) if images and judged_by != 0 else None
    return write(run, evaluation, images, out, absent, diagnostics)


def write(
    run: RunFolder,
    evaluation: Evaluation,
    images: Images | None,
    out: Path | None = None,
    absent: str = "",
    diagnostics: FitDiagnostics | None = None,
) -> Path:
    """``report`` from what is known already; ``absent`` says why there are no target images."""
    out = Path(out) if out is not None else run.path / "report.html"
    make_folder(out.parent)
    record, model = run.record, run.model
    target = f"{len(images)} target images in {images.path}" if images else f"target {run.target}"
    page = Template(resources.files("probscene.app.views").joinpath("report.html").read_text(encoding="utf-8"))
    write_text(
        out,
        page.substitute(
            style=style_sheet(),
            title=html.escape(f"probscene: {model.name}"),
            subtitle=html.escape(
                f"Run {run.path.resolve()}, {target}, seed {record['seed']}, version {record['version']}"
            ),
            images=_images(run, images),
            absent="" if images else paragraphs([f"No target images: {absent or 'they were not read.'}"]),
            verdict=_verdict(diagnostics) + paragraphs(evaluation.kept),
            legend=_legend({name: LEGEND[name] for name in evaluation.shown}),
            histograms=charts.numbers(evaluation) + charts.classes(evaluation),
            note=" ".join(_about_histograms(evaluation)),
            details=_details(run, evaluation, images, diagnostics),
        ),
    )
    return out


def _images(run: RunFolder, target: Images | None) -> str:
    """A grid of images of each source, the target's last."""
    height, width = run.model.canvas
    number, columns = (8, 2) if width > 1.5 * height else (9, 3)
    parts = [
        picture(pixels(scenes(run.model, policy, number, 0).image), caption, columns)
        for caption, policy in _sources(run).items()
    ]
    if target is not None:
        spread = torch.linspace(0, len(target) - 1, min(number, len(target))).long().tolist()
        parts.append(picture([pixels(target.load(i)[None])[0] for i in spread], "Target: some of the images", columns))
    return "\n".join(parts)


def _sources(run: RunFolder) -> dict[str, Policy]:
    """What scenes are drawn of, by the caption of their picture, in the order of a fit."""
    found, baselines = policies(run), baseline_policies(run.model)
    kept = PRIOR not in found
    shown = {"Prior: kept by this fit" if kept else "Prior: before learning": baselines[PRIOR]}
    if START in baselines:
        shown["Initialisation: the policy that the guide was pretrained on"] = baselines[START]
    if STRUCTURE in found:
        shown["Structure alone: learnt structure, the prior's parameters"] = found[STRUCTURE]
        shown["Learnt: structure and parameters"] = found[LEARNT]
    elif not kept:
        shown["Learnt: structure; parameters keep the prior"] = found[LEARNT]
    return shown


def _verdict(found: FitDiagnostics | None) -> str:
    if found is None:
        return "<p>There is no verdict: no scenes were rendered to compare with target images.</p>"
    return verdict_text.sentence(found)


def _about_histograms(evaluation: Evaluation) -> list[str]:
    notes = ["Lines on the bars are 95 % bootstrap intervals."]
    if ESTIMATE in evaluation.shown:
        notes.append(
            "The estimate is not the truth: the feature network has seen renders of the prior only, and errs where "
            "objects crowd; its counts are rounded. It is compared with what the same network reads in renders."
        )
    elif "truth" not in evaluation.shown:
        unread = ", ".join(evaluation.unread)
        why = f"{unread} cannot be read in its images" if unread else "there are neither labels nor an estimate"
        notes.append(f"The target has no bars: {html.escape(why)}.")
    return notes


def _details(run: RunFolder, evaluation: Evaluation, images: Images | None, diagnostics: FitDiagnostics | None) -> str:
    """Everything else, folded."""
    nested, curves = "".join(charts.nested(evaluation)), "".join(charts.curves(_log(run)))
    return "".join(
        [
            folded("Verdict by parts", _parts(diagnostics, images)),
            folded(f"Warnings ({len(evaluation.warnings)})", paragraphs(evaluation.warnings)),
            folded("Distances", _distances(evaluation)),
            folded("Histograms by what counts depend on", f'<div class="charts">{nested}</div>' if nested else ""),
            folded("Objects by size", _objects(run, images, evaluation.boxes)),
            folded("Sites: where things stand and how they look", _sites(run)),
            folded("Learning curves", f'<div class="charts">{curves}</div>' if curves else ""),
            folded("Grammar", f"<pre>{html.escape(str(run.model.grammar))}</pre>"),
            folded("Times", _timing(run)),
            folded("Configuration", text_table(["setting", "value"], _flat(run.record))),
        ]
    )


def _parts(found: FitDiagnostics | None, images: Images | None) -> str:
    if found is None or images is None or found.structure is None:
        return ""
    real = [pixels(images.load(i)[None])[0] for i in found.real_uncovered]
    pictures = [
        picture(real, f"Target images least like any generated scene: {', '.join(found.names)}", 4),
        picture(list(found.generated_uncovered), "Generated scenes least like any target image", 4),
    ]
    return verdict_text.details(found, pictures)


def _objects(run: RunFolder, images: Images | None, boxes: Boxes | None) -> str:
    """Crops of each class, a row of each source."""
    prior, learnt = run.model.prior, run.guide
    shown = {"prior": prior} | ({} if learnt is prior else {"learnt": learnt})
    if images is not None and boxes is None:
        boxes = given_boxes(run, images)
    parts = []
    for name, found in object_crops(run, shown, images, boxes).items():
        rows = [
            picture(crops.images, f"{source.capitalize()}: median box {_size(crops.median)}, {crops.number} objects", 6)
            for source, crops in found.items()
        ]
        parts.append(f'<h3>{html.escape(name)}</h3><div class="images">{"".join(rows)}</div>')
    without = "" if boxes is not None else " Photographs are not shown, as none of their boxes are known."
    return "".join(parts) + f'<p class="soft">{OBJECTS}{without}</p>' if parts else ""


def _size(size: tuple[float, float]) -> str:
    return " x ".join(f"{side:.1f}" for side in size)


def _distances(evaluation: Evaluation) -> str:
    """The distances before and after learning, then every table of the evaluation that the charts do not hold."""
    cards = []
    for b, measured in evaluation.distances().items():
        to = "to the truth" if b == "truth" else "to the network's estimate"
        for key, what in (("number", "number of objects"), ("classes", "classes")):
            figures = " → ".join(_figure(distances[key]) for distances in measured.values())
            cards.append(f'<div class="card">{what}, {to}<b>{figures}</b></div>')
    parts = ["<p>There are neither labels nor an estimate to compare with.</p>"]
    if cards:
        initialisation = ", of the initialisation" if START in evaluation.sources else ""
        note = f"Total variation: of the prior{initialisation}, and of what was learnt."
        parts = [f'<div class="cards">{"".join(cards)}</div><p class="soft">{note}</p>']
    compared = *tables.distances(evaluation, spread=True), *tables.nested(evaluation, spread=True)
    for found in (*compared, *tables.errors(evaluation), *tables.likelihoods(evaluation), *tables.images(evaluation)):
        head = [str(column.header).replace(" *", "") for column in found.columns]
        rows = zip(*(map(str, column.cells) for column in found.columns), strict=True)
        parts.append(f"<h3>{html.escape(str(found.title).replace(' *', ''))}</h3>{text_table(head, rows)}")
        if found.caption:
            parts.append(f'<p class="soft">{html.escape(str(found.caption))}</p>')
    notes = *(f"Note: {note}" for note in evaluation.notes), *(f"Read: {line}" for line in evaluation.readings)
    return "\n".join([*parts, paragraphs(notes)])


def _sites(run: RunFolder) -> str:
    """A table of the program's sites: whether each can be read, what is read, and what sites of the scene became."""
    record = run.parameters
    if not record:
        return "<p>Parameters were not learnt: where things stand and how they look keeps the prior.</p>"
    sites, values = record["sites"], site_values(run)
    is_read = any(site["skill"] is not None or "read" in site for site in sites)
    head = ["site", "of", "parameters"]
    head += ["skill", "distance\nprior", "distance\nthis fit", "noise\nfloor", READINGS] if is_read else []
    head += [f"{name}: {', '.join(f'{q:.0%}' for q in QUANTILES)}" for name in ("prior", "learnt")] if values else []
    rows = []
    for site in sites:
        what = f"keeps the prior: {site['because']}"
        if site["learnt"]:
            what = "learnt" if record["kept"] == "learnt" else "learnt, and not kept"
        known = values.get(site["name"])
        of = ", ".join(site["kinds"]) or "the scene" * (known is not None and known.one)
        cells = [html.escape(site["name"]), html.escape(of), f"<p>{html.escape(what)}</p>"]
        read = site.get("read")
        if is_read:
            distances = [_figure(read["distance"][key]) for key in ("prior", "learnt", "floor")] if read else ["–"] * 3
            chart = f'<div class="site">{charts.site(site["name"], read)}</div>' if read else "–"
            cells += [_figure(site["skill"]), *distances, chart]
        if values:
            after = known.learnt if known is not None and site["learnt"] else None
            cells += [_numbers(None if known is None else known.prior), _numbers(after)]
        rows.append(cells)
    kept = _not_kept(record) if any(site["learnt"] for site in sites) and record["kept"] != "learnt" else ""
    legend = f'<p class="legend">{_legend(OF_SITES)}</p>' if is_read else ""
    notes = " ".join([*([SITES] if is_read else []), *([VALUES] if values else [])])
    return f'{kept}{legend}{table(head, rows, "sites")}<p class="soft">{notes}</p>'


class SiteValues(NamedTuple):
    """Of a site.

    Attributes:
        prior, learnt: quantiles ``QUANTILES`` of its values in scenes of the prior and of the fit; None where the fit's
            have the prior's parameters.
        one: whether a scene has one value.
    """

    prior: list[float]
    learnt: list[float] | None
    one: bool


def site_values(run: RunFolder) -> dict[str, SiteValues]:
    """By site, of those whose values are numbers."""
    sites = {site["name"] for site in run.parameters["sites"]}
    found: list[dict[str, list[float]]] = []
    single: set[str] = set()
    for policy in (run.model.prior, run.guide):
        if policy.with_parameters is None and found:
            break
        with torch.no_grad(), threads(1), chunk_randomness(0, 0):
            scenes = sample(run.model, policy, QUANTILE_SCENES, density=False)
        values: dict[str, list[Tensor]] = {}
        for name, value in scenes.parameters.items():
            own, mask = site_name(run.model.grammar, name), scenes.site_mask[name]
            if own in sites and value.shape == mask.shape and mask.any() and value.is_floating_point():
                values.setdefault(own, []).append(value[mask])
                single |= {own} if mask.sum(1).max() == 1 else set()
        at = torch.tensor(QUANTILES)
        found.append({name: torch.cat(some).float().quantile(at).tolist() for name, some in values.items()})
    after = found[1] if len(found) > 1 else {}
    return {name: SiteValues(before, after.get(name), name in single) for name, before in found[0].items()}


def _numbers(values: list[float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.3g}" for value in values)


def _not_kept(record: dict[str, Any]) -> str:
    figures = f"{record['learnt']:.2f} against {record['prior']:.2f} in energy distance"
    return f"<p>All sites keep the prior: learnt scenes come no nearer to held-out images, {figures}.</p>"


def _legend(words: dict[str, str]) -> str:
    """Colours by the page's names."""
    return "".join(
        f'<span><i style="background: var(--{name})"></i>{html.escape(text)}</span>' for name, text in words.items()
    )


def _log(run: RunFolder) -> list[dict[str, Any]]:
    path = run.path / "log.jsonl"
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def _timing(run: RunFolder) -> str:
    spent = timing(run)
    if not spent:
        return "<p>No times were recorded.</p>"
    names = {stage: name for stage, (name, _) in STAGES.items()} | {OTHER: "Other: between stages"}
    rows = [(names[stage], f"{spent[stage]:.1f} s") for stage in names if stage in spent]
    return text_table(["stage", "time"], [*rows, ("All", f"{sum(spent.values()):.1f} s")])


def _flat(record: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows = []
    for key, value in sorted(record.items()):
        inner = isinstance(value, dict)
        rows += _flat(value, f"{prefix}{key}.") if inner else [(f"{prefix}{key}", str(value))]
    return rows


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
