"""``probscene evaluate``: learnt structures compared with the prior's, the truth's and the network's estimate.

Sources of counts: ``prior``, ``start`` where fits are initialised from another policy, and ``learnt`` are sampled
structures; ``truth`` is a file of labels of the target's images; ``estimate`` is what the run's feature network counts
in them, rounded. The last is no truth: the network learnt on prior renders alone and errs where objects crowd, but it
needs no label. As it errs in renders, too, it is compared with what the same network reads in renders of the sampled
structures, and never with the structures themselves. Where there are labels as well, what is read in each image is
compared with them.

Where kinds nest (cars on roads), children are counted by node and by the node's rank, which no context-free prior can
weigh and totals hide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from probscene.dataset import Images
from probscene.errors import ProbsceneError
from probscene.inference.features.base import objects_counted
from probscene.inference.statistics.count_metrics import Tally, histogram, pooled_shares, total_variation, wasserstein
from probscene.policy import Policy

from ..fitting.pipeline import Progress
from ..fitting.run import RunFolder
from ..fitting.scene_features import features_in, features_of, kept_features, own_net
from ..labels.boxes import Boxes
from ..progress import Display
from ..versions import versions_record
from .count_errors import CountErrors, count_errors
from .estimate import class_counts, counted_classes, estimate_counts
from .image_distances import MAX_IMAGES, Distances, image_distances
from .image_distances import record as image_record
from .labels import Labels
from .likelihood import Likelihood, likelihood
from .prior_limits import SaturatedList, UnreachableCounts, saturated_lists, saturation_warnings, unreachable_counts
from .sources import ESTIMATE, LEARNT, READ, SAMPLED_SOURCES, Source, baseline_policies
from .structure_counts import Relation
from .visible import Visible, count_scenes, hidden_note, num_counted, visibility

MAX_RENDERS_READ = 1000  # of each source, by the network


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Counts by source; see the module.

    Attributes: run: the run. target: path of the target's images. classes: the C names; only those that are labelled,
        where there are labels. sources: ``SAMPLED_SOURCES``, then ``truth`` and ``estimate``, where they are known.
        likelihoods: of the truth's structures under each of ``SAMPLED_SOURCES``, where they are known. images: KID and
        FID by the features' name; see ``image_distances``. notes: of the labels. saturated_lists: the lists that are
        too short for what was learnt. unreachable_counts: the images that the model cannot generate, by the labels,
        else by the estimate. errors: with labels, by class those of the counts that are read in each image; None where
        none are. read: what the network that makes the estimate reads in renders of ``SAMPLED_SOURCES``; empty without
        an estimate. boxes: of the labels.
    """

    run: RunFolder
    target: Path
    classes: tuple[str, ...]
    sources: dict[str, Source]
    likelihoods: dict[str, Likelihood] = field(default_factory=dict)
    images: dict[str, Distances] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    saturated_lists: tuple[SaturatedList, ...] = ()
    unreachable_counts: tuple[UnreachableCounts, ...] = ()
    errors: dict[str, CountErrors | None] = field(default_factory=dict)
    read: dict[str, Source] = field(default_factory=dict)
    boxes: Boxes | None = None

    def compared_with(self, reference: str) -> dict[str, Source]:
        """All sources as they are compared with one of them: with the estimate, as the same network reads them in
        renders."""
        return self.sources | (self.read if reference == ESTIMATE else {})

    @property
    def shown(self) -> dict[str, Source]:
        """The sources whose histograms are shown: before the estimate, which counts all classes or is left out, what
        the network reads in learnt renders."""
        found = {name: source for name, source in self.sources.items() if name != ESTIMATE}
        if ESTIMATE in self.sources and not self.unread:
            found |= {READ: self.read[LEARNT], ESTIMATE: self.sources[ESTIMATE]}
        return found

    @cached_property
    def unread(self) -> tuple[str, ...]:
        """Classes that the network cannot count in the target's images: nothing is compared with an estimate of them,
        nor of all objects."""
        return tuple(name for name in self.classes if name in self.run.unread)

    @cached_property
    def readings(self) -> tuple[str, ...]:
        """Of each class how it is read in the target's images, in a sentence; empty for features that do not say so."""
        records = self.run.readings.get("classes", {})
        return tuple(f"{name}: {records[name]['because']}." for name in self.classes if name in records)

    @property
    def kept(self) -> tuple[str, ...]:
        """That the prior is kept, and why; empty where it is what was learnt."""
        outcome = self.run.outcome
        return (f"The prior is kept: {outcome['because']}.",) if "because" in outcome else ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the model is too narrow for, with what to change."""
        return (*saturation_warnings(self.saturated_lists), *(f"Warning: {found}" for found in self.unreachable_counts))

    @property
    def prior_warning(self) -> str:
        """The same in one sentence; empty where there is nothing."""
        short = ", ".join(dict.fromkeys(found.name for found in self.saturated_lists if not found.beyond_prior))
        images = len({row for found in self.unreachable_counts for row in found.rows})
        parts = [f"lists reach their maximum length ({short})"] if short else []
        parts += [f"{images} images have counts that the model cannot generate"] if images else []
        return f"The prior is too narrow: {' and '.join(parts)}; the warnings say what to change." if parts else ""

    def distance(self, a: str, b: str) -> dict[str, Any]:
        """Distances of source ``a`` from ``b``: total variation of the number of objects and of the pooled class
        shares, Wasserstein-1 of the number in objects an image, and the total variation of each class's own counts.
        Shares of a source without objects are not compared: None.

        ``kinds`` and ``children`` have both distances with their intervals, of each class's counts and, where kinds
        nest, of the children by ``structure_counts.GROUPS``; None where a source has no such node."""
        one, other = self.compared_with(b)[a], self.sources[b]
        unread = self.unread if b == ESTIMATE else ()
        number = histogram(one.total), histogram(other.total)
        shares = pooled_shares(one.counts), pooled_shares(other.counts)
        each_class = {
            name: total_variation(histogram(one.counts[:, c]), histogram(other.counts[:, c]))
            for c, name in enumerate(self.classes)
            if name not in unread
        }
        kinds = zip(self.classes, one.kinds, other.kinds, strict=True)
        return {
            "number": None if unread else total_variation(*number),
            "number_wasserstein": None if unread else wasserstein(*number),
            "classes": total_variation(*shares) if shares[0].any() and shares[1].any() and not unread else None,
            "each_class": each_class,
            "kinds": {name: None if name in unread else _distance(x, y) for name, x, y in kinds},
            "children": {
                _key(relation): {
                    group: _distance(found, other.nested[relation][group]) for group, found in tallies.items()
                }
                for relation, tallies in one.nested.items()
                if relation in other.nested
            },
        }

    def distances(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Of prior, initialisation and learnt from the truth and from the estimate, where there are such."""
        known = [name for name in ("truth", ESTIMATE) if name in self.sources]
        return {b: {a: self.distance(a, b) for a in SAMPLED_SOURCES if a in self.sources} for b in known}

    def record(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            **versions_record(),
            "run": str(self.run.path),
            "guide_sha256": self.run.guide_hash(),
            "model": self.run.record["model"],
            "target": str(self.target),
            "classes": list(self.classes),
            "notes": list(self.notes),
            "readings": self.run.readings.get("classes", {}),
            "outcome": self.run.outcome,
            "distances": self.distances(),
            "count_errors": {name: _plain(found) for name, found in self.errors.items()},
            "walls": {
                "lists": [found.record() for found in self.saturated_lists],
                "images": [found.record() for found in self.unreachable_counts],
            },
            "sources": {name: self._source(source) for name, source in self.sources.items()},
            "read_in_renders": {name: self._source(source) for name, source in self.read.items()},
            "log_prob": {name: _plain(found) for name, found in self.likelihoods.items()},
            "images": {
                name: {source: {one.name: image_record(one) for one in found} for source, found in distances.items()}
                for name, distances in self.images.items()
            },
        }

    def _source(self, source: Source) -> dict[str, Any]:
        return {
            "scenes": len(source.total),
            "mean_number": float(source.total.mean()),
            "means": {name: float(source.counts[:, c].mean()) for c, name in enumerate(self.classes)},
            "number": _plain(source.number()),
            "classes": _plain(source.classes()),
            "each_class": {name: histogram(source.counts[:, c]).tolist() for c, name in enumerate(self.classes)},
            "children": {
                _key(relation): {
                    group: _fields(found.histogram()) | {"mean": _plain(found.mean())} for group, found in each.items()
                }
                for relation, each in source.nested.items()
            },
        }


