"""From objects that a reader finds to scene graphs: who is whose child, and who comes first.

What a grammar says of that is seen in derivations of the prior: which kinds hang below which, and which of two siblings
of different kinds comes first. Where siblings are exchangeable, any order of them is as good under the prior, but not
for a guide that goes from one to the next: they are ordered along the axis along which they vary most in the images,
unless the model's own program orders them along one. Siblings that hang below several nodes without a class, such as
lanes, are not exchangeable, and in which group each is cannot be read: they come in random order, of which a guide
learns no more than holds for any. Axis letters: L images, M nodes, K objects.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from probscene.grammar import Grammar

from .graph import SceneGraph, class_of
from .reader import Detections

FREE, SHUFFLED = -1, -2  # axes
ORDERED = 0.9  # share of the prior's neighbouring siblings that stand in the order of an axis, which is then theirs


class SceneGraphBuilder(NamedTuple):
    """What a model's scenes have in common.

    Attributes:
        kinds: ``(C,)`` int64 the grammar's kind of each class.
        above: ``(C, C + 1)`` bool, whether a class hangs below another; the last column is below none.
        stage: ``(C,)`` int64: siblings of a lower stage come first.
        axis: ``(C,)`` int64, 0 for x and 1 for y, along which siblings of a class's stage are ordered; ``FREE``, or
            ``SHUFFLED``.
    """

    kinds: Tensor
    above: Tensor
    stage: Tensor
    axis: Tensor

    def scenes(self, found: Detections, number: int) -> list[list[tuple[int, int]]]:
        """For each of so many images, the objects in the order of a derivation, each with the place of its parent in
        that list; -1 for none."""
        each = [[] for _ in range(number)]
        for k, image in enumerate(found.image.tolist()):
            each[image].append(k)
        label, above, stage, axis = (part.tolist() for part in (found.label, self.above, self.stage, self.axis))

        def parent_of(k: int, objects: list[int]) -> int:
            """The object nearest to where object ``k`` says that its parent is; -1 for none."""
            some = [j for j in objects if above[label[k]][label[j]] and j != k]
            if not some:
                return -1
            away = (found.centre[some] - found.parent[k]).norm(dim=-1)
            return some[int(away.argmin())]

        def scene(objects: list[int]) -> list[tuple[int, int]]:
            drawn = dict(zip(objects, torch.rand(len(objects)).tolist(), strict=True))
            below: dict[int, list[int]] = {}
            for k in objects:
                below.setdefault(parent_of(k, objects), []).append(k)
            order: list[tuple[int, int]] = []

            def key(k: int) -> tuple[int, float]:
                way = axis[label[k]]
                return stage[label[k]], drawn[k] if way == SHUFFLED else float(found.centre[k, way])

            def add(parent: int, place: int) -> None:
                for k in sorted(below.get(parent, []), key=key):
                    order.append((k, place))
                    add(k, len(order) - 1)

            add(-1, -1)
            return order

        return [scene(some) for some in each]

    def values(self, found: Detections, number: int, mean: Tensor, sd: Tensor) -> tuple[Tensor, ...]:
        """Kind and parent ``(L, M)`` of the scene graphs, and the mean and standard deviation of their sites
        ``(L, M, S)``, of what was read ``(K, S)``; NaN where a node is none."""
        scenes = self.scenes(found, number)
        M = max(1, *(len(some) for some in scenes)) if scenes else 1
        object_of, parent = torch.full((2, number, M), -1)
        for i, some in enumerate(scenes):
            for m, (k, place) in enumerate(some):
                object_of[i, m], parent[i, m] = k, place
        there = object_of >= 0
        index = object_of.clamp(min=0)
        kind = torch.where(there, self.kinds[found.label[index]], -1) if len(found.label) else object_of
        return kind, parent, *(_spread_out(part, index, there) for part in (mean, sd))


def fit_scene_graph_builder(
    grammar: Grammar, classes: tuple[str, ...], graph: SceneGraph, centre: Tensor, group: Tensor | None = None
) -> SceneGraphBuilder:
    """From scenes of the prior.

    Args:
        graph: their nodes of some class.
        centre: ``(N, M, 2)`` pixels of those that can be seen; NaN of others.
        group: ``(N, M)`` int64 the node of the derivation that each hangs below, whether that has a class or not.
    """
    C = len(classes)
    kinds = torch.tensor([grammar.kind(name) for name in classes])
    label = class_of(graph.kind, kinds)
    above = torch.zeros(C, C + 1, dtype=torch.bool)
    n, m = (label >= 0).nonzero(as_tuple=True)
    parent = graph.parent[n, m]
    above[label[n, m], torch.where(parent >= 0, label[n, parent.clamp(min=0)], C)] = True
    earlier = torch.zeros(C, C, dtype=torch.bool)  # some sibling of the one class comes before one of the other
    siblings = (graph.parent.unsqueeze(2) == graph.parent.unsqueeze(1)) & (label >= 0).unsqueeze(2)
    scene, later, first = (siblings & (label >= 0).unsqueeze(1)).tril(-1).nonzero(as_tuple=True)
    earlier[label[scene, first], label[scene, later]] = True
    has = graph.before[n, m] >= 0
    stage = _stages(earlier)
    axis = torch.zeros(C, dtype=torch.int64)
    one, other = centre[n[has], graph.before[n, m][has]], centre[n[has], m[has]]
    of_class, together = label[n, m][has], stage[label[n[has], graph.before[n, m][has]]] == stage[label[n, m][has]]
    for number_of in stage.unique().tolist():
        rows = (stage[of_class] == number_of) & together & ~(one + other).isnan().any(1)
        forward = (other[rows] > one[rows]).float().mean(0) if rows.any() else torch.zeros(2)
        ordered = (forward >= ORDERED).nonzero().flatten()
        axis[stage == number_of] = int(forward.argmax()) if len(ordered) else FREE
    if group is not None:
        mixed = group[scene, first] != group[scene, later]
        of_first, of_later = (stage[label[scene, index]] for index in (first, later))
        for number_of in of_first[mixed & (of_first == of_later)].unique().tolist():
            axis[(stage == number_of) & (axis == FREE)] = SHUFFLED
    return SceneGraphBuilder(kinds, above, stage, axis)


def order_by_variance(builder: SceneGraphBuilder, found: Detections) -> SceneGraphBuilder:
    """With an axis for the siblings that no program orders: that along which the objects found vary most."""
    axis = builder.axis.clone()
    for stage in builder.stage.unique().tolist():
        free = (builder.stage == stage) & (axis == FREE)
        if not free.any():
            continue
        some = free[found.label]
        spread = torch.zeros(2)
        for image in found.image[some].unique().tolist():
            rows = some & (found.image == image)
            spread += found.centre[rows].var(0, correction=0) * rows.sum()
        axis[free] = int(spread.argmax())
    return builder._replace(axis=axis)


def _stages(earlier: Tensor) -> Tensor:
    """``(C,)``: a class comes after all that only ever come before it; those that do both are of one stage."""
    C = len(earlier)
    reach = earlier.clone()
    for k in range(C):
        reach |= reach[:, k : k + 1] & reach[k : k + 1]
    strictly = reach & ~reach.T
    stage = torch.zeros(C, dtype=torch.int64)
    for _ in range(C):
        stage = torch.where(strictly, (stage + 1)[:, None], 0).amax(0)
    return stage


def _spread_out(part: Tensor, index: Tensor, there: Tensor) -> Tensor:
    """``(L, M, S)`` of ``(K, S)``."""
    if not len(part):
        return torch.full((*index.shape, part.shape[1]), torch.nan)
    return part[index].where(there.unsqueeze(-1), torch.nan)
