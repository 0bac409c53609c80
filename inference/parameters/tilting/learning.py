"""Parameters by how images look as wholes, without a reader: what it reads in photographs, of which it has seen none,
may be anything.

A round draws scenes x of the guide q, renders them, and moves q downhill in the energy distance [1] of their features
from the target's images r. With own renders x', that distance changes with the probability of a scene by

    w(x) = E |x - r| - E |x - x'|

so that exp(-eta w) q is a step of mirror descent on it, a natural gradient step of length eta [2]. Most of w is chance:
where objects stand, and noise. So the step is along v, what a linear regression on numbers of the chosen sites says of
w. The guide is fitted to it by maximum likelihood, on scenes drawn in proportion to exp(-eta v), as in the
cross-entropy method [3]; eta is as large as leaves a given effective share of them, but smaller where v could be chance
as well [6]. Distances to the target that no parameter changes, as photographs are not renders, are the same for all
scenes and weigh nothing.

Several sorts of features each have a w, in units of the gradient's norm; along their sum none of the distances grows,
as in multiple-gradient descent [4].

Only sites of the whole scene are moved, such as light and camera: were places left to whole images, objects would stand
where photographs are dark. A site keeps its prior until w has depended on it beyond chance. Axis letters: N scenes, M
nodes, G sites of scenes, L images, D features.

References:
    [1] Székely and Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
    [2] Amari, *Natural gradient works efficiently in learning*, Neural Computation 1998.
    [3] Rubinstein, *The cross-entropy method for combinatorial and continuous optimization*, 1999.
    [4] Désidéri, *Multiple-gradient descent algorithm for multiobjective optimization*, 2012.
    [5] Benjamini and Hochberg, *Controlling the false discovery rate*, 1995.
    [6] Ezekiel, *Methods of correlation analysis*, 1930: the adjusted coefficient of determination.
"""

from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import root_scalar
from scipy.spatial.distance import cdist
from scipy.stats import chi2, false_discovery_control
from torch import Tensor, nn

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything

from ...statistics.energy import Features
from ...training import AdamTraining, Callback, TrainingLoop, batch_seed, of_prefix
from ..guide import ParameterGuide
from ..net import ParameterNet
from ..sites import U_EPS, Site, find_sites
from ..supervised_renders import Label, SupervisedRenders, concatenate
from ..values import Values, images_per_step, log_density
from .schedule import TiltingSchedule

RENDERS_PER_CALL = 100  # scenes that are drawn and rendered together
MAX_SCENES = 200  # of a step of the guide
FALSE_DISCOVERY_RATE = 0.05  # of the sites that are moved, at most, say nothing of images in the mean [5]
MAX_ETA = 1e3  # eta, in standard deviations of w
MIN_UNIT = 0.1  # share of w's standard deviation
MIN_SD = 1e-5  # standard deviation of a number that tells scenes apart
EXACT_SD = 1e-6  # standard deviation of u that is known
Look = Callable[[Tensor], Tensor]


