"""Maximum likelihood of a parameter guide on readings: stochastic approximation EM with Metropolis chains [1, 2].

A reading x of u is a normal distribution on 0..1, or a uniform one for a share of outliers, that is proportional to the
likelihood p(x | u), as u is uniform under the prior. A guide g is fitted by empirical Bayes, that is, by the largest

    sum over images of log of the integral of p(x | u) g(u) du,

where u are all values of an image. The gradient is the posterior mean of that of log g(u) (Fisher's identity). Every
image keeps one u. A step moves those of some images by two Metropolis-Hastings kernels, both of which leave their
posterior, in proportion to p(x | u) g(u), as it is; then Adam takes one step on -log g(u).

- ``redraw``: some values of an image at once, each one of several: its own and ``POOL`` draws from its reading. The
  choice goes by g(u_i | values before), in the context of the present state. The readings cancel, as a pool is
  exchangeable under them. What is left of the ratio is that g of later values, and the choices, depend on the context.
- ``correlated_redraw``: some values of an image at once from their joint distribution given their readings and the
  other values, where g is replaced by a normal distribution n(u) of the whole image. The readings cancel here too:
  u' is accepted with probability min(1, g(u') n(u) / (g(u) n(u'))), but for the outliers, by which readings differ
  from the normal distributions of the proposal. A value that is read badly and is tied to one that
  is read well, or to those of siblings, seldom moves otherwise.

In both kernels g has weights that are averaged over some steps, as stochastic approximation averages its statistics:
the chains follow g, so what a step's gradient has by chance would stay in them.

EM goes slowly where a dependence is much narrower than the errors of readings: a variance D under errors of variance N
falls as N / sqrt(2 t) with the number t of iterations, even of exact ones. So chains begin at draws of n, whose
covariance is the readings' without that of their errors (``NormalApproximation``), a consistent start [3].

A value without a reading has an infinite (or NaN) standard deviation: its likelihood is flat and it follows the guide.
Axis letters: L images, M nodes, S sites of nodes, G sites of scenes, D = M S + G values of an image, C candidates.

References:
    [1] Delyon, Lavielle, Moulines, *Convergence of a stochastic approximation version of the EM algorithm*, Ann. Stat.
    1999.
    [2] Kuhn and Lavielle, *Coupling a stochastic approximation version of EM with an MCMC procedure*, ESAIM P&S 2004.
    [3] Searle, Casella, McCulloch, *Variance Components*, 1992: estimates from mean squares.
    [4] Tjelmeland, *Using all Metropolis-Hastings proposals to estimate mean values*, 2004: one of several candidates.
    [5] Hoffman and Ribak, *Constrained realizations of Gaussian fields*, ApJ 1991: draws of a conditional normal.
"""

import math
from typing import NamedTuple, cast

import torch
from torch import Tensor
from torch.distributions import Categorical
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from ..training import AdamTraining, batch_seed, of_prefix
from .graph import SceneGraph
from .mixture import LogisticMixture
from .net import ParameterNet
from .reader import truncated_quantile
from .recalibration import negative_log_likelihood
from .sites import U_EPS
from .values import SiteConditioning, Values, images_per_step

INITIAL_SHARE = 0.5  # of the steps of a guide that is the prior
POOL = 8  # draws from a reading that a value is chosen from, beside itself
AVERAGED_SHARE = 0.02  # of the steps, that the moving average of weights is over
MIN_SPREAD = 0.01  # least standard deviation of a combination of values under the normal approximation
MIN_PART = 1e-3  # least share of a variance that nodes share, and least one that they do not
FLAT_VARIANCE = 1 / 12  # of a uniform number
MIN_INFORMATION = 32.0  # readings, without errors, by which a variance is known to a quarter of itself
MAX_JOINT = 80  # values of nodes that are proposed from the normal approximation together
HELD, ABSENT = 1e-8, 1e6  # variance of a pseudo-reading of a value that is known, and of one that is not there


