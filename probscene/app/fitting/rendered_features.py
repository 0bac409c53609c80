"""A model seen through its renderer and a feature network, as a fit sees it.

Axis letters: N scenes, M nodes, D features, C H W.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.dataset import grey
from probscene.derivation import Derivation, group_of
from probscene.inference.features.base import EmbedsLabels, Examples, FeatureNet, class_table, examples, needs_images
from probscene.model import SceneModel
from probscene.relations import relations
from probscene.sampling import Scenes, run_program, sample
from probscene.threads import threads

from ..chunks import chunk_randomness
from ..loading import renderer_for
from ..workers.actor_pool import ActorPool

RENDERED_AT_ONCE = 64  # images in memory

Observe = Callable[[Scenes], Tensor]
"""Features ``(N, D)`` of scenes."""


class Chunk(NamedTuple):
    """Some structures of a batch, ``rules (N, T)``, and what their parameters are drawn from."""

    rules: Tensor
    seed: int
    number: int


class RenderedFeatures:
    """A model seen through its renderer: ``Renders`` to train on, and features of scenes.

    Args:
        model: the scene model.
        threads: of the renderer and of torch, while it observes.
    """

    def __init__(self, model: SceneModel, threads: int):
        self.model, self.threads = model, threads
        self.render = renderer_for(model, threads)
        self.classes = class_table(model.grammar.kinds, model.classes)
        carriers = {parent for parent, _ in relations(model.grammar)}
        self.covered = torch.tensor([kind in carriers for kind in model.grammar.kinds] + [True])  # the last is padding

    def draw(self, num: int, beyond_prior: bool = False) -> Examples:
        """``num`` labelled renders of the prior; or of the policy that guides are pretrained on, which may have more of
        everything."""
        policy = self.model.pretraining_policy if beyond_prior else self.model.prior
        return self.labelled(sample(self.model, policy, num))

    def draw_twice(self, num: int) -> Examples:
        """Labelled renders of ``num`` structures of the policy that guides are pretrained on, and as many more of the
        same structures, their parameters anew."""
        scenes = sample(self.model, self.model.pretraining_policy, num)
        both = self.labelled(scenes), self.labelled(run_program(self.model, scenes.derivation))
        return Examples(*(torch.cat(parts) for parts in zip(*both, strict=True)))

    def labelled(self, scenes: Scenes, rows: slice = slice(None), pictured: bool = True) -> Examples:
        """Some of the scenes, rendered, with their labels; images may be black where they need not be ``pictured``."""
        groups, grammar = self.model.groups, self.model.grammar
        group, along = None, "y"
        if groups is not None:
            derivation = scenes.derivation[rows]
            group = group_of(derivation.kind, derivation.parent, grammar.kind(groups.kind))
            along = groups.along
        render = self.render if pictured else getattr(self.render, "labels", self.render)
        drawn = examples(render(scenes.drawing[rows]), self.classes, group, along)
        return drawn._replace(image=self._as_read(drawn.image))

    def embed_twice(self, num: int, net: FeatureNet) -> tuple[Tensor, Tensor]:
        """Features, two times ``(num, D)``, of ``num`` structures of that policy and of the same drawn anew."""
        observe, scenes = self.observe(net), sample(self.model, self.model.pretraining_policy, num)
        return observe(scenes), observe(run_program(self.model, scenes.derivation))

    def object_size(self, num: int = 256) -> float:
        """How small objects are in the prior's renders, pixels: a tenth of those that can be seen have boxes of less
        than the square of this; infinite where there are none."""
        batch = self.render(sample(self.model, self.model.prior, num).drawing)
        seen = (self.classes[batch.kind] >= 0) & (batch.pixels > 0)
        size = (batch.amodal_box[..., 2:] - batch.amodal_box[..., :2]).prod(-1)[seen].sqrt()
        return float(size.quantile(0.1)) if len(size) else math.inf

    def observe(self, net: FeatureNet, draws_per_structure: int = 1) -> Observe:
        """Render and embed, a few images at a time.

        Args:
            draws_per_structure: parameters are drawn so many times for each structure, and the drawing in which the
                least visible object shows most is kept: what covers an object says nothing about its structure. A
                network that goes by labels counts what can be seen, of one drawing.
        """

        pictured = needs_images(net)

        def features(scenes: Scenes) -> Tensor:
            with threads(self.threads):
                starts = range(0, len(scenes.drawing), RENDERED_AT_ONCE)
                if isinstance(net, EmbedsLabels):
                    parts = (self.labelled(scenes, slice(i, i + RENDERED_AT_ONCE), pictured) for i in starts)
                    return torch.cat([net.embed_from_labels(some) for some in parts])
                images = (self._clearest(scenes, slice(i, i + RENDERED_AT_ONCE), draws_per_structure) for i in starts)
                return torch.cat([net.embed(self._as_read(some)) for some in images])

        return features

    def resample_and_embed(
        self, net: FeatureNet, draws_per_structure: int = 1, crew: ActorPool | None = None
    ) -> Observe:
        """Features of scenes of the same structures, their parameters drawn anew: each part of a batch from a seed and
        its number, so that it does not matter where that is done.

        Args:
            draws_per_structure: see ``observe``.
            crew: actors that do it, prepared to do ``Chunk``s by ``part``; else this process does.
        """

        def features(scenes: Scenes) -> Tensor:
            seed = int(torch.randint(1 << 62, ()))
            some = scenes.derivation.rules.split(RENDERED_AT_ONCE)
            parts = [
                Chunk(rules.clone(), seed, number) for number, rules in enumerate(some)
            ]  # a view has all to pickle
            if crew is None:
                return torch.cat([self.part(part, net, draws_per_structure)[1] for part in parts])
            found: list[tuple[int, Tensor]] = []
            crew.run(parts, found.append)
            return torch.cat([features for _, features in sorted(found, key=lambda pair: pair[0])])

        return features

    def part(self, some: "Chunk", net: FeatureNet, draws_per_structure: int) -> tuple[int, Tensor]:
        """A part's number and its features ``(N, D)``."""
        with chunk_randomness(some.seed, some.number), torch.no_grad():
            derivation = Derivation.from_rules(self.model.grammar, some.rules)
            return some.number, self.observe(net, draws_per_structure)(run_program(self.model, derivation))

    def _as_read(self, images: Tensor) -> Tensor:
        """Renders ``(N, 3, H, W)`` as ``ImageFolder`` would read them from files, ``(N, channels, H, W)``."""
        return grey(images) if self.model.channels == 1 else images

    def _clearest(self, scenes: Scenes, rows: slice, draws_per_structure: int) -> Tensor:
        """Images ``(N, 3, H, W)``, each of the drawing that covers least of its least visible object."""
        batch, derivation = self.render(scenes.drawing[rows]), scenes.derivation[rows]
        image, best = batch.image, self._least_visible(batch)
        for _ in range(draws_per_structure - 1):
            again = (best < 1).nonzero().flatten()  # nothing is clearer than what is whole
            if not len(again):
                break
            batch = self.render(run_program(self.model, derivation[again], density=False).drawing)
            least = self._least_visible(batch)
            better = least > best[again]
            image[again[better]], best[again[better]] = batch.image[better], least[better]
        return image

    def _least_visible(self, batch: RenderBatch) -> Tensor:
        """``(N,)`` visible fraction of the least visible object; what can have others on it is meant to be covered."""
        return batch.visible.where(~self.covered[batch.kind], 1.0).amin(1)