@dataclass(frozen=True)
class ImageComparison:
    """What images are compared by.

    Args:
        networks: whose features give KID and FID, see ``scene_features.network``; none by default, as it renders.
        num_images: at most, of each side; all where None.
    """

    networks: Sequence[str] = ()
    num_images: int | None = MAX_IMAGES


def evaluate(
    run: RunFolder,
    target: Images | None,
    truth: Labels | None,
    progress: Progress,
    num: int = 10000,
    seed: int = 0,
    compared: ImageComparison = ImageComparison(),
    visible: Visible | None = None,
) -> Evaluation:
    """Count sampled structures of the prior and of the guide, the truth's and the network's estimate.

    Args:
        target: its images; without them there is only the run's own record of what the network saw.
        truth: the labels of the target's images.
        num: structures a source; see ``visible.MAX_RENDERED`` where they are rendered for it, and ``MAX_RENDERS_READ``.
        compared: what images are compared by, if by anything.
        visible: least visible shares of what is counted in rendered scenes; those of the run where this is None.

    Raises:
        ProbsceneError: a number that is not positive; see ``image_distances`` and ``visibility``.
        RunError: the fit is not finished.
    """
    if num < 1:
        raise ProbsceneError(f"expected a positive number of scenes, got {num}.")
    if compared.networks and target is None:
        raise ProbsceneError("expected the target's images to compare features with, got none.")
    policies = {**baseline_policies(run.model), LEARNT: run.guide}
    criterion, notes = visibility(run.model, run, truth, visible)
    done = 0

    def advance(scenes: int) -> None:
        nonlocal done
        done += scenes
        progress("counting", done, len(policies) * num_counted(criterion, num), "")

    columns = list(range(len(run.model.classes))) if truth is None else truth.columns(run.model)
    distances = {}
    if compared.networks and target is not None:
        distances = image_distances(run, target, compared.networks, progress, compared.num_images, seed)
    sources, likelihoods = {}, {}
    for name, policy in policies.items():
        found = count_scenes(run.model, policy, num, seed, criterion, advance)
        sources[name] = Source.from_counts(found.counts, found.children).select(columns)
        if truth is not None and truth.derivation is not None:
            likelihoods[name] = likelihood(policy, truth.derivation)
    if truth is not None:
        sources["truth"] = Source.from_counts(truth.structures.counts, truth.structures.children, seed=1)
    reading = features_read(run, target, progress)
    estimate, read = None if reading is None else _estimate(run, reading), dict[str, Source]()
    if estimate is not None:
        sources[ESTIMATE] = estimate.select(columns)
        in_renders = renders_read(run, policies, progress, num, seed)
        read = {name: found.select(columns) for name, found in in_renders.items()}
    path = run.target if target is None else target.path
    classes = tuple(run.model.classes[c] for c in columns)
    notes += hidden_note(run.model, run.guide, truth, criterion) + (() if truth is None else truth.notes)
    short = saturated_lists(run.model, run.guide, None if run.unread else estimate, seed)
    beyond = _unreachable_counts(run, classes, sources, target, criterion is not None)
    errors = {} if truth is None else _errors(run, classes, truth, reading)
    boxes = None if truth is None else truth.boxes
    return Evaluation(run, path, classes, sources, likelihoods, distances, notes, short, beyond, errors, read, boxes)


