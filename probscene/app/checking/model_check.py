"""Checks that run a model: does its program run, is everything that is derived drawn, and can it be seen.

``checks.check`` looks at grammar and prior alone; ``check_model`` also runs the program under the prior and under the
policy of pretraining, and renders some of the scenes. Axis letters: N scenes, M nodes.
"""

from dataclasses import replace
from typing import NamedTuple

import pyro
import torch
from torch import Tensor

from probscene.batch import RenderBatch, Renderer
from probscene.checks import Report, check
from probscene.errors import MachineError, ProbsceneError
from probscene.inference.features.counting.net import CountNet
from probscene.model import SceneModel
from probscene.program_errors import user_errors
from probscene.sampling import Scenes, run_program, sample

from ..chunks import chunk_randomness
from ..loading import renderer_for
from . import randomness
from .program_calls import CallRecorder, long_max_steps, missing_parents, recorded, short_max_steps

SCENES, RENDERED = 256, 32  # how many scenes the program is run on, and how many of them are rendered
QUICK = 64, 16  # the same before a fit
MIN_CLASS_OBJECTS = 5  # below, nothing is concluded of a class
MIN_VISIBLE_SHARE = 0.05  # share of a class's objects that can be seen
MIN_OBJECT_SIZE = 6.0  # pixels that an object needs in what the count network reads, see CountNet.fit_to


class Findings(NamedTuple):
    """What running a model shows: faults, each with a remedy, warnings, and by class the sizes ``(n,)`` of visible
    objects, pixels."""

    faults: list[str]
    warnings: list[str]
    sizes: dict[str, Tensor]


