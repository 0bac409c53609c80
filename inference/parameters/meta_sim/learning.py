"""Parameters by distribution matching, Meta-Sim's way [1].

Scenes are drawn from the structure's policy and the prior's parameters. A graph network moves their parameters. The
loss is the MMD of features of their images from those of the target's, and its gradient goes through the renderer by
finite differences (``differences``). All continuous sites of nodes that have a class and of the scene are moved: unlike
``ParameterLearning``, nothing says which of them images show. Axis letters: L images, D features.

References:
    [1] Kar et al., *Meta-Sim: Learning to Generate Synthetic Datasets*, ICCV 2019, section 3.
"""

import math

import torch
from torch import Tensor, nn

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything

from ...training import TrainingLoop, batch_seed
from ..sites import Site, find_sites
from .differences import Differences, Embed, SampledScenes
from .discrepancy import Discrepancy
from .schedule import MetaSimSchedule
from .transform import ParameterTransform

MAX_GRAD_NORM = 1.0


class MetaSimLearning(TrainingLoop):
    """A ``Training`` of a ``ParameterTransform``.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        embed: renders scenes and gives their features ``(N, D)``.
        real: the target's features ``(L, D)``.
        schedule: how long.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        sites: of the model.
        learnt: those that are moved, in the order of the program.
        guide: what is learnt; None where there is no site to move.
    """

    subject = "the parameters"
    seed_path = (1,)

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        embed: Embed,
        real: Tensor,
        schedule: MetaSimSchedule,
        seed: int = 0,
    ):
        self.model, self.structure, self.schedule = model, structure, schedule
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        self.learnt: tuple[Site, ...] = tuple(site for site in self.sites if not site.keeps)
        self.differences = Differences(model, self.learnt, embed, schedule.difference, schedule.values)
        self.discrepancy = Discrepancy(real)
        self.guide: ParameterTransform | None = None
        if not self.learnt:
            super().__init__(nn.Module(), {}, 0, seed)
            return
        self.guide = ParameterTransform(model, self.learnt, structure, schedule.hidden, schedule.rounds)
        self.optimiser = torch.optim.Adam(self.guide.net.parameters(), lr=schedule.rate)
        super().__init__(self.guide.net, {"adam": self.optimiser}, schedule.steps, seed)

    def why_not(self, site: Site) -> str:
        """Why a site is not learnt."""
        return site.keeps

    def step(self) -> float:
        """See ``TrainingLoop``."""
        guide = self.guide
        assert guide is not None
        for group in self.optimiser.param_groups:
            group["lr"] = self.schedule.rate * 0.5 * (1 + math.cos(math.pi * self.done / self.total))
        drawn = SampledScenes.sample(self.model, self.structure, self.learnt, self.schedule.scenes)
        scene, nodes = (logit.sigmoid() for logit in guide.net(drawn.graph, drawn.of_scene, drawn.of_nodes))
        features = self.differences.features(drawn, scene.detach(), nodes.detach()).requires_grad_()
        loss = self.discrepancy(features)
        (slope,) = torch.autograd.grad(loss, features)
        of_scene, of_nodes = self.differences.gradient(drawn, scene.detach(), nodes.detach(), slope)
        self.optimiser.zero_grad()
        ((scene * of_scene).sum() + (nodes * of_nodes).sum()).backward()
        torch.nn.utils.clip_grad_norm_(guide.net.parameters(), MAX_GRAD_NORM)
        self.optimiser.step()
        return loss.item()