def _unreachable_counts(
    run: RunFolder,
    classes: tuple[str, ...],
    sources: dict[str, Source],
    target: Images | None,
    visible: bool,
) -> tuple[UnreachableCounts, ...]:
    """By the labels, else by the estimate of the classes whose instances can be counted."""
    by = next((name for name in ("truth", ESTIMATE) if name in sources), None)
    if by is None:
        return ()
    source = sources[by]
    if by == ESTIMATE:
        columns = [c for c, name in enumerate(classes) if name not in (*run.model.stuff, *run.unread)]
        classes, source = tuple(classes[c] for c in columns), source.select(columns)
    names = [] if target is None else [file.name for file in target.paths]
    names = names if len(names) == len(source.counts) else []
    return unreachable_counts(run.model, source, classes, by == "truth", names, visible)


def warn_of_saturated_lists(run: RunFolder, show: Display) -> None:
    """Warn of each list of a finished run that is too short for its own target, by its guide and its network."""
    for text in saturation_warnings(saturated_lists(run.model, run.guide, network_counts(run, None, show))):
        show.say(text)


def network_counts(run: RunFolder, target: Images | None, progress: Progress) -> Source | None:
    """What the run's feature network counts in the target's images, rounded; None where it does not count all classes.

    The features that the fit kept are taken where the images are the fit's, else the images are embedded.
    """
    names = run.feature_names
    if estimate_counts(run.model, names, torch.zeros(0, len(names))) is None:
        return None
    read = features_read(run, target, progress)
    return None if read is None else _estimate(run, read)


