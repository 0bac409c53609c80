"""What ``StochasticEM`` learns from readings whose errors are known, and which sites a split likelihood ratio selects.

    python benchmarks/estimator.py [spreads] [pairs] [siblings] [circle] [flat] [size] [power] [time]

No image is drawn: a reading is the true u and a normal error, of which the standard deviation is told. What is learnt
is sampled from the guide and put beside what is true.
"""

import argparse
import time

import torch
from scipy.stats import kstest
from torch import Tensor

from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.split_likelihood_ratio import log_e_values, significant
from probscene.inference.parameters.stochastic_em import StochasticEM
from probscene.inference.parameters.values import Values
from probscene.threads import use_threads

ROUND_RATE = 1e-3  # of rounds after the first
DRAWS = 5  # of the images of a pair


def read(nodes: Tensor, scene: Tensor, sd: list[float], turns: tuple[int, ...] = ()) -> Values:
    """Readings of u of nodes ``(L, M, S)`` and of scenes ``(L, G)``, each site with an error of its own."""
    S, on_circle = nodes.shape[2], torch.zeros(len(sd), dtype=torch.bool)
    on_circle[list(turns)] = True
    both = []
    for u, error, circle in zip(
        (nodes, scene), torch.tensor(sd).tensor_split([S]), on_circle.tensor_split([S]), strict=True
    ):
        mean = u + error * torch.randn(u.shape)
        both.append((mean.where(~circle, mean.remainder(1.0)), error.expand(u.shape).clone()))
    kind = torch.zeros(nodes.shape[:2], dtype=torch.int64)
    return Values(kind, torch.full_like(kind, -1), *both[0], *both[1], on_circle)


@torch.no_grad()
def sample(net: ParameterNet, num: int, nodes: int) -> tuple[Tensor, Tensor]:
    """u of nodes ``(N, M, S)`` and scenes ``(N, G)`` of a guide."""
    kind = torch.zeros(num, nodes, dtype=torch.int64)
    graph = SceneGraph.from_nodes(kind, torch.full_like(kind, -1))
    scene, u = torch.full((num, net.scene_sites), torch.nan), torch.full((num, nodes, net.node_sites), torch.nan)
    for g in range(net.scene_sites):
        scene[:, g] = net.scene_mixture(graph, scene, g).icdf(torch.rand(num, 1))[:, 0]
    for s in range(net.node_sites):
        u[..., s] = net.sample(graph, scene, u, s, torch.rand(num, nodes), kind >= 0)
    return u, scene


def normal_within(mean: float, sd: float, *shape: int) -> Tensor:
    """Draws of a normal distribution that is cut off at 0 and 1."""
    v = 0.5 + 0.5 * torch.erf((torch.tensor([0.0, 1.0]) - mean) / sd / 2**0.5)
    at = v[0] + torch.rand(shape) * (v[1] - v[0])
    return (mean + sd * 2**0.5 * torch.erfinv(2 * at - 1)).clamp(1e-4, 1 - 1e-4)


def correlation(one: Tensor, other: Tensor) -> float:
    """Of all their values."""
    return float(torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1])


def pair(*shape: int) -> Tensor:
    """u ``(..., 2)``, the second the first and a little."""
    u = normal_within(0.5, 0.16, *shape)
    return torch.stack([u, (u + 0.02 * torch.randn(shape)).clamp(1e-4, 1 - 1e-4)], -1)


def shares_height(images: int, nodes: int) -> Tensor:
    """u ``(L, M, 1)`` that nearly are one in an image."""
    height = normal_within(0.5, 0.2, images, 1, 1)
    return (height + 0.01 * torch.randn(images, nodes, 1)).clamp(1e-4, 1 - 1e-4)


def within(u: Tensor) -> tuple[float, float]:
    """Correlation of neighbours ``(L, M, 1)`` and the standard deviation of their differences."""
    return correlation(u[:, 1:], u[:, :-1]), float((u[:, 1:] - u[:, :-1]).std())


