"""The three components of a verdict: structure, layout and looks, each with its grade, the reason, and what to do.

Structure is judged by ``inference.statistics.verdict``. Layout is where the objects of each class stand, in images with
as many of them: a difference in numbers is structure's. Looks are whole images. The grade of the whole is the worst of
the components'.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from probscene.inference.features.base import objects_counted
from probscene.inference.parameters.sites import OPTED_OUT, find_sites
from probscene.inference.statistics.residual import Grade, ResidualRatio, Sample, residual_ratio, worst_grade
from probscene.inference.statistics.verdict import StructureVerdict, Verdict

from ..fitting.outcome import feature_mask
from ..fitting.run import RunFolder
from .estimate import class_counts, counted_classes
from .explain import component_remedy, doubtful_sites_reason, residual_reason, structure_reason, structure_remedy
from .source_features import ALL, LEARNT, NUM_IMAGES, PRIOR, STRUCTURE, TARGET, SourceFeatures

MAX_ROWS = 1000  # of each source
KINDS = ("structure", "layout", "looks")
ABSENT, UNSURE, UNREAD = "not judged", "cannot be told", "cannot be read"
MIN_SKILL = 0.5  # from which on what is read tells whether a site agrees
FIXED = (OPTED_OUT, "the program says so")  # the latter in records of before 0.2
AGREEING_FLOORS = 2.0  # distance of a site's readings in the prior's renders and in the target, up to which they agree


@dataclass(frozen=True, eq=False)
class VerdictComponent:
    """One component of a verdict.

    Attributes:
        grade: None where it is not judged.
        reason: one sentence; why it is not judged, where it is not.
        remedy: what to do.
        figures: what the grade rests on; None where there are none.
        verdict: what stands in a table; of structure its own verdict.
    """

    grade: Grade | None
    reason: str
    remedy: str = ""
    figures: ResidualRatio | None = None
    verdict: str = ""

    def record(self) -> dict[str, Any]:
        """For JSON."""
        known = {"word": None if self.grade is None else str(self.grade), "verdict": self.verdict or ABSENT}
        known |= {"because": self.reason, "remedy": self.remedy}
        return known if self.figures is None else known | self.figures.record()


@dataclass(frozen=True, eq=False)
class VerdictComponents:
    """All components.

    Attributes:
        parts: by ``KINDS``.
        classes: the grades of ``counts`` and ``layout`` of each class, see ``grade_text``.
        prior_sites: sites that keep the prior, and why.
        doubtful: those of them whose prior is not known to be the target's.
    """

    parts: dict[str, VerdictComponent]
    classes: dict[str, dict[str, str]]
    prior_sites: dict[str, str]
    doubtful: tuple[str, ...] = ()

    @property
    def overall(self) -> Grade | None:
        """The worst of the parts; None where that cannot be judged, or where all are good and a site is in doubt."""
        grade = worst_grade(part.grade for part in self.parts.values())
        return None if grade is Grade.GOOD and self.doubtful else grade

    @property
    def head(self) -> VerdictComponent:
        """The part that gives the whole its verdict: structure where it is not good, else the worst one; or the
        doubtful sites."""
        structure = self.parts["structure"]
        if structure.grade is not Grade.GOOD:
            return structure
        worst = next((part for part in self.parts.values() if part.grade is self.overall), None)
        return VerdictComponent(None, *doubtful_sites_reason(self.doubtful)) if worst is None else worst

    @property
    def verdict(self) -> str:
        """Of the whole; good only where every part is, and nothing that was to be learnt keeps a doubtful prior."""
        return ABSENT if self.head.grade is None else self.head.verdict

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "verdict": self.verdict,
            "overall": ABSENT if self.overall is None else str(self.overall),
            "because": self.head.reason,
            "remedy": self.head.remedy,
            "parts": {name: part.record() for name, part in self.parts.items()},
            "classes": self.classes,
            "sites_not_learnt": self.prior_sites,
            "sites_in_doubt": list(self.doubtful),
        }


def verdict_components(
    run: RunFolder,
    structure: StructureVerdict,
    features: dict[str, Tensor],
    sources: dict[str, SourceFeatures],
    seed: int = 0,
) -> VerdictComponents:
    """Judge all components.

    Args:
        features: of ``TARGET``, ``LEARNT`` and ``PRIOR`` in the run's network, ``(N, D)``, all of them.
        sources: see ``embed_sources``.
    """
    layout, layout_grades = _layout(run, sources, seed)
    looks = residual_ratio(*_samples(sources, lambda source: source.looks), seed=seed)
    counts = _counts(run, features, seed)
    classes = {}
    for name in run.model.classes:
        if name in counts or name in layout_grades:
            classes[name] = {"counts": counts.get(name, ABSENT), "layout": layout_grades.get(name, ABSENT)}
    parts = {
        "structure": _structure(run, structure, features, seed),
        "layout": layout,
        "looks": _component(run, "looks", looks, "", _more_data(sources)),
    }
    return VerdictComponents(parts, classes, prior_sites(run), doubtful_sites(run))


def prior_sites(run: RunFolder) -> dict[str, str]:
    """Sites that keep the prior, and why; empty where no parameters were to be learnt."""
    if not run.parameters and run.config.parameters is not None:
        return {site.name: f"{run.features.name} features cannot read parameters" for site in find_sites(run.model)}
    kept = run.parameters.get("kept") == PRIOR
    none = "what was learnt came no nearer to held-out images"
    sites = run.parameters.get("sites", [])
    return {site["name"]: site["because"] or none for site in sites if kept or not site["learnt"]}


def doubtful_sites(run: RunFolder) -> tuple[str, ...]:
    """Of the sites that keep the prior those of which nothing shows that the target has it: neither does the program
    say that it is to be kept, nor is the same read, with some skill, in the prior's renders and in the target."""
    records = {site["name"]: site for site in run.parameters.get("sites", [])}
    reasons = prior_sites(run)
    return tuple(name for name in reasons if reasons[name] not in FIXED and not _agrees(records.get(name, {})))


