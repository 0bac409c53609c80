"""The three parts of a verdict: structure, layout and looks, each with its floor, a word, why, and what to do.

Structure is judged by ``inference.judging.trust``. Layout is where the objects of each class stand, in images with as
many of them: what differs in the numbers is structure's. Looks are whole images. The word of the whole is the worst of
the parts'.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from probscene.inference.parameters.calibration import LOW_SKILL
from probscene.inference.parameters.sites import LEARN, OPTED_OUT, find_sites
from probscene.inference.statistics.residual import Grade, ResidualRatio, Sample, residual_ratio, worst
from probscene.inference.statistics.trust import Trust
from probscene.inference.statistics.verdict import Verdict

from ..fitting.outcome import feature_mask
from ..fitting.run import RunFolder
from .advice import of_structure, remedy
from .estimate import class_counts, counted_classes
from .source_features import ALL, IMAGES, LEARNT, PRIOR, STRUCTURE, TARGET, SourceFeatures

COUNTED = 1000  # rows of each source whose counts are compared
KINDS = ("structure", "layout", "looks")
ABSENT, UNSURE, UNREAD = "not judged", "cannot be told", "cannot be read"
AGREES = 2.0  # floors up to which what is read of a site in the prior's renders agrees with what is read in the target


@dataclass(frozen=True, eq=False)
class VerdictComponent:
    """One part of a verdict.

    Attributes:
        word: None where it is not judged.
        because: one sentence; why it is not judged, where it is not.
        remedy: what to do.
        figures: what the word rests on; None where there are none.
        verdict: how it is called in a table; of structure the verdict's own word.
    """

    word: Grade | None
    because: str
    remedy: str = ""
    figures: ResidualRatio | None = None
    verdict: str = ""

    def record(self) -> dict[str, Any]:
        """For JSON."""
        said = {"word": None if self.word is None else str(self.word), "verdict": self.verdict or ABSENT}
        said |= {"because": self.because, "remedy": self.remedy}
        return said if self.figures is None else said | self.figures.record()


@dataclass(frozen=True, eq=False)
class VerdictComponents:
    """All parts.

    Attributes:
        parts: by ``KINDS``.
        classes: the words for ``counts`` and ``layout`` of each class, as a person reads them.
        unread: sites that keep the prior, and why.
        doubtful: those of them whose prior is not known to be the target's.
    """

    parts: dict[str, VerdictComponent]
    classes: dict[str, dict[str, str]]
    unread: dict[str, str]
    doubtful: tuple[str, ...] = ()

    @property
    def overall(self) -> Grade | None:
        """The worst of the parts; None where that cannot be judged, or where all are good and a site is in doubt."""
        word = worst(part.word for part in self.parts.values())
        return None if word is Grade.GOOD and self.doubtful else word

    @property
    def head(self) -> VerdictComponent:
        """The part that the whole is called by: structure where it is not good, else the worst one; or what the sites
        leave open."""
        structure = self.parts["structure"]
        if structure.word is not Grade.GOOD:
            return structure
        found = next((part for part in self.parts.values() if part.word is self.overall), None)
        if found is None:
            return VerdictComponent(None, *_open(self.doubtful))
        return found

    @property
    def verdict(self) -> str:
        """Of the whole; good only where every part is, and nothing that was to be learnt keeps a doubtful prior."""
        return ABSENT if self.head.word is None else self.head.verdict

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "verdict": self.verdict,
            "overall": ABSENT if self.overall is None else str(self.overall),
            "because": self.head.because,
            "remedy": self.head.remedy,
            "parts": {name: part.record() for name, part in self.parts.items()},
            "classes": self.classes,
            "sites_not_learnt": self.unread,
            "sites_in_doubt": list(self.doubtful),
        }


def aspects(
    run: RunFolder, found: Trust, features: dict[str, Tensor], looked: dict[str, SourceFeatures], seed: int = 0
) -> VerdictComponents:
    """Judge all parts.

    Args:
        found: of structure.
        features: of ``TARGET``, ``LEARNT`` and ``PRIOR`` in the run's network, ``(N, D)``, all of them.
        looked: of the sources.
    """
    layout, of_classes = _layout(run, looked, seed)
    looks = residual_ratio(*_sides(looked, lambda seen: seen.looks), seed=seed)
    counts = _counts(run, features, seed)
    words = {}
    for name in run.model.classes:
        if name in counts or name in of_classes:
            words[name] = {"counts": counts.get(name, ABSENT), "layout": of_classes.get(name, ABSENT)}
    parts = {
        "structure": _structure(run, found, features, seed),
        "layout": layout,
        "looks": _aspect(run, "looks", looks, "", _would_tell(looked)),
    }
    return VerdictComponents(parts, words, unread_sites(run), doubtful_sites(run))


def unread_sites(run: RunFolder) -> dict[str, str]:
    """Sites that keep the prior, and why; empty where no parameters were to be learnt."""
    if not run.parameters and run.config.parameters is not None:
        return {site.name: f"{run.features.name} features read no parameters" for site in find_sites(run.model)}
    kept = run.parameters.get("kept") == PRIOR
    none = "scenes came no nearer to held-out images by what was learnt"
    sites = run.parameters.get("sites", [])
    return {site["name"]: site["because"] or none for site in sites if kept or not site["learnt"]}


def doubtful_sites(run: RunFolder) -> tuple[str, ...]:
    """Of the sites that keep the prior those of which nothing shows that the target has it: neither does the program
    say that it is to be kept, nor is the same read, with some skill, in the prior's renders and in the target."""
    of = {site["name"]: site for site in run.parameters.get("sites", [])}
    unread = unread_sites(run)
    return tuple(name for name in unread if unread[name] != OPTED_OUT and not _agrees(of.get(name, {})))


