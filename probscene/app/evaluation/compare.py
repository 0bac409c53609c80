"""``probscene compare``: structures of the prior and of several runs of one model, compared with the truth or its
estimate.

The sources are those of ``evaluate`` (see there), with one for each run, under the name of its folder, instead of the
one that is learnt. The reference is the truth where there are labels, else what the feature network of the first run
that counts reads in the target; all sources are then what it reads in renders, of the classes that it can count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probscene.dataset import Images
from probscene.errors import ProbsceneError, RunError
from probscene.inference.statistics.count_metrics import (
    Shares,
    Tally,
    histogram,
    pooled_shares,
    total_variation,
    wasserstein,
)

from ..fitting.pipeline import Progress
from ..fitting.run import RunFolder
from ..loading import drawn_alike
from ..versions import versions_record
from .evaluate import Evaluation, network_counts, renders_read
from .labels import Labels
from .likelihood import Likelihood, likelihood
from .sources import ESTIMATE, PRIOR, START, Source, baseline_policies
from .structure_counts import GROUPS, PARENTS, group_label
from .visible import Visible, count_scenes, hidden_note, num_counted, visibility

TRUTH = "truth"


class Row(NamedTuple):
    """One kind of count of every source that has it.

    Attributes:
        label: in words.
        shares: by source, ``(K,)`` shares by count, or by class.
        means: by source; empty for shares by class.
        total_variation: by source other than the reference, from the reference.
        wasserstein: the same, in what is counted; empty for shares by class.
    """

    label: str
    shares: dict[str, Shares]
    means: dict[str, float]
    total_variation: dict[str, float]
    wasserstein: dict[str, float] = {}


@dataclass(frozen=True, eq=False)
class Comparison(Evaluation):
    """An evaluation of several runs: ``sources`` are ``prior``, ``start`` where the initialisation is another policy,
    each run's, then ``truth`` or ``estimate``.

    Attributes:
        runs: by name.
    """

    runs: dict[str, RunFolder] = field(default_factory=dict)

    @property
    def reference(self) -> str | None:
        """``truth`` or ``estimate``; None where neither is known."""
        return next((name for name in (TRUTH, ESTIMATE) if name in self.sources), None)

    def distances(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Of prior, initialisation and runs from the reference."""
        reference, others = self.reference, (*baseline_policies(self.run.model), *self.runs)
        return {} if reference is None else {reference: {a: self.distance(a, reference) for a in others}}

    def record(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            **versions_record(),
            "model": self.run.record["model"],
            "target": str(self.target),
            "classes": list(self.classes),
            "notes": list(self.notes),
            "reference": self.reference,
            "runs": {
                name: {
                    "path": str(run.path),
                    "guide": run.config.guide_record(),
                    "objective": run.config.divergence_name,
                    "seed": run.record["seed"],
                    "guide_sha256": run.guide_hash(),
                }
                for name, run in self.runs.items()
            },
            "distances": self.distances(),
            "sources": {name: self._source(source) for name, source in self.sources.items()},
            "log_prob": {name: _nats(found) for name, found in self.likelihoods.items()},
        }

    def rows(self) -> list[Row]:
        """The number of objects, every class, and where kinds nest the children by ``structure_counts.GROUPS``."""
        sources = self.sources
        rows = [self._row("objects per image", *_of_counts({name: s.total for name, s in sources.items()}))]
        if len(self.classes) > 1:
            for c, name in enumerate(self.classes):
                columns = {a: source.counts[:, c] for a, source in sources.items()}
                rows.append(self._row(f"{name} per image", *_of_counts(columns)))
        for relation in sources[PRIOR].nested:
            known = {name: source.nested[relation] for name, source in sources.items() if relation in source.nested}
            for group in GROUPS:
                tallies = {name: found[group] for name, found in known.items() if not found[group].empty}
                if len(tallies) > 1 and not (group == PARENTS and relation[0] in self.classes):
                    rows.append(self._row(group_label(relation, group), *_of_tallies(tallies)))
        return rows

    def shares_of_classes(self) -> Row:
        """Each class's share of all objects, of the sources that have any."""
        shares = {name: pooled_shares(source.counts) for name, source in self.sources.items()}
        return self._row("class of an object", {name: share for name, share in shares.items() if share.any()}, {})

    def _row(self, label: str, shares: dict[str, Shares], means: dict[str, float]) -> Row:
        known = None if self.reference is None else shares.get(self.reference)
        if known is None:
            return Row(label, shares, means, {})
        others = {name: p for name, p in shares.items() if name != self.reference}
        variations = {name: total_variation(p, known) for name, p in others.items()}
        transports = {name: wasserstein(p, known) for name, p in others.items()} if means else {}
        return Row(label, shares, means, variations, transports)