def _agrees(site: dict[str, Any]) -> bool:
    """Whether a site of a run's record has its prior in the target, too."""
    distance = site.get("read", {}).get("distance")
    if not distance or (site["skill"] or 0) < MIN_SKILL or None in (distance["prior"], distance["floor"]):
        return False
    return distance["prior"] <= AGREEING_FLOORS * distance["floor"]


def structure_grade(residual: Grade | None, verdict: Verdict) -> Grade | None:
    """The grade of structure, from the grade of its features' distance, which its verdict may lower."""
    if verdict is Verdict.GOOD:
        return Grade.GOOD
    if residual is None or verdict in (Verdict.NOT_FITTED, Verdict.DOMAIN_SHIFT):
        return Grade.NO_BETTER
    return worst_grade((residual, Grade.BETTER))


def _structure(run: RunFolder, found: StructureVerdict, features: dict[str, Tensor], seed: int) -> VerdictComponent:
    net = run.network()
    mask = None if net is None else feature_mask(net)
    samples = {name: Sample(_thinned(rows if mask is None else rows[:, mask])) for name, rows in features.items()}
    figures = residual_ratio(samples[TARGET], samples[LEARNT], {PRIOR: samples[PRIOR]}, seed=seed)
    grade = structure_grade(None if figures is None else figures.grade, found.verdict)
    remedy = structure_remedy(run, found.verdict)
    return VerdictComponent(grade, structure_reason(found), remedy, figures, str(found.verdict))


def grade_text(figures: ResidualRatio | None) -> str:
    """The grade of a comparison in words."""
    if figures is None:
        return ABSENT
    return UNSURE if figures.grade is None else str(figures.grade)


def _layout(run: RunFolder, sources: dict[str, SourceFeatures], seed: int) -> tuple[VerdictComponent, dict[str, str]]:
    """Good only where no class is no better than in the prior."""
    if not sources[TARGET].layouts:
        reason = f"Not judged: {run.features.name} features do not say where objects are."
        return VerdictComponent(None, reason, "Fit with --features count to have it judged."), {}
    names, found = list(sources[TARGET].layouts), {}
    for name in names:
        samples, tests = _samples(sources, lambda source, name=name: source.layouts[name]), len(names) - 1
        found[name] = residual_ratio(*samples, metric="cityblock", tests=1 if name == ALL else tests, seed=seed)
    whole = found.pop(ALL)
    grades = {name: grade_text(figures) for name, figures in found.items()}
    worse = [name for name, grade in grades.items() if grade == Grade.NO_BETTER]
    return _component(run, "layout", whole, ", ".join(worse), _more_data(sources)), grades


def _more_data(sources: dict[str, SourceFeatures]) -> str:
    """What would narrow a comparison's interval: more of the smaller sample, up to what is compared."""
    target, scenes = (len(sources[name].looks.features) for name in (TARGET, LEARNT))
    if target < scenes:
        return "More photographs would decide it."
    return (
        "More scenes would decide it: --scenes."
        if scenes < NUM_IMAGES
        else "The most images that are compared do not decide it."
    )


def _component(
    run: RunFolder, name: str, figures: ResidualRatio | None, worse: str, more_data: str
) -> VerdictComponent:
    if figures is None:
        reason = "Not judged: too few learnt scenes have as many objects as the target's images."
        return VerdictComponent(None, reason, "Fix the structure first.")
    grade, reason = figures.grade, residual_reason(figures)
    if grade is None:
        reason = f"With {figures.rows} images, neither the fit nor the prior differs significantly from the target."
        return VerdictComponent(None, reason, more_data, figures, UNSURE)
    if worse and grade is Grade.GOOD:
        grade, reason = Grade.BETTER, f"{reason} Classes that alone are no better than the prior: {worse}."
    return VerdictComponent(grade, reason, component_remedy(run, name, grade, figures, more_data), figures, str(grade))


def _samples(
    sources: dict[str, SourceFeatures], sample: Callable[[SourceFeatures], Sample]
) -> tuple[Sample, Sample, dict[str, Sample]]:
    references = {name: sample(sources[name]) for name in (STRUCTURE, PRIOR) if name in sources}
    return sample(sources[TARGET]), sample(sources[LEARNT]), references


def _counts(run: RunFolder, features: dict[str, Tensor], seed: int) -> dict[str, str]:
    """The grade of each counted class's numbers, in words."""
    net = run.network()
    counts: dict[str, np.ndarray] = {}
    for source, rows in features.items():
        of_classes = class_counts(run.model, run.feature_names, rows if net is None else objects_counted(net, rows))
        if of_classes is not None:
            counts[source] = of_classes.clamp(min=0).round().double().numpy()
    grades: dict[str, str] = {}
    names = counted_classes(run.model, run.feature_names) if counts else ()
    for c, name in enumerate(names):
        if name in run.unread or name in run.model.stuff:
            grades[name] = UNREAD if name in run.unread else ABSENT
            continue
        real, learnt, prior = (Sample(_thinned(counts[source][:, c : c + 1])) for source in (TARGET, LEARNT, PRIOR))
        grades[name] = grade_text(residual_ratio(real, learnt, {PRIOR: prior}, tests=len(names), seed=seed))
    return grades


def _thinned(rows: Any) -> np.ndarray:
    """At most ``MAX_ROWS`` rows, evenly spread."""
    rows = np.asarray(rows, np.float64)
    return rows[np.linspace(0, len(rows) - 1, min(MAX_ROWS, len(rows))).astype(int)]