class TiltingLearning(TrainingLoop):
    """A ``Training`` of a ``ParameterGuide``.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        label: renders and labels scenes.
        looks: give features ``(N, D)`` of images, of several sorts.
        real: the target's features ``(L, D)`` by each.
        schedule: how long.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        sites: of the model.
        open_to: sites of scenes that can be moved.
        dependence: ``(G, 2)`` how much w has depended on each, and by how many degrees of freedom, until it was moved.
        chosen: ``(G,)`` bool, which are moved.
        guide: what is learnt, of all of them; None where there are none.
    """

    unit = "rounds"
    subject = "the parameters"
    seed_path = (1,)

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        label: Label,
        looks: tuple[Look, ...],
        real: tuple[Tensor, ...],
        schedule: TiltingSchedule,
        seed: int = 0,
    ):
        self.model, self.structure, self.looks, self.schedule = model, structure, looks, schedule
        self.real = [features.double().numpy() for features in real]
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        self.open_to = tuple(site for site in self.sites if site.of_scene and not site.keeps)
        self.renders = SupervisedRenders(model, label, (), self.open_to)
        self.guide = ParameterGuide(model, self.open_to, structure) if self.open_to else None
        self.dependence = torch.zeros(len(self.open_to), 2)
        self.chosen = torch.zeros(len(self.open_to), dtype=torch.bool)
        net = nn.Module() if self.guide is None else self.guide.net
        super().__init__(net, {}, schedule.rounds if self.open_to else 0, seed)

    @property
    def learnt(self) -> tuple[Site, ...]:
        """The sites that are chosen, in the order of the program."""
        return tuple(site for site, chosen in zip(self.open_to, self.chosen.tolist(), strict=True) if chosen)

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``."""
        self._set_prior_sites()
        super().run(callback)

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        own = {"done": torch.tensor(self.done), "chosen": self.chosen, "dependence": self.dependence}
        net = {f"guide.{key}": value for key, value in self.module.state_dict().items()}
        return {key: value.clone() for key, value in (own | net).items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        self.done, self.chosen = int(tensors["done"]), tensors["chosen"].clone()
        self.dependence = tensors["dependence"].clone()
        self.module.load_state_dict(of_prefix(tensors, "guide."))

    def step(self) -> float:
        """A round. Its loss is the sum of the squared energy distances of the renders that were drawn, in units of the
        target's spread."""
        guide = self.guide
        assert guide is not None
        features, values = self._drawn(guide, self.schedule.scenes if self.done else self.schedule.first)
        each = [witness(own, real) for own, real in zip(features, self.real, strict=True)]
        freed = [without_structure(values.kind, w) for w, _ in each]
        w = normalised_sum(values.scene, freed)
        self.dependence += dependence(values.scene, w).where(~self.chosen.unsqueeze(1), 0.0)
        p = chi2.sf(self.dependence[:, 0].numpy(), self.dependence[:, 1].numpy().clip(min=1))
        self.chosen |= torch.from_numpy(false_discovery_control(p) < FALSE_DISCOVERY_RATE)
        self._set_prior_sites()
        if self.chosen.any():
            of = values.scene[:, self.chosen]
            v, sure = explained_part(of, normalised_sum(of, freed))
            weight = tilted_weights(v, 1 - sure * (1 - self.schedule.ess_fraction))
            seed = batch_seed(self.seed, 2, self.done)
            _WeightedLikelihood(guide.net, values, weight, self.chosen, self.schedule, seed).run()
        return sum(apart for _, apart in each)

    def _set_prior_sites(self) -> None:
        if self.guide is not None:
            self.guide.prior_sites = frozenset(site.name for site in self.open_to if site not in self.learnt)

    @torch.no_grad()
    def _drawn(self, guide: ParameterGuide, num: int) -> tuple[list[Features], Values]:
        """Features ``(N, D)`` of the guide's renders by each look, and their scenes' values of all sites."""
        model, features, parts = guide.with_parameters(self.model), [], []
        for first in range(0, num, RENDERS_PER_CALL):
            some = self.renders.draw(min(RENDERS_PER_CALL, num - first), self.structure, model)
            features.append([look(some.drawn.image) for look in self.looks])
            parts.append(some._replace(drawn=some.drawn._replace(image=some.drawn.image[..., :0])))  # to save memory
        of, turns = concatenate(parts), torch.zeros(len(self.chosen), dtype=torch.bool)
        scene, none = of.scene_u.clamp(U_EPS, 1 - U_EPS), of.u
        values = Values(of.kind, of.parent, none, none, scene, torch.full_like(scene, EXACT_SD), turns)
        return [torch.cat(part).double().numpy() for part in zip(*features, strict=True)], values


class _WeightedLikelihood(AdamTraining):
    """Maximum likelihood of values that are known, of scenes in proportion to their weight ``(N,)``; of the chosen
    sites."""

    subject = "the parameters"

    def __init__(
        self, net: ParameterNet, values: Values, weight: Features, chosen: Tensor, schedule: TiltingSchedule, seed: int
    ):
        adam = torch.optim.Adam(net.parameters(), lr=schedule.rate)
        super().__init__(net, adam, schedule.steps, seed, max_grad_norm=10.0)
        self.net, self.values, self.weight, self.chosen = net, values, torch.from_numpy(weight), chosen
        self.images = images_per_step(net, values, MAX_SCENES)

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        rows = torch.multinomial(self.weight, self.images, replacement=True)
        return -log_density(self.net, self.values.select(rows))[:, self.chosen].sum(1).mean()