def check_model(
    model: SceneModel, scenes: int = SCENES, rendered: int = RENDERED, again: SceneModel | None = None
) -> Report:
    """``check``, and where that finds no faults, what running the program and rendering its scenes shows.

    The state of all random number generators and Pyro's parameters stay as they were.

    Args:
        scenes: how many the program is run on, shared out between scenarios, and between the prior and the policy of
            pretraining where the model has one.
        rendered: how many of them are rendered, first those that hold each class.
        again: the model of the same file, imported a second time, where that is to be the same.
    """
    report = check(model)
    if report.faults:
        return report
    faults, warnings = [], list(report.warnings)
    sizes: dict[str, list[Tensor]] = {name: [] for name in model.classes}
    each = dict(model.scenarios) or {"": model}
    others = {} if again is None else dict(again.scenarios) or {"": again}
    for name, part in each.items():
        part = replace(part, renderer=model.renderer)
        found = check_program(part, -(-scenes // len(each)), -(-rendered // len(each)), others.get(name))
        before = f"Scenario {name!r}: " if name else ""
        faults += [before + text for text in found.faults]
        warnings += [before + text for text in found.warnings]
        for kind, size in found.sizes.items():
            sizes[kind].append(size)
    warnings += _small_classes(model, {kind: torch.cat(some) for kind, some in sizes.items() if some})
    return replace(report, faults=tuple(faults), warnings=tuple(warnings))


def check_program(model: SceneModel, scenes: int, rendered: int, again: SceneModel | None = None) -> Findings:
    """Run a model's program and render some of its scenes; arguments as of ``check_model``."""
    recorder, store = CallRecorder(model.grammar), pyro.get_param_store()
    with store.scope(store.get_state()), chunk_randomness(0, 0):
        known = set(store.keys())
        try:
            policies = [model.prior] if model.pretraining is None else [model.prior, model.pretraining]
            number = -(-scenes // len(policies))
            drawn = [sample(recorded(model, recorder), policy, number) for policy in policies]
            wrong = [*_not_finite(drawn), *_pyro_params(set(store.keys()) - known)]
            if wrong:
                return Findings(wrong, [], {})
            with user_errors(f"the renderer of model {model.name!r}", model.renderer):
                render = renderer_for(model)
                batches = _rendered(model, render, drawn, rendered)
                few = drawn[0].derivation[_scenes_to_render(model, drawn[0], randomness.SCENES)]
                random = randomness.hidden_randomness(model, few, render, again)
        except MachineError:
            raise
        except ProbsceneError as error:
            return Findings(short_max_steps(model, recorder) or [str(error)], [], {})
    faults, warnings = _visibility(model, batches)
    faults += [*short_max_steps(model, recorder), *random]
    warnings += [
        *long_max_steps(model, recorder),
        *missing_parents(model, recorder, drawn[0]),
        *_colours(model, drawn[0]),
    ]
    return Findings(faults, warnings, {name: _sizes(model.grammar.kind(name), batches) for name in model.classes})


def _not_finite(drawn: list[Scenes]) -> list[str]:
    wrong = {}
    for scenes in drawn:
        for name, value in scenes.parameters.items():
            mask = scenes.site_mask[name]
            bad = ~torch.isfinite(value).flatten(2).all(-1) if value.ndim > 2 else ~torch.isfinite(value)
            number = int((bad.expand(mask.shape) & mask).any(1).sum())
            if number and name not in wrong:
                wrong[name] = (
                    f"Site {name!r} is NaN or infinite in {number} of {len(scenes.derivation)} scenes; bound the "
                    "parameters of its distribution, and divide by nothing that can be 0."
                )
    return list(wrong.values())


def _pyro_params(names: set[str]) -> list[str]:
    return [
        f"The program has pyro.param({name!r}), which no fit learns; make it a number, or a site that parameters are "
        f"learnt of, such as pyro.sample({name!r}, dist.Uniform(low, high))."
        for name in sorted(names)
    ]


def _rendered(
    model: SceneModel, render: Renderer, drawn: list[Scenes], rendered: int
) -> list[tuple[Tensor, RenderBatch]]:
    """The kinds ``(N, M)`` that were derived and the renders of them, for some of each policy's scenes."""
    found = []
    for scenes in drawn:
        some = scenes.derivation[_scenes_to_render(model, scenes, -(-rendered // len(drawn)))].trimmed()
        found.append((some.kind, render(run_program(model, some).drawing)))
    return found


def _scenes_to_render(model: SceneModel, scenes: Scenes, number: int) -> Tensor:
    """The scenes to render: of each class in turn one that holds it, and then the first ones."""
    counts = scenes.derivation.counts(len(model.grammar.kinds))
    holding = [counts[:, model.grammar.kind(name)].nonzero().flatten().tolist() for name in model.classes]
    turns = [rows[i] for i in range(number) for rows in holding if i < len(rows)]
    return torch.tensor(list(dict.fromkeys([*turns, *range(len(counts))]))[:number])


class _Class(NamedTuple):
    """Objects of one class in all renders: how many were derived, drawn with a label and can be seen, and the whole
    silhouettes ``(n, 4)`` of those that were drawn."""

    derived: int
    drawn: int
    seen: int
    box: Tensor


def _visibility(model: SceneModel, batches: list[tuple[Tensor, RenderBatch]]) -> tuple[list[str], list[str]]:
    each = {name: _class(model.grammar.kind(name), batches) for name in model.classes}
    each = {name: found for name, found in each.items() if found.derived}
    faults, warnings = [], []
    for name, found in each.items():
        if not found.drawn:
            faults.append(
                f"Class {name!r} is never drawn: the scenes that were rendered have {found.derived} of them, and no "
                f"layer draws one with a label; give scene.draw(...) a layer of kind {name!r}, or leave it out of "
                "classes."
            )
    hidden = {name: found for name, found in each.items() if found.drawn and not found.seen}
    boxes = [found.box for found in hidden.values()]
    if hidden and len(hidden) == len(each) and sum(found.drawn for found in hidden.values()) >= MIN_CLASS_OBJECTS:
        objects = ", ".join(map(repr, hidden))
        return [f"Nothing that is drawn can be seen ({objects}): {_why_hidden(model, torch.cat(boxes))}."], []
    for name, found in each.items():
        share = found.seen / found.derived
        if name in hidden and found.drawn >= MIN_CLASS_OBJECTS:
            faults.append(f"Class {name!r} can never be seen: {_why_hidden(model, found.box)}.")
        elif found.drawn and share < MIN_VISIBLE_SHARE:
            warnings.append(
                f"Class {name!r} can be seen in {found.seen} of the {found.derived} cases in which it is derived, "
                f"fewer than {100 * MIN_VISIBLE_SHARE:g} %, so that counts of it cannot be learnt; place it on the "
                "canvas and where nothing covers it."
            )
    return faults, warnings


def _class(kind: int, batches: list[tuple[Tensor, RenderBatch]]) -> _Class:
    derived = sum(int((nodes == kind).sum()) for nodes, _ in batches)
    drawn = sum(int((batch.kind == kind).sum()) for _, batch in batches)
    seen = sum(int(((batch.kind == kind) & (batch.pixels > 0)).sum()) for _, batch in batches)
    return _Class(derived, drawn, seen, torch.cat([batch.amodal_box[batch.kind == kind] for _, batch in batches]))


def _why_hidden(model: SceneModel, box: Tensor) -> str:
    """What is wrong with objects of which no pixel shows, and what to do; ``box (n, 4)`` are their silhouettes."""
    height, width = model.canvas
    there = box[(box[:, 2:] > box[:, :2]).all(1)]
    if not len(there):
        return (
            "their silhouettes have no pixel; draw them larger, with opaque pixels in their pictures, and in 3D in "
            "front of the camera"
        )
    inside = (there[:, 2:] > 0).all(1) & (there[:, 0] < width) & (there[:, 1] < height)
    if inside.any():
        return "something covers them wholly; scene.draw(...) takes layers from the back to the front"
    low, high = there[:, :2].amin(0).tolist(), there[:, 2:].amax(0).tolist()
    return (
        f"they stand off the canvas, x from {low[0]:.0f} to {high[0]:.0f} and y from {low[1]:.0f} to {high[1]:.0f}, "
        f"and the canvas is {width} wide and {height} high; place them in pixels from its upper left corner"
    )


def _sizes(kind: int, batches: list[tuple[Tensor, RenderBatch]]) -> Tensor:
    box = torch.cat([batch.amodal_box[(batch.kind == kind) & (batch.pixels > 0)] for _, batch in batches])
    return (box[:, 2:] - box[:, :2]).prod(-1).sqrt()


def _colours(model: SceneModel, drawn: Scenes) -> list[str]:
    """Sites of colours in a model whose images are read as grey."""
    names = [name for name in ("saturation", "red_gain", "blue_gain") if f"photo.{name}" in drawn.parameters]
    if model.channels != 1 or not names:
        return []
    return [
        f"Images of model {model.name!r} are read as grey (channels=1), in which {', '.join(names)} of "
        "scene.photo(...) can be told from the exposure in coloured sprites at best; leave them out."
    ]


def _small_classes(model: SceneModel, sizes: dict[str, Tensor]) -> list[str]:
    """Classes of which half are too small for the count network, as it would reduce the images."""
    sizes = {name: size for name, size in sizes.items() if len(size) >= MIN_CLASS_OBJECTS}
    if not sizes:
        return []
    with torch.random.fork_rng(devices=[]):
        net = CountNet(model.classes, model.channels, model.canvas, groups=model.groups)
    net.fit_to(float(torch.cat(list(sizes.values())).quantile(0.1)))
    middle = {name: float(size.median()) for name, size in sizes.items()}
    small = [f"{name!r} {size:.2g}" for name, size in middle.items() if size / net.reduce < MIN_OBJECT_SIZE]
    if not small:
        return []
    reduced = f", which the count network reduces by {net.reduce}" if net.reduce > 1 else ""
    return [
        f"Objects are small, in pixels: {', '.join(small)}{reduced}; below {MIN_OBJECT_SIZE:g} there they can hardly "
        "be counted; draw them larger."
    ]
