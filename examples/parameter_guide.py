"""A parameter guide, with the training loop in sight: learn where mugs stand from values that were measured.

    python examples/parameter_guide.py

``probscene.fit`` reads values in images (``probscene.inference.parameters.learning``). Here they are known, as from a
tracker or from labels: structures and the values of sites. What is left is Pyro: the guide is conditioned on what was
measured, and the log-probability of its trace is maximised. In the prior a mug stands anywhere around the middle of its
plate; what was measured are mugs to the right of it, closer to it where there are more.
"""

import argparse

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine

import probscene as ps
from probscene.sampling import run_program

GRAMMAR = ps.Grammar("""
    Scene  -> table(Plates)
    Plates -> plate(Mugs) Plates | ε
    Mugs   -> mug Mugs | ε
""")
PRIOR = ps.StructurePrior(GRAMMAR, Plates=ps.counts(0, 1, 1, 1), Mugs=ps.counts(1, 1, 1, 1))


@ps.scene_model(GRAMMAR, PRIOR, canvas=(256, 256), max_steps=60, classes=("plate", "mug"))
def tabletop(scene):
    """Lengths in pixels."""
    with scene.nodes("plate"):
        gap = pyro.sample("plate.gap", dist.Uniform(0.2, 0.8))
        y = pyro.sample("plate.y", dist.Uniform(50.0, 206.0))
    with scene.nodes("mug"):
        dx = pyro.sample("mug.dx", dist.Normal(0.0, 12.0))
        dy = pyro.sample("mug.dy", dist.Normal(0.0, 12.0))
    x = 256 * (scene.rank("plate") + gap) / scene.count("plate").clamp(min=1)
    return scene.draw(
        ps.Sprites.disc("plate", x, y, radius=30.0),
        ps.Sprites.disc("mug", scene.of_parent(x) + dx, scene.of_parent(y) + dy, radius=9.0, tint=(0.8, 0.3, 0.2)),
        background=(0.4, 0.3, 0.2),
    )


def measured(num_scenes: int) -> ps.Scenes:
    """Scenes whose mugs stand to the right, 8 to 24 pixels from the middle of their plate."""
    scenes = ps.sample(tabletop, PRIOR, num_scenes)
    kind, parent = scenes.derivation.kind, scenes.derivation.parent
    siblings = (parent[:, :, None] == parent[:, None, :]) & (kind == GRAMMAR.kind("mug"))[:, None, :]
    away = 24.0 / siblings.sum(-1).clamp(min=1)
    M = scenes.parameters["mug.dx"].shape[1]
    dx = away[:, :M] + 2.0 * torch.randn(num_scenes, M)
    dy = 6.0 * torch.randn(num_scenes, M)
    return run_program(tabletop, scenes.derivation, {**scenes.parameters, "mug.dx": dx, "mug.dy": dy})


def mugs(scenes: ps.Scenes) -> torch.Tensor:
    """dx of all mugs, in order of size."""
    return scenes.parameters["mug.dx"][scenes.site_mask["mug.dx"]].sort().values


def distance(scenes: ps.Scenes, truth: ps.Scenes) -> float:
    """Wasserstein-1 distance of dx, pixels."""
    levels = torch.linspace(0.005, 0.995, 100)
    return float((mugs(scenes).quantile(levels) - mugs(truth).quantile(levels)).abs().mean())


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--num-scenes", type=int, default=100, help="measured scenes a step")
    args = parser.parse_args()
    ps.seed_everything(args.seed)

    sites = tuple(site for site in ps.find_sites(tabletop) if not site.keeps)
    guide = ps.ParameterGuide(tabletop, sites)
    adam = torch.optim.Adam(guide.net.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, args.steps)
    for step in range(args.steps):
        scenes = measured(args.num_scenes)
        known = {**scenes.derivation.sites(), **scenes.parameters}
        trace = poutine.trace(poutine.condition(guide, data=known)).get_trace(args.num_scenes)
        loss = -trace.log_prob_sum() / args.num_scenes
        adam.zero_grad()
        loss.backward()
        adam.step()
        schedule.step()
        if step % 25 == 0:
            print(f"step {step:4d}  {loss.item():.2f} nats a scene")

    truth = measured(500)
    for name, model in (("prior", tabletop), ("learnt", guide.with_parameters(tabletop))):
        found = distance(ps.sample(model, PRIOR, 500), truth)
        print(f"Wasserstein-1 of mug.dx, {name}: {found:.1f} pixels")


if __name__ == "__main__":
    main()
