"""Which sites are learnt: a split likelihood ratio of a guide against the prior [1].

A guide g is fitted to some images. In others, that it has not seen, each site s has an e-value, the product over images
of

    E[ g(u_s | u of the sites before, structure) ],   u of all sites drawn from their readings,

where u_s are the site's values of all nodes. Where u_s is uniform and independent of all else, its reading is, too, and
an integral of its likelihood times a density is 1 in the mean over readings, whatever the density. So the e-value has
a mean of 1 for any g, and log(e) exceeds log(1 / alpha) with probability alpha at most, by Markov's inequality. So
it does for any estimate without bias: here sequential Monte Carlo over the nodes, that draws one half from readings r
and one half from g, weights by 2 r g / (r + g) (the balance heuristic [3]) and resamples [2].

With S + G sites, a site is learnt where log(e) is at least log((S + G) / alpha): one or more sites that have the prior
are learnt with probability alpha at most (Bonferroni).

Axis letters: L images, M nodes, S sites of nodes, G sites of scenes, P particles.

References:
    [1] Wasserman, Ramdas, Balakrishnan, *Universal inference*, PNAS 2020.
    [2] Del Moral, *Feynman-Kac Formulae*, 2004: the estimate is without bias.
    [3] Veach, Guibas, *Optimally combining sampling techniques for Monte Carlo rendering*, SIGGRAPH 1995.
"""

import math

import torch
from torch import Tensor

from .graph import SceneGraph
from .mixture import LogisticMixture
from .net import NodeSequence, NodeSubset, ParameterNet
from .stochastic_em import Readings
from .values import Values

ALPHA = 0.05  # probability of learning any site that has the prior
PARTICLES = 32
MAX_PARTICLES, MAX_PAIRS = 10_000, 16_000_000  # particles, and pairs of their nodes, looked at together


def log_threshold(sites: int, alpha: float = ALPHA) -> float:
    """The least log e-value of a site that is learnt, of so many."""
    return math.log(max(1, sites) / alpha)


def significant(log_e: Tensor, alpha: float = ALPHA) -> Tensor:
    """``(S + G,)`` bool, which sites are learnt, by ``log_e_values``."""
    return log_e >= log_threshold(len(log_e), alpha)


@torch.no_grad()
def log_e_values(net: ParameterNet, values: Values, particles: int = PARTICLES) -> Tensor:
    """``(S + G,)`` of sites of nodes and of scenes; it draws random numbers.

    Args:
        net: fitted to other images.
        values: what was read of these, without imputed objects.
        particles: P.
    """
    total, S = torch.zeros(net.node_sites + net.scene_sites, dtype=torch.float64), net.node_sites
    at_once = min(MAX_PARTICLES, MAX_PAIRS // max(1, values.kind.shape[1]) ** 2)
    for rows in torch.arange(len(values.kind)).split(max(1, at_once // particles)):
        some = values.select(rows.repeat_interleave(particles))
        readings = Readings.from_values(some)
        nodes, scene = readings.unflatten(readings.draw(1)[0])
        graph = SceneGraph.from_nodes(some.kind, some.parent)
        for s in range(S):
            subset = NodeSubset.from_mask(~nodes[..., s].isnan())
            sequence = NodeSequence(net, net.given(graph, scene, nodes, s, subset), s)
            total[s] += _of_nodes(sequence, readings, S, particles)
        for g in range(net.scene_sites):
            column = torch.full((len(scene),), nodes.shape[1] * S + g)
            _, log_w = _proposed(net.scene_mixture(graph, scene, g), readings.columns(column))
            total[S + g] += _log_mean(log_w.view(-1, particles)).sum()
    return total


def _of_nodes(sequence: NodeSequence, readings: Readings, sites: int, particles: int) -> Tensor:
    """Nats of all images together, of which each has so many particles one after the other."""
    log_e, first = torch.zeros((), dtype=torch.float64), torch.arange(0, len(readings.mean), particles)
    for r in range(sequence.u.shape[1]):
        mixture = LogisticMixture(*(part.unsqueeze(1) for part in sequence.mixture()))
        u, log_w = _proposed(mixture, readings.columns(sequence.given.subset.index[:, r] * sites + sequence.s))
        log_w = log_w.view(-1, particles)
        log_e += _log_mean(log_w).sum()
        sequence.append(u)
        sequence.select((first[:, None] + _systematic(log_w.softmax(1))).flatten())
    return log_e


def _proposed(g: LogisticMixture, readings: Readings) -> tuple[Tensor, Tensor]:
    """u ``(L,)``, every other one from its reading ``(L, 1)`` and from its mixture, and the logarithm of its weight; 0
    of a value that is not there."""
    from_reading = torch.arange(len(readings.mean))[:, None] % 2 == 0
    u = torch.where(from_reading, readings.draw(1)[0], g.icdf(torch.rand_like(readings.mean)))
    log_r, log_g = readings.log_density(u), g.log_prob(u)
    log_w = math.log(2) + log_r + log_g - torch.logaddexp(log_r, log_g)
    return u[:, 0], log_w.where(readings.there, 0.0)[:, 0]


def _log_mean(log_g: Tensor) -> Tensor:
    return log_g.double().logsumexp(1) - math.log(log_g.shape[1])


def _systematic(weight: Tensor) -> Tensor:
    """``(L, P)`` which of the particles of weights ``(L, P)`` are taken, by systematic resampling."""
    P = weight.shape[1]
    at = (torch.rand(len(weight), 1) + torch.arange(P)) / P
    return torch.searchsorted(weight.cumsum(1).contiguous(), at.contiguous()).clamp(max=P - 1)
