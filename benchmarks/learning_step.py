"""Where the time of one learning step goes: scenes are derived, given parameters, rendered and embedded, their costs
estimated, and the guide updated.

    python benchmarks/learning_step.py [MODEL] [--scenes 300] [--features count efficientnet]

CPU seconds of one process on one thread, after a step that compiles kernels; the feature network's weights do not
matter to its time, so it is not trained. 5,000 images of the prior stand for the real ones.
"""

import argparse
import time

import torch

from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.app.loading import load_model, renderer_for
from probscene.derive import derive_complete
from probscene.inference.guides.lstm import make_guide
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.sampling import run_program, seed_everything
from probscene.threads import use_threads


class Clock:
    """CPU seconds by part."""

    def __init__(self):
        self.parts: dict[str, float] = {}

    def __call__(self, part, work):
        start = time.process_time()
        result = work()
        self.parts[part] = self.parts.get(part, 0.0) + time.process_time() - start
        return result


def step(model, guide, optimiser, net, view, real, num_scenes, clock):
    """One rendered batch and its three updates."""
    preset = QUICK
    with torch.no_grad():
        derivation, _ = clock("structures", lambda: derive_complete(guide.grammar, guide, num_scenes, guide.max_steps))
        scenes = clock("parameters", lambda: run_program(model, derivation))
        starts = range(0, num_scenes, 64)
        images = [clock("rendering", lambda i=i: view.render(scenes.drawing[i : i + 64]).image) for i in starts]
        features = clock("features", lambda: torch.cat([net.embed(some) for some in images]))
        cost = clock("divergence", lambda: preset.divergence()(features, real))
    advantage = cost - cost.mean()

    def update():
        optimiser.zero_grad()
        (advantage * guide.log_prob(derivation)).mean().backward()
        optimiser.step()

    for _ in range(preset.updates):
        clock("guide", update)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", nargs="?", default="driving")
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--features", nargs="+", default=["count", "efficientnet"])
    parser.add_argument("--steps", type=int, default=3)
    args = parser.parse_args()
    use_threads(1)
    model = load_model(args.model)
    renderer_for(model, 1)
    columns = {}
    for features in args.features:
        seed_everything(0)
        view = RenderedFeatures(model, 1)
        net = QUICK.with_features(features).make_features().build(model).eval()
        if features == "count":
            net.fit_to(view.object_size())
        made = ScenarioGuide if model.scenarios else lambda g, steps: make_guide("lstm", g, steps)
        guide = made(model.grammar, model.max_steps)
        optimiser = torch.optim.Adam(guide.parameters(), lr=1e-3)
        real = torch.randn(5000, len(net.names))
        step(model, guide, optimiser, net, view, real, args.scenes, Clock())
        clock = Clock()
        for _ in range(args.steps):
            step(model, guide, optimiser, net, view, real, args.scenes, clock)
        columns[features] = {part: seconds / args.steps for part, seconds in clock.parts.items()}
    height, width = model.canvas
    print(f"{model.name}, {args.scenes} scenes of {width}x{height}, CPU seconds a step on one thread")
    print(f"{'':12}" + "".join(f"{name:>24}" for name in columns))
    for part in next(iter(columns.values())):
        cells = (f"{c[part]:10.3f} {100 * c[part] / sum(c.values()):6.1f} %" for c in columns.values())
        print(f"{part:12}" + "".join(f"{cell:>24}" for cell in cells))
    print(f"{'all':12}" + "".join(f"{sum(c.values()):>15.3f}{'':9}" for c in columns.values()))


if __name__ == "__main__":
    main()