def features_read(run: RunFolder, target: Images | None, progress: Progress) -> torch.Tensor | None:
    """The features ``(L, D)`` of the target's images, counts in objects; None where they count no class, or where there
    is neither a target nor what the fit kept."""
    if not counted_classes(run.model, run.feature_names):
        return None
    features, done, total = kept_features(run, target), 0, 0 if target is None else len(target)

    def advance(images: int) -> None:
        nonlocal done
        done += images
        progress("target", done, total, "")

    if features is None and target is None:
        return None
    net = own_net(run)
    if features is None and target is not None:
        features = features_in(run, target, net, advance)
    return None if features is None else objects_counted(net, features)


def _estimate(run: RunFolder, read: torch.Tensor) -> Source | None:
    found = estimate_counts(run.model, run.feature_names, read)
    return None if found is None else Source(*found, seed=1)


def _errors(
    run: RunFolder, classes: tuple[str, ...], truth: Labels, read: torch.Tensor | None
) -> dict[str, CountErrors | None]:
    """Of the labelled classes that the network can count in the target's images."""
    labelled, names = truth.structures.counts, counted_classes(run.model, run.feature_names)
    counts = None if read is None else class_counts(run.model, run.feature_names, read)
    errors = dict.fromkeys(classes, None)
    if counts is None or (truth.rows is None and len(counts) != len(labelled)):
        return errors
    rows = np.arange(len(counts)) if truth.rows is None else np.asarray(truth.rows)
    for name in classes:
        if name in names and name not in run.unread:
            read_in = counts[:, names.index(name)].double().numpy()
            others = np.delete(read_in, rows)
            errors[name] = count_errors(read_in[rows], labelled[:, classes.index(name)], others)
    return errors


def renders_read(
    run: RunFolder, policies: Mapping[str, Policy], progress: Progress, num: int, seed: int = 0
) -> dict[str, Source]:
    """What the run's feature network, which counts, reads in the first images that ``generate`` would write with
    structures of each policy, rounded.

    Args:
        num: images of each, of which ``MAX_RENDERS_READ`` are read at most.
    """
    net, num, done = own_net(run), min(num, MAX_RENDERS_READ), 0

    def advance(images: int) -> None:
        nonlocal done
        done += images
        progress("comparing", done, len(policies) * num, "")

    found = {}
    for name, policy in policies.items():
        features = features_of(run, policy, num, net, seed, advance)
        read = estimate_counts(run.model, run.feature_names, objects_counted(net, features))
        assert read is not None
        found[name] = Source(*read)
    return found


def _distance(one: Tally, other: Tally) -> dict[str, Any] | None:
    return _plain(one.distance(other))


def _key(relation: Relation) -> str:
    return f"{relation[1]} per {relation[0]}"


def _plain(found: Any) -> dict[str, Any] | None:
    return None if found is None else _fields(found)


def _fields(found: Any) -> dict[str, Any]:
    """A tuple with names for JSON, and the tuples in it."""
    inner = {key: _plain(x) if isinstance(x, tuple) else x for key, x in found._asdict().items()}
    return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in inner.items()}