def witness(own: Features, real: Features) -> tuple[Features, float]:
    """w of each scene ``(N,)``, by features ``(N, D)`` of all and of the target ``(L, D)``; and the squared energy
    distance, without bias. Both in units of how far the target's images are apart."""
    toward, among, within = cdist(own, real), cdist(own, own), cdist(real, real)
    among, within = (each.sum(1) / max(1, len(each) - 1) for each in (among, within))
    spread = max(float(within.mean()), MIN_SD)
    return (toward.mean(1) - among) / spread, float(2 * toward.mean() - among.mean() - within.mean()) / spread


def without_structure(kind: Tensor, w: Features) -> Features:
    """w without what a linear regression on the number and the presence of each kind of node ``(N, M)`` explains: it is
    structure's, which is not moved here."""
    number = np.stack([(kind == k).sum(1).numpy() for k in kind.unique()], 1)
    x = np.concatenate([number, number > 0, np.ones((len(w), 1))], 1).astype(np.float64)
    return w - x @ np.linalg.lstsq(x, w, rcond=None)[0]


def normalised_sum(u: Tensor, each: list[Features]) -> Features:
    """The sum of several w, each in its ``unit``."""
    return np.stack([w / unit(u, w) for w in each]).sum(0)


def unit(u: Tensor, w: Features) -> float:
    """The standard deviation of what sites' u ``(N, G)`` explain of w: the norm of the gradient that a guide of these
    sites can follow. A tenth of w's own, if that is more."""
    return max(float(explained_part(u, w)[0].std()), MIN_UNIT * float(w.std()), MIN_SD)


def explained_part(u: Tensor, w: Features) -> tuple[Features, float]:
    """What a linear regression on numbers of sites' u ``(N, G)`` says of w, less its mean, ``(N,)``; and the share of
    its standard deviation that is more than chance would give, 0 to 1."""
    x, y = np.concatenate([basis(one) for one in u.unbind(1)], 1), w - w.mean()
    slope, _, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    v = x @ slope
    found, left, freedom = np.square(v).sum(), np.square(y - v).sum(), len(y) - 1 - int(rank)
    return v, max(0.0, 1 - float(rank * left / freedom / found)) ** 0.5 if found and freedom > 0 else 0.0


def basis(u: Tensor) -> Features:
    """``(N, 4)`` of a site's u ``(N,)``, by which anything may depend on it: smooth on a line or on a circle."""
    x = torch.stack([u, u.square(), (2 * torch.pi * u).cos(), (2 * torch.pi * u).sin()], 1).double().numpy()
    return x - x.mean(0)


def tilted_weights(w: Features, ess_fraction: float) -> Features:
    """Weights ``(N,)`` in proportion to exp(-eta w), of which so many are effective as ``kept`` says, a share."""
    z = -(w - w.mean()) / max(float(w.std()), 1e-12)

    def weight(eta: float) -> Features:
        found = np.exp(eta * (z - z.max()))
        return found / found.sum()

    def more(eta: float) -> float:
        return 1 / np.square(weight(eta)).sum() / len(w) - ess_fraction

    if ess_fraction >= 1:
        return weight(0.0)
    return weight(root_scalar(more, bracket=(0.0, MAX_ETA)).root if more(MAX_ETA) < 0 else MAX_ETA)


def dependence(u: Tensor, w: Features) -> Tensor:
    """``(G, 2)``: N times the share of w's variance that a linear regression on numbers of each site's u ``(N, G)``
    explains, and the degrees of freedom; if w does not depend on the site, a draw of their chi-squared distribution."""
    rows, y = [], w - w.mean()
    for one in u.unbind(1):
        left, singular, _ = np.linalg.svd(basis(one), full_matrices=False)
        left = left[:, singular > MIN_SD * len(y) ** 0.5]
        found, whole = np.square(left.T @ y).sum(), np.square(y).sum()
        rows.append((len(y) * float(found / whole) if whole else 0.0, float(left.shape[1])))
    return torch.tensor(rows).reshape(-1, 2)