def _agrees(site: dict[str, Any]) -> bool:
    """Whether a site of a run's record has its prior in the target, too."""
    apart = site.get("read", {}).get("distance")
    if not apart or (site["skill"] or 0) < LOW_SKILL or None in (apart["prior"], apart["floor"]):
        return False
    return apart["prior"] <= AGREES * apart["floor"]


def _open(doubtful: tuple[str, ...]) -> tuple[str, str]:
    """Why the whole is not judged for sites that keep the prior, and what to do."""
    because = f"Every part is good, but {', '.join(doubtful)} kept the prior, and nothing shows that the target has it."
    return because, f"Set these priors by hand, and say infer={{{LEARN!r}: False}} of those that are meant as they are."


def called(word: Grade | None, verdict: Verdict) -> Grade | None:
    """The word for structure: its verdict may be worse than how near its features are."""
    if verdict is Verdict.GOOD:
        return Grade.GOOD
    if word is None or verdict in (Verdict.NOT_FITTED, Verdict.ANOTHER_DOMAIN):
        return Grade.NO_BETTER
    return worst((word, Grade.BETTER))


def _structure(run: RunFolder, found: Trust, features: dict[str, Tensor], seed: int) -> VerdictComponent:
    net = run.network()
    which = None if net is None else feature_mask(net)
    sides = {name: Sample(_some(each if which is None else each[:, which])) for name, each in features.items()}
    figures = residual_ratio(sides[TARGET], sides[LEARNT], {PRIOR: sides[PRIOR]}, seed=seed)
    word = called(None if figures is None else figures.word, found.verdict)
    return VerdictComponent(word, found.because, of_structure(run, found), figures, str(found.verdict))


def said(figures: ResidualRatio | None) -> str:
    """The word for a comparison, as a person reads it."""
    if figures is None:
        return ABSENT
    return UNSURE if figures.word is None else str(figures.word)