def open_runs(given: Sequence[RunFolder | Path | str]) -> dict[str, RunFolder]:
    """Finished runs of one model, or their folders, by the names of their folders.

    Raises:
        RunError: see ``RunFolder.at``; runs of different models or of the same name, or one that is not finished.
    """
    runs: dict[str, RunFolder] = {}
    for one in given:
        run = one if isinstance(one, RunFolder) else RunFolder.at(Path(one))
        path, name = run.path, run.path.resolve().name
        if name in runs or name in (PRIOR, START, TRUTH, ESTIMATE):
            raise RunError(
                f"expected runs in folders of different names, none of them {PRIOR}, {START}, {TRUTH} or {ESTIMATE}, "
                f"got another {name!r} at {path}; rename the folder, or save the run under another name."
            )
        first = next(iter(runs.values()), run)
        same = {
            "": run.record["model"] == first.record["model"],
            " as another file": run.record["model_sha256"] == first.record["model_sha256"],
            " with other modules beside it": run.record.get("modules") == first.record.get("modules"),
            " with other assets": drawn_alike(run.record, first.record),
        }
        if not all(same.values()):
            differs = next(what for what, equal in same.items() if not equal)
            raise RunError(
                f"expected runs of one model, got {first.path} of {first.record['model']} and {path} of "
                f"{run.record['model']}{differs}; compare runs of the same model."
            )
        run.check_finished()
        runs[name] = run
    return runs


def compare(
    runs: dict[str, RunFolder],
    target: Images | None,
    truth: Labels | None,
    progress: Progress,
    num: int = 10000,
    seed: int = 0,
    visible: Visible | None = None,
) -> Comparison:
    """Sample structures of the prior and of every guide, and count.

    Args:
        runs: from ``open_runs``.
        target: its images; without them, what the first run's network read in the images that it was fitted to.
        truth: the labels of the target's images.
        num: structures a source.
        visible: see ``evaluate``; those of the first run, where it has some and this is None. For structures that are
            counted and not read.

    Raises:
        ProbsceneError: a number that is not positive; see ``visibility``.
        RunError: there are no target images, and the runs were fitted to different ones.
    """
    if num < 1:
        raise ProbsceneError(f"expected a positive number of scenes, got {num}.")
    first = next(iter(runs.values()))
    path = first.target if target is None else target.path
    if target is None and (other := next((r for r in runs.values() if r.target != path), None)):
        raise RunError(
            f"expected runs that were fitted to the same images, got {first.path} to {path} and {other.path} to "
            f"{other.target}; say with --target which to compare with."
        )
    model, done = first.model, 0
    policies = baseline_policies(model) | {name: run.guide for name, run in runs.items()}
    criterion, notes = visibility(model, first, truth, visible)
    columns = list(range(len(model.classes))) if truth is None else truth.columns(model)

    def advance(scenes: int) -> None:
        nonlocal done
        done += scenes
        progress("counting", done, len(policies) * num_counted(criterion, num), "")

    likelihoods: dict[str, Likelihood] = {}
    reader, estimate = None, None
    if truth is None:
        estimates = ((run, network_counts(run, target, progress)) for run in runs.values() if _counted_classes(run))
        reader, estimate = next(((run, found) for run, found in estimates if found is not None), (None, None))
    if reader is not None and estimate is not None:
        columns, name = _counted_classes(reader), reader.path.resolve().name
        notes = (f"All counts are of what the network of {name} reads, in renders as in the target's images.",)
        sources = renders_read(reader, policies, progress, num, seed) | {ESTIMATE: estimate}
    else:
        found = {name: count_scenes(model, policy, num, seed, criterion, advance) for name, policy in policies.items()}
        sources = {name: Source.from_counts(one.counts, one.children) for name, one in found.items()}
    sources = {name: source.select(columns) for name, source in sources.items()}
    if truth is not None:
        sources[TRUTH] = Source.from_counts(truth.structures.counts, truth.structures.children, seed=1)
        if truth.derivation is not None:
            likelihoods = {name: likelihood(policy, truth.derivation) for name, policy in policies.items()}
    classes = tuple(model.classes[c] for c in columns)
    notes += hidden_note(model, first.guide, truth, criterion) + (() if truth is None else truth.notes)
    return Comparison(first, path, classes, sources, likelihoods, notes=notes, runs=runs)


def _counted_classes(run: RunFolder) -> list[int]:
    """The classes that a run's network can count in its images, by number."""
    return [c for c, name in enumerate(run.model.classes) if name not in run.unread]


def _of_counts(counts: dict[str, np.ndarray]) -> tuple[dict[str, Shares], dict[str, float]]:
    return {name: histogram(n) for name, n in counts.items()}, {name: float(n.mean()) for name, n in counts.items()}


def _of_tallies(tallies: dict[str, Tally]) -> tuple[dict[str, Shares], dict[str, float]]:
    shares = {name: tally.histogram().share for name, tally in tallies.items()}
    means = {name: tally.mean() for name, tally in tallies.items()}
    return shares, {name: mean.value for name, mean in means.items() if mean is not None}


def _nats(found: Likelihood) -> dict[str, Any]:
    return {"nats": None if found.nats is None else found.nats._asdict(), "impossible": found.impossible}
