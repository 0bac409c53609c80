"""What labels would count in rendered scenes: objects that can be seen, instead of all that a structure has.

A street's structure holds cars behind other cars, beside the image and too far away to be labelled: of the driving
model's cars in a city, about one in eight has no visible pixel, and one in four more is lower than 25 of KITTI's. Where
labels are of what can be seen, so is what they are compared with. People leave out what is hidden for the most part,
too: how much of an object of a class must be seen for them to count it is its least visible share.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch

from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError, RunError
from probscene.model import SceneModel
from probscene.policy import Policy

from ..chunks import CHUNK, draw_chunk
from ..datasets.coco import labelled
from ..fitting.store import Storage
from ..loading import renderer_for
from .labels import Labels
from .structure_counts import Counts, StructureCounts, sample_counts

MAX_RENDERED = 2000  # scenes, to be counted
HIDDEN_SCENES = 128  # that are rendered to measure how many objects are hidden
HARDLY_VISIBLE = 0.25  # visible share of an object
MIN_HIDDEN_SHARE = 0.02  # of a class's objects that are hardly visible, from which on it is noted

Callback = Callable[[int], None]  # called with the number of scenes of each batch
Visible = float | Mapping[str, float] | Sequence[str]
"""Least visible shares, 0 to 1: of every class, by class, or in words such as ``"0.25"`` and ``"rbc=0.6"``."""


class Visibility(NamedTuple):
    """What must be visible of an object for labels to count it; some pixel in any case.

    Attributes:
        min_height: of its box, pixels of the canvas.
        shares: by class, of its silhouette; 0 for others.
    """

    min_height: float = 0.0
    shares: Mapping[str, float] = {}


def visibility(
    model: SceneModel, run: Storage, truth: Labels | None, given: Visible | None
) -> tuple[Visibility | None, tuple[str, ...]]:
    """What must be visible of an object to be counted, None where whole structures are, and notes for a person.

    Args:
        run: its own shares are taken where none are given.
        given: the shares.

    Raises:
        ProbsceneError: see ``visible_shares``; shares for labels that are whole structures.
    """
    if isinstance(given, Sequence | Mapping) and not given:
        given = None
    if truth is not None and truth.derivation is not None:
        if given is not None:
            raise ProbsceneError(
                "expected labels of what can be seen with a visible share, got whole structures; leave out the "
                "share, or give labels that people made."
            )
        return None, ()
    shares = _of_run(model, run) if given is None else visible_shares(given, model.classes)
    if given is None and not shares:
        return (None if truth is None or truth.min_height is None else Visibility(truth.min_height)), ()
    text = _percentages(shares) if given is not None else _shares_with_source(run, shares)
    note = f"Prior and learnt scenes are rendered, and objects counted of which at least this is visible: {text}."
    return Visibility(0.0 if truth is None else truth.min_height or 0.0, shares), (note,)


def visible_shares(given: Visible, classes: tuple[str, ...]) -> dict[str, float]:
    """Least visible shares by class, all classes if one is for all.

    Raises:
        ProbsceneError: not a share from 0 to 1, no class of the model, or one twice.
    """
    if isinstance(given, int | float):
        pairs = [("", given)]
    elif isinstance(given, Mapping):
        pairs = list(given.items())
    else:
        pairs = [(name, _number(share)) for name, _, share in (word.rpartition("=") for word in given)]
    found: dict[str, float] = {}
    for name, share in pairs:
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
            raise ProbsceneError(f"expected a visible share from 0 to 1, or CLASS=SHARE, got {share!r}.")
        if name in found:
            raise ProbsceneError(f"expected one visible share {f'of {name}' if name else 'of all classes'}, got two.")
        found[name] = float(share)
    if unknown := next((name for name in found if name and name not in classes), None):
        raise ProbsceneError(
            f"expected a visible share of a class among {', '.join(classes)}, got {unknown!r}; fix the name."
        )
    every = {name: found[""] for name in classes} if "" in found else {}
    return every | {name: share for name, share in found.items() if name}


def hidden_shares(model: SceneModel, policy: Policy, columns: Sequence[int], seed: int = 0) -> dict[str, float]:
    """Of each of some classes, the share of the objects in scenes of ``policy`` that are hardly visible; classes
    without objects are left out.

    Args:
        columns: the classes, by number.
    """
    render, drawn, hardly = renderer_for(model), torch.zeros(len(columns)), torch.zeros(len(columns))
    kinds = torch.tensor([model.grammar.kind(model.classes[c]) for c in columns]).view(-1, 1, 1)
    for chunk in range(HIDDEN_SCENES // CHUNK):
        batch = render(draw_chunk(model, policy, seed, chunk).drawing)
        of_class = batch.kind == kinds
        drawn += of_class.sum((1, 2))
        hardly += (of_class & (batch.visible < HARDLY_VISIBLE)).sum((1, 2))
    shares = zip((model.classes[c] for c in columns), (hardly / drawn).tolist(), strict=True)
    return {name: share for name, share in shares if math.isfinite(share)}


def hidden_note(
    model: SceneModel, policy: Policy, truth: Labels | None, criterion: Visibility | None
) -> tuple[str, ...]:
    """A note that labels are compared with whole structures, where many objects are hidden."""
    if truth is None or truth.derivation is not None or criterion is not None:
        return ()
    shares = {
        name: share
        for name, share in hidden_shares(model, policy, truth.columns(model)).items()
        if share > MIN_HIDDEN_SHARE
    }
    if not shares:
        return ()
    text = ", ".join(f"{100 * share:.0f} % of {name}" for name, share in shares.items())
    return (
        "Counts are compared with whole structures; in learnt scenes, less than a quarter of some objects is visible "
        f"({text}). If labels leave out hidden objects, add --visible {HARDLY_VISIBLE:g}, or --visible CLASS=SHARE.",
    )


def num_counted(criterion: Visibility | None, num: int) -> int:
    """The number of scenes that ``count_scenes`` counts of ``num``."""
    return num if criterion is None else min(num, MAX_RENDERED)


def count_scenes(
    model: SceneModel,
    policy: Policy,
    num: int,
    seed: int,
    criterion: Visibility | None,
    callback: Callback | None = None,
) -> StructureCounts:
    """The counts of scenes with structures from ``policy``: of visible objects in renders where there is a criterion,
    else as ``sample_counts`` gives them."""
    if criterion is None:
        return sample_counts(model, policy, num, seed, callback)
    return StructureCounts(count_visible(model, policy, num_counted(criterion, num), seed, criterion, callback), {})


def count_visible(
    model: SceneModel, policy: Policy, num: int, seed: int, criterion: Visibility, callback: Callback | None = None
) -> Counts:
    """The labels ``(num, C)`` by class of what ``generate`` would write in KITTI's format and is visible enough; the
    same for the same seed."""
    render, parts = renderer_for(model), []
    numbers = torch.arange(1, len(model.classes) + 1).view(-1, 1, 1)
    min_share = torch.tensor([criterion.shares.get(name, 0.0) for name in model.classes]).view(-1, 1, 1)
    for chunk, first in enumerate(range(0, num, CHUNK)):
        batch = render(draw_chunk(model, policy, seed, chunk).drawing[: num - first])
        enough = (_height(model, batch) >= criterion.min_height) & (batch.visible >= min_share)
        parts.append(((labelled(model, batch) == numbers) & enough).sum(2).T)
        if callback is not None:
            callback(len(parts[-1]))
    return torch.cat(parts).numpy()


def _percentages(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items())


def _shares_with_source(run: Storage, shares: Mapping[str, float]) -> str:
    """The same, with what each class was read by in the run's images."""
    records, words = run.readings["classes"], dict[str, dict[str, float]]()
    for name, share in shares.items():
        without = records[name].get("by") == "agreement"
        how = "as its network reads the target's images without labels" if without else "as the run's labels were read"
        words.setdefault(how, {})[name] = share
    return "; ".join(f"{_percentages(some)}, {how}" for how, some in words.items())


def _of_run(model: SceneModel, run: Storage) -> dict[str, float]:
    shares = run.visible_shares()
    try:
        return visible_shares(shares, model.classes)
    except ProbsceneError as error:
        raise RunError(f"expected visible shares of the model's classes in {run.path}, got {shares}.") from error


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _height(model: SceneModel, batch: RenderBatch) -> torch.Tensor:
    """The height ``(N, M)`` of the boxes that ``kitti.label`` writes."""
    if batch.space is None:
        return batch.box[..., 3] - batch.box[..., 1]
    top, bottom = ((batch.amodal_box[..., i] - 0.5).clamp(0, model.canvas[0] - 1) for i in (1, 3))
    return bottom - top