def _layout(run: RunFolder, looked: dict[str, SourceFeatures], seed: int) -> tuple[VerdictComponent, dict[str, str]]:
    """Good only where no class is no better than in the prior."""
    if not looked[TARGET].layouts:
        why = f"Not judged: {run.features.name} features do not say where objects are."
        return VerdictComponent(None, why, "Take --features count to have it judged."), {}
    names, found = list(looked[TARGET].layouts), {}
    for name in names:
        sides = _sides(looked, lambda seen, name=name: seen.layouts[name])
        found[name] = residual_ratio(*sides, metric="cityblock", tests=1 if name == ALL else len(names) - 1, seed=seed)
    whole = found.pop(ALL)
    words = {name: said(figures) for name, figures in found.items()}
    worse = [name for name, word in words.items() if word == Grade.NO_BETTER]
    return _aspect(run, "layout", whole, ", ".join(worse), _would_tell(looked)), words


def _would_tell(looked: dict[str, SourceFeatures]) -> str:
    """What would make a comparison surer: more than there are of what there are fewer of, as long as they are looked
    at."""
    target, scenes = (len(looked[name].looks.features) for name in (TARGET, LEARNT))
    if target < scenes:
        return "More photographs would tell."
    return "More scenes would tell: --scenes." if scenes < IMAGES else "As many images as are looked at do not tell."


def _aspect(run: RunFolder, name: str, figures: ResidualRatio | None, worse: str, would_tell: str) -> VerdictComponent:
    if figures is None:
        why = "Not judged: too few learnt scenes have as many objects as the target's images."
        return VerdictComponent(None, why, "Fix the structure first.")
    word, because = figures.word, _because(figures)
    if word is None:
        why = f"Of {figures.rows} images neither what was learnt nor the prior can be told from the target."
        return VerdictComponent(None, why, would_tell, figures, UNSURE)
    if worse and word is Grade.GOOD:
        word, because = Grade.BETTER, f"{because} By themselves these are not nearer than in the prior: {worse}."
    return VerdictComponent(word, because, remedy(run, name, word, figures, would_tell), figures, str(word))


def _because(figures: ResidualRatio) -> str:
    if figures.left is None:
        return "It is farther from the target than chance leaves, and the prior is not."
    limits = f"{_percent(figures.low)} to {_percent(figures.high)}"
    nearest = STRUCTURE if figures.nearest == STRUCTURE else "the prior"
    share = f"{_percent(figures.left)} ({limits}) of the squared distance of {nearest} from the target is left"
    return f"{share}{'; chance alone would leave as much' if figures.close else ''}."


def _percent(share: float) -> str:
    return f"{100 * max(0.0, share):.0f} %" if np.isfinite(share) else "any share"


def _sides(
    looked: dict[str, SourceFeatures], of: Callable[[SourceFeatures], Sample]
) -> tuple[Sample, Sample, dict[str, Sample]]:
    others = {name: of(looked[name]) for name in (STRUCTURE, PRIOR) if name in looked}
    return of(looked[TARGET]), of(looked[LEARNT]), others


def _counts(run: RunFolder, features: dict[str, Tensor], seed: int) -> dict[str, str]:
    """Of each class that the features count, how near its numbers are."""
    net = run.network()
    unit = getattr(net, "unit", 1.0)
    each: dict[str, np.ndarray] = {}
    for source, found in features.items():
        counts = class_counts(run.model, run.feature_names, found * unit)
        if counts is not None:
            each[source] = counts.clamp(min=0).round().double().numpy()
    words: dict[str, str] = {}
    names = counted_classes(run.model, run.feature_names) if each else ()
    for c, name in enumerate(names):
        if name in run.unread or name in run.model.stuff:
            words[name] = UNREAD if name in run.unread else ABSENT
            continue
        real, learnt, prior = (Sample(_some(each[source][:, c : c + 1])) for source in (TARGET, LEARNT, PRIOR))
        figures = residual_ratio(real, learnt, {PRIOR: prior}, tests=len(names), seed=seed)
        words[name] = said(figures)
    return words


def _some(rows: Any) -> np.ndarray:
    """At most ``COUNTED`` rows, evenly spread."""
    rows = np.asarray(rows, np.float64)
    return rows[np.linspace(0, len(rows) - 1, min(COUNTED, len(rows))).astype(int)]