def fit(net: ParameterNet, values: Values, seed: int, first: bool = True, steps: int = 500) -> StochasticEM:
    """One round."""
    rate, steps = (5e-3, steps) if first else (ROUND_RATE, round(0.6 * steps))
    training = StochasticEM(net, values, steps, learning_rate=rate, seed=seed, from_prior=first)
    training.run()
    return training


def spreads() -> None:
    """Four rounds, whose readings are anew, at three ratios of errors to what is true."""
    for error in (0.05, 0.15, 0.25):
        torch.manual_seed(0)
        u, net = normal_within(0.4, 0.124, 2000, 5, 1), ParameterNet(1, 1, 0)
        for number in range(4):
            fit(net, read(u, torch.zeros(2000, 0), [error]), number, number == 0)
            learnt = sample(net, 4000, 5)[0]
            print(
                f"spread  error {error} round {number}: sd {learnt.std():.4f} ({learnt.std() / u.std() - 1:+.1%}), "
                f"mean {learnt.mean() - u.mean():+.4f}",
                flush=True,
            )


def pairs() -> None:
    """u1 = u0 + N(0, .02), one read badly, the other well, in two rounds, of ``DRAWS`` draws of the images."""
    for where, images, nodes in (("scene", 4000, 1), ("node", 4000, 1), ("node", 1000, 5)):
        for sd in ([0.15, 0.01], [0.01, 0.15]):
            found = torch.zeros(2, DRAWS, 3)
            for seed in range(DRAWS):
                torch.manual_seed(seed)
                u, of_scene = pair(images, nodes), where == "scene"
                net = ParameterNet(1, 0, 2) if of_scene else ParameterNet(1, 2, 0)
                for number in range(2):
                    none = torch.zeros(images, 0)
                    values = read(u[..., :0], u[:, 0], sd) if of_scene else read(u, none, sd)
                    fit(net, values, 2 * seed + number, number == 0)
                    learnt = sample(net, 4000, nodes)[1 if of_scene else 0]
                    both, true = ((x[..., 0], x[..., 1]) for x in (learnt, u))
                    found[number, seed] = torch.tensor(
                        [correlation(*both), correlation(*true), (both[0] - both[1]).std()]
                    )
            for number, rows in enumerate(found):
                r, true, apart = rows.T
                print(
                    f"pair  {where} x {nodes} errors {sd} round {number}: correlation {r.mean():.3f} ({r.min():.3f} to "
                    f"{r.max():.3f}; true {true.mean():.3f}), sd of the difference {apart.mean():.3f} (true 0.020)",
                    flush=True,
                )


def siblings() -> None:
    """Five that share a height, in two rounds."""
    for error in (0.05, 0.1):
        torch.manual_seed(0)
        u, net = shares_height(1000, 5), ParameterNet(1, 1, 0)
        for number in range(2):
            training = fit(net, read(u, torch.zeros(1000, 0), [error]), number, number == 0)
            (r, apart), (true, true_apart) = within(sample(net, 4000, 5)[0]), within(u)
            print(
                f"siblings  error {error} round {number}: correlation {r:.3f} ({true:.3f}), apart {apart:.4f} "
                f"({true_apart:.4f}); accepted "
                + ", ".join(f"{name} {share:.2f}" for name, share in training.accepted.items()),
                flush=True,
            )


def circle() -> None:
    """Angles around u = 0 and 1."""
    for error in (0.03, 0.08):
        torch.manual_seed(0)
        u, net = (0.05 * torch.randn(1000, 5, 1)).remainder(1.0), ParameterNet(1, 1, 0)
        fit(net, read(u, torch.zeros(1000, 0), [error], (0,)), 0)
        learnt = (sample(net, 4000, 5)[0] + 0.5).remainder(1.0)
        print(f"circle  error {error}: sd {learnt.std():.4f} (.05), mean {learnt.mean() - 0.5:+.4f}", flush=True)