class Readings(NamedTuple):
    """Readings of images as vectors of D values: those of nodes, node by node, and then of the scene.

    Attributes:
        values: as they were given.
        mean, sd: ``(L, D)``; a value that is not there has .5, one without a reading an infinite sd.
        turns: ``(D,)`` bool, those read on a circle.
        weight: ``(L, D)`` how much each counts; 0 for a value that is not there.
        there: ``(L, D)`` bool.
        outliers: ``(D,)`` the share of readings that say nothing.
    """

    values: Values
    mean: Tensor
    sd: Tensor
    turns: Tensor
    weight: Tensor
    there: Tensor
    outliers: Tensor

    @staticmethod
    def from_values(values: Values) -> "Readings":
        """Of some images."""
        L, M, S = values.nodes.shape
        mean, sd = flatten(values.nodes, values.scene), flatten(values.nodes_sd, values.scene_sd)
        weight = torch.ones(L, M) if values.weight is None else values.weight
        weight = flatten(weight.unsqueeze(-1).expand(L, M, S), torch.ones_like(values.scene))
        there = ~mean.isnan()
        turns = torch.cat([values.turns[:S].repeat(M), values.turns[S:]])
        of_site = torch.zeros(len(values.turns)) if values.outliers is None else values.outliers
        outliers = torch.cat([of_site[:S].repeat(M), of_site[S:]])
        sd = sd.where(sd.isfinite(), torch.inf)
        return Readings(values, mean.nan_to_num(0.5), sd, turns, weight.where(there, 0.0), there, outliers)

    def draw(self, number: int) -> Tensor:
        """u ``(number, L, D)`` from the readings alone, uniform where there are none."""
        v, read = torch.rand(number, *self.mean.shape), self.sd.isfinite()
        sd = self.sd.where(read, 1.0)
        circle = (self.mean + sd * math.sqrt(2) * torch.erfinv(2 * v - 1)).remainder(1.0)
        u = torch.where(self.turns, circle, truncated_quantile(self.mean, sd, v))
        u = u.where(read & (torch.rand(v.shape) >= self.outliers), torch.rand(v.shape))
        return u.clamp(U_EPS, 1 - U_EPS)

    def columns(self, index: Tensor) -> "Readings":
        """One value of each image, ``(L,)``, alone: its readings ``(L, 1)``."""
        parts = (self.mean, self.sd, self.weight, self.there)
        mean, sd, weight, there = (part.gather(1, index[:, None]) for part in parts)
        return Readings(self.values, mean, sd, self.turns[index][:, None], weight, there, self.outliers[index][:, None])

    def log_density(self, u: Tensor) -> Tensor:
        """``(L, D)`` of u ``(L, D)``, as ``draw`` draws them."""
        sd = self.sd.where(self.sd.isfinite(), 1.0)
        line, circle = (-negative_log_likelihood(self.mean, sd, u, on_circle) for on_circle in (False, True))
        normal = torch.where(self.turns, circle, line) + (1 - self.outliers).log()
        return torch.logaddexp(normal, self.outliers.log().expand_as(u)).where(self.sd.isfinite(), 0.0)

    def squared_error(self, u: Tensor) -> Tensor:
        """``(L, D)`` of u ``(L, D)`` on a line, in standard deviations; 0 without a reading."""
        return ((u - self.mean) / self.sd).square()

    def unflatten(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """``(L, M, S)`` and ``(L, G)`` of u ``(L, D)``, NaN where a value is not there."""
        nodes, scene = self.values.nodes, self.values.scene
        first = nodes.shape[1] * nodes.shape[2]
        return (
            u[:, :first].view(nodes.shape).where(~nodes.isnan(), torch.nan),
            u[:, first:].where(~scene.isnan(), torch.nan),
        )


def flatten(nodes: Tensor, scene: Tensor) -> Tensor:
    """``(L, D)`` of ``(L, M, S)`` and ``(L, G)``."""
    return torch.cat([nodes.flatten(1), scene], 1)


def conditionals(net: ParameterNet, readings: Readings, u: Tensor) -> LogisticMixture:
    """``(L, D)`` mixtures, g of each value given those before it in u ``(L, D)``; uniform where one is not there."""
    graph = SceneGraph.from_nodes(readings.values.kind, readings.values.parent)
    nodes, scene = readings.unflatten(u)
    sites, parts = SiteConditioning(net, graph), []
    for s in range(net.node_sites):
        given = sites.given(scene, nodes, s)
        parts.append([given.subset.scatter(part) for part in net.subset_mixture(given, nodes, s)])
    of_nodes = [torch.stack(part, 2).flatten(1, 2) for part in zip(*parts, strict=True)]
    of_scenes = [net.scene_mixture(graph, scene, g) for g in range(net.scene_sites)]
    every = [*([of_nodes] if of_nodes else []), *of_scenes]
    return LogisticMixture(*(torch.cat(part, 1) for part in zip(*every, strict=True)))


class NormalApproximation(NamedTuple):
    """A normal distribution of the u of an image: effects that its nodes share, and nodes that are alike given these.

    Attributes:
        known: ``(S + G,)`` bool, sites that it is for: not of circles, and readings tell their variance.
        mean: ``(S + G,)``.
        shared: ``(S + G, S + G)`` covariance of what nodes share and of scenes' sites.
        own: ``(S, S)`` covariance of a node's own values around that.
    """

    known: Tensor
    mean: Tensor
    shared: Tensor
    own: Tensor

    @staticmethod
    def from_values(values: Values) -> "NormalApproximation":
        """By moments of the readings of images; the errors' variance is subtracted where a reading meets itself."""
        (L, M, S), G = values.nodes.shape, values.scene.shape[1]
        u, sd = (
            torch.cat([nodes, scene.unsqueeze(1).expand(L, M, G)], 2).double()
            for nodes, scene in ((values.nodes, values.scene), (values.nodes_sd, values.scene_sd))
        )
        weight = (FLAT_VARIANCE / (FLAT_VARIANCE + sd.square())).where(~u.isnan() & sd.isfinite(), 0.0)
        if values.weight is not None:
            weight[..., :S] *= values.weight.unsqueeze(-1)
        information = weight.square().sum((0, 1)) / torch.tensor([1] * S + [M] * G)
        known = (information > MIN_INFORMATION) & ~values.turns
        weight = weight.where(known, 0.0)
        mean = ((weight * u.nan_to_num()).sum((0, 1)) / weight.sum((0, 1))).where(known, 0.5)
        away, error = weight * (u - mean).nan_to_num(), (weight * sd).where(weight > 0, 0.0).square()

        def products(part: Tensor) -> Tensor:
            return torch.einsum("lms,lmt->st", part, part)

        def of_pairs(part: Tensor) -> Tensor:  # of nodes of an image, none with itself
            return part.sum(1).T @ part.sum(1) - products(part)

        total = _positive(_mean(products(away) - error.sum((0, 1)).diag(), products(weight)))
        shared, nodes, scene = total.clone(), slice(S), slice(S, None)
        by_scene = total[nodes, scene] @ torch.linalg.solve(total[scene, scene], total[scene, nodes])
        across = _mean(of_pairs(away), of_pairs(weight))[nodes, nodes] - by_scene
        shared[nodes, nodes] = by_scene + _part(across, total[nodes, nodes] - by_scene)
        return NormalApproximation(known, mean, shared, (total - shared)[nodes, nodes])

    def covariance(self, nodes: int) -> Tensor:
        """``(D, D)`` of so many nodes, float64."""
        S = len(self.own)
        of_nodes = self.shared[:S, :S].repeat(nodes, nodes) + torch.kron(torch.eye(nodes).double(), self.own)
        across = self.shared[:S, S:].repeat(nodes, 1)
        return torch.cat([torch.cat([of_nodes, across], 1), torch.cat([across.T, self.shared[S:, S:]], 1)])

    def centre(self, nodes: int) -> Tensor:
        """``(D,)`` mean of so many nodes."""
        S = len(self.own)
        return torch.cat([self.mean[:S].repeat(nodes), self.mean[S:]])


def _mean(total: Tensor, weight: Tensor) -> Tensor:
    """Of products; 0 where too few are known."""
    return (total / weight.clamp(min=1e-9)).where(weight > MIN_INFORMATION, 0.0)


def _positive(covariance: Tensor) -> Tensor:
    """The nearest matrix whose eigenvalues are at least the square of ``MIN_SPREAD``."""
    if not len(covariance):
        return covariance
    value, vector = torch.linalg.eigh((covariance + covariance.T) / 2)
    return vector * value.clamp(min=MIN_SPREAD**2) @ vector.T


def _part(covariance: Tensor, total: Tensor) -> Tensor:
    """The matrix nearest to ``covariance`` that is at least ``MIN_PART`` and at most ``1 - MIN_PART`` times ``total``;
    nearest in coordinates in which ``total`` is the identity."""
    if not len(total):
        return total
    root = torch.linalg.cholesky(total)
    whitened = torch.linalg.solve_triangular(root, covariance, upper=False)
    whitened = torch.linalg.solve_triangular(root, whitened.T, upper=False)
    value, vector = torch.linalg.eigh((whitened + whitened.T) / 2)
    return root @ (vector * value.clamp(MIN_PART, 1 - MIN_PART)) @ vector.T @ root.T


class StochasticEM(AdamTraining):
    """Resumable training of a ``ParameterNet``; its loss is in nats an image.

    Args:
        net: trained in place.
        values: what was read.
        steps: of Adam.
        images: a step, at most.
        learning_rate: the largest.
        seed: of everything random.
        from_prior: whether the net is the prior still; the first half of the steps then fits the normal approximation.

    Attributes:
        nodes, scene: ``(L, M, S)`` and ``(L, G)`` u, the chains' present states; NaN where a value is not there.
        averaged: the net with a moving average of its weights, which the chains follow.
        accepted: share of the proposals of each kernel that were accepted, since the beginning or ``restore``.
    """

    subject = "the parameters"

    def __init__(
        self,
        net: ParameterNet,
        values: Values,
        steps: int = 700,
        images: int = 200,
        learning_rate: float = 5e-3,
        seed: int = 0,
        from_prior: bool = True,
    ):
        super().__init__(net, torch.optim.Adam(net.parameters(), lr=learning_rate), steps, seed, max_grad_norm=10.0)
        self.net, self.values, self.images = net, values, images
        decay = 1 - 1 / max(1.0, AVERAGED_SHARE * steps)
        self.averaged = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(decay))
        self.normal = NormalApproximation.from_values(values)
        self.initial_steps = round(INITIAL_SHARE * steps) if from_prior else 0
        self.nodes, self.scene = values.nodes.clone(), values.scene.clone()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(batch_seed(seed, 1))
            for rows in torch.arange(len(values.kind)).split(images_per_step(self.net, self.values, self.images)):
                readings = Readings.from_values(values.select(rows))
                M = readings.values.kind.shape[1]
                self.nodes[rows, :M], self.scene[rows] = readings.unflatten(self._initial_draw(readings))
        self.proposals = {"redraw": [0, 0], "correlated_redraw": [0, 0]}

    @property
    def accepted(self) -> dict[str, float]:
        """See the class."""
        return {name: yes / max(1, number) for name, (yes, number) in self.proposals.items()}

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        rows = torch.randperm(len(self.values.kind))[: images_per_step(self.net, self.values, self.images)]
        readings = Readings.from_values(self.values.select(rows))
        M = readings.values.kind.shape[1]
        if self.done < self.initial_steps:
            u = self._initial_draw(readings)
        else:
            u = flatten(self.nodes[rows, :M], self.scene[rows]).nan_to_num(0.5)
            with torch.no_grad():
                given = self._averaged_conditionals(readings, u)
                u, given = self._redraw(readings, u, given)
                u, _ = self._correlated_redraw(readings, u, given)
        self.nodes[rows, :M], self.scene[rows] = readings.unflatten(u)
        return -(readings.weight * conditionals(self.net, readings, u).log_prob(u)).sum(1).mean()

    def step(self) -> float:
        """See ``AdamTraining``."""
        loss = super().step()
        self.averaged.update_parameters(self.net)
        return loss

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        averaged = {f"averaged.{name}": tensor.clone() for name, tensor in self.averaged.state_dict().items()}
        return super().state() | averaged | {"chains.nodes": self.nodes.clone(), "chains.scene": self.scene.clone()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        super().restore(tensors)
        self.averaged.load_state_dict(of_prefix(tensors, "averaged."))
        self.nodes, self.scene = tensors["chains.nodes"].clone(), tensors["chains.scene"].clone()

    def _averaged_conditionals(self, readings: Readings, u: Tensor) -> LogisticMixture:
        """``conditionals`` of the net with averaged weights."""
        return conditionals(cast("ParameterNet", self.averaged.module), readings, u)

    def _initial_draw(self, readings: Readings) -> Tensor:
        """u ``(L, D)`` from the normal approximation; from its reading where that is outside of 0..1."""
        u = readings.draw(1)[0]
        new = self._proposal(readings, u, readings.there)[0]
        return new.where((new > 0) & (new < 1), u)

    def _redraw(self, readings: Readings, u: Tensor, given: LogisticMixture) -> tuple[Tensor, LogisticMixture]:
        """See above; u and its ``conditionals`` after it."""
        pool, moved = torch.cat([u.unsqueeze(0), readings.draw(POOL)]), _some(readings.there)
        forth = readings.weight * given.log_prob(pool)
        which = Categorical(logits=forth.movedim(0, -1)).sample().where(moved, 0).unsqueeze(0)
        new = pool.gather(0, which)[0]
        after = self._averaged_conditionals(readings, new)
        back = readings.weight * after.log_prob(pool)
        there, here = back.gather(0, which)[0], forth[0]
        choice = back.log_softmax(0)[0] - forth.log_softmax(0).gather(0, which)[0]
        ratio = (there - here + choice.where(moved, 0.0)).sum(1)
        return self._accept("redraw", ratio, (u, given), (new, after))

    def _correlated_redraw(
        self, readings: Readings, u: Tensor, given: LogisticMixture
    ) -> tuple[Tensor, LogisticMixture]:
        """See above; u and its ``conditionals`` after it."""
        new, ratio = self._proposal(readings, u, _some(readings.there))
        inside = ((new > 0) & (new < 1)).all(1)
        new = new.clamp(U_EPS, 1 - U_EPS)
        after = self._averaged_conditionals(readings, new)
        ratio = ratio + (readings.weight * (after.log_prob(new) - given.log_prob(u))).sum(1)
        if readings.outliers.any():
            old, other = (readings.log_density(at) + readings.squared_error(at) / 2 for at in (u, new))
            ratio = ratio + (other - old).where(new != u, 0.0).sum(1)
        return self._accept("correlated_redraw", ratio.where(inside, -torch.inf), (u, given), (new, after))

    def _proposal(self, readings: Readings, u: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        """u ``(L, D)``, some ``moved`` by their normal approximation given readings and all others, by conditioning a
        draw of the whole [5]; and ``log n(u) - log n(u')`` ``(L,)``. Those that n is not for stay as they are."""
        (L, M, S), D = readings.values.nodes.shape, u.shape[1]
        number = max(1, min(M, MAX_JOINT // max(1, S)))
        order = torch.rand(L, M).where(readings.values.kind >= 0, 2.0).argsort(1)[:, :number]
        nodes = (order.unsqueeze(-1) * S + torch.arange(S)).flatten(1)
        chosen = torch.cat([nodes, torch.arange(M * S, D).expand(L, -1)], 1)
        known = torch.cat([self.normal.known[:S].repeat(M), self.normal.known[S:]])
        there = (readings.there & known).gather(1, chosen)
        moves, old = moved.gather(1, chosen) & there, u.gather(1, chosen).double()
        covariance, centre = self.normal.covariance(number), self.normal.centre(number)
        noise = readings.sd.gather(1, chosen).double().square().clamp(HELD, ABSENT).where(moves, HELD)
        noise = noise.where(there, ABSENT)
        mean = readings.mean.gather(1, chosen).double().where(moves, old)
        whole = torch.randn(L, len(centre)).double() @ torch.linalg.cholesky(covariance).T
        away = mean - centre - whole - noise.sqrt() * torch.randn(L, len(centre)).double()
        step = torch.linalg.solve(covariance + noise.diag_embed(), away.unsqueeze(-1)).squeeze(-1) @ covariance
        new = (centre + whole + step).where(moves, old)
        both = (torch.stack([old, new], -1) - centre.unsqueeze(-1)).where(there.unsqueeze(-1), 0.0)
        own = torch.full_like(old, HELD).where(there, ABSENT)
        squared = (both * torch.linalg.solve(covariance + own.diag_embed(), both)).sum(1)
        ratio = 0.5 * (squared[:, 1] - squared[:, 0])
        return u.scatter(1, chosen, new.float()), ratio.float()

    def _accept(
        self,
        name: str,
        ratio: Tensor,
        old: tuple[Tensor, LogisticMixture],
        new: tuple[Tensor, LogisticMixture],
    ) -> tuple[Tensor, LogisticMixture]:
        """The new state of each image with probability ``exp(ratio)``, at most 1, and else the old one."""
        yes = torch.rand_like(ratio).log() < ratio
        self.proposals[name][0] += int(yes.sum())
        self.proposals[name][1] += len(yes)
        parts = zip(old[1], new[1], strict=True)
        return new[0].where(yes[:, None], old[0]), LogisticMixture(*(b.where(yes[:, None, None], a) for a, b in parts))


def _some(there: Tensor) -> Tensor:
    """``(L, D)`` bool: of each image all values, half of them, a quarter, ..., about one, each as often."""
    levels = 1 + math.ceil(math.log2(max(1, there.shape[1])))
    return there & (torch.rand(there.shape) < 0.5 ** torch.randint(levels, (len(there), 1)))