def flat() -> None:
    """A site without information beside one that is learnt."""
    for sd in (10.0, float("inf")):
        torch.manual_seed(0)
        u = torch.cat([normal_within(0.4, 0.1, 1000, 5, 1), torch.rand(1000, 5, 1)], -1)
        values = read(u, torch.zeros(1000, 0), [0.05, min(sd, 10.0)])
        values.nodes_sd[..., 1] = sd
        values.nodes[torch.rand(1000, 5, 2) < 0.2] = torch.nan
        net = ParameterNet(1, 2, 0)
        fit(net, values, 0)
        learnt = sample(net, 4000, 5)[0]
        far = kstest(learnt[..., 1].flatten().numpy(), "uniform").statistic
        print(f"flat  sd {sd}: KS distance {far:.3f}; other site sd {learnt[..., 0].std():.4f} (.1)", flush=True)


def size() -> None:
    """Sites that have the prior, of guides of ten and of held-out images."""
    learnt, total = 0, 0
    for seed in range(20):
        torch.manual_seed(seed)
        net = ParameterNet(1, 5, 5, hidden=32)
        parts = [read(torch.rand(200, 2, 5), torch.rand(200, 5), [0.05, 0.15] * 5) for _ in range(2)]
        fit(net, parts[0], seed, steps=100)
        log_e = log_e_values(net, parts[1])
        learnt, total = learnt + int(significant(log_e).sum()), total + len(log_e)
    print(f"size  {learnt} of {total} sites that have the prior are learnt", flush=True)


def power() -> None:
    """Sites of scenes whose mean is shifted or whose spread is scaled, sixteen at once, in ten guides."""
    shifts, scales = [0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2], [0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4]
    effect = torch.tensor([*shifts, *scales])
    for error in (0.05, 0.15):
        found = {number: torch.zeros(len(effect)) for number in (50, 200, 1000)}
        for seed in range(10):
            torch.manual_seed(seed)
            v, first = torch.rand(2000, len(effect)), len(shifts)
            u = torch.cat([shifted(v[:, :first], effect[:first]), 0.5 + (v[:, first:] - 0.5) * effect[first:]], 1)
            values = read(torch.zeros(2000, 1, 0), u, [error] * len(effect))
            net = ParameterNet(1, 0, len(effect), hidden=32)
            fit(net, values.select(torch.arange(1000)), seed, steps=200)
            for number in found:
                found[number] += significant(log_e_values(net, values.select(1000 + torch.arange(number))))
        for number, times in found.items():
            cells = [f"{e:g}: {int(n)}" for e, n in zip([*shifts, *scales], times.tolist(), strict=True)]
            print(f"power  error {error}, {number} held-out images; learnt of 10 by mean + " + ", ".join(cells[:first]))
            print("    by spread x " + ", ".join(cells[first:]), flush=True)


def shifted(v: Tensor, by: Tensor) -> Tensor:
    """u of the density 1 + 12 by (u - 1/2), of a mean of 1/2 + by, at quantiles v. Above 1/6, all is moved the
    rest of the way to 1."""
    tilt = 12 * by.clamp(max=1 / 6 - 1e-3)
    u = (tilt / 2 - 1 + ((1 - tilt / 2).square() + 2 * tilt * v).sqrt()) / tilt
    mean = 0.5 + tilt / 12
    return 1 - (1 - u) * (0.5 - by) / (1 - mean)


def seconds() -> None:
    """CPU milliseconds a step, of 200 images of ten nodes that have four sites."""
    torch.manual_seed(0)
    values = read(torch.rand(1000, 10, 4), torch.zeros(1000, 0), [0.1] * 4)
    training, start = StochasticEM(ParameterNet(1, 4, 0), values, steps=40), time.process_time()
    training.run()
    print(f"time  {1e3 * (time.process_time() - start) / 40:.0f} ms", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables = {"spreads": spreads, "pairs": pairs, "siblings": siblings, "circle": circle, "flat": flat}
    tables |= {"size": size, "power": power, "time": seconds}
    parser.add_argument("tables", nargs="*", help=", ".join(tables))
    use_threads(1)
    for name in parser.parse_args().tables or tables:
        tables[name]()


if __name__ == "__main__":
    main()
