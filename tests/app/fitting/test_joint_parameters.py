"""Parameters of a model of several scenarios, and of a node that each scene has one of, learnt by a fit."""

import pyro
import pyro.distributions as dist
import torch

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.sampling import sample, seed_everything
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts

DOTS = Grammar("Scene -> lamp Dots\nDots -> dot Dots | ε")
NUMBERS = {"few": counts(0, 3, 1), "many": counts(0, 0, 0, 1, 2)}


def dots(name: str, lit: bool) -> SceneModel:
    """Dots anywhere under any lamp, or on a line under a bright one."""

    prior = StructurePrior(DOTS, Dots=NUMBERS[name])

    @scene_model(DOTS, prior, canvas=(64, 64), max_steps=12, classes=("dot",), name=name)
    def program(scene):
        with scene.nodes("lamp"):
            light = pyro.sample("lamp.light", dist.Uniform(0.3, 1.0))
        with scene.nodes("dot"):
            x = pyro.sample("dot.x", dist.Uniform(8.0, 56.0))
            y = pyro.sample("dot.y", dist.Uniform(8.0, 56.0))
        light = (light * scene.mask("lamp")).sum(1, keepdim=True)
        if lit:
            y, light = torch.full_like(y, 20.0), 0.8 + 0.2 * light
        tint = light.expand_as(x)[..., None].expand(*x.shape, 3)
        return scene.draw(Sprites.disc("dot", x, y, radius=4.0, tint=tint))

    return program


def both(lit: bool) -> SceneModel:
    """The two scenarios as one model."""
    return join("dots", {name: dots(name, lit) for name in NUMBERS})


def test_both_scenarios_learn_what_the_images_have_in_common(tmp_path):
    truth, model = both(True), both(False)
    generate_scenes(truth, truth.prior, 200, tmp_path / "target", format="images")
    settings = {
        "features.schedule.steps": 100,
        "features.schedule.images": 8,
        "features.width": "8,16,32",
        "structure.batches": 4,
        "structure.num_scenes": 60,
    }
    settings |= {"pretrain.derivations": 300}
    settings |= {"parameters.reader_steps": 150, "parameters.reader_images": 6, "parameters.steps": 100}
    settings |= {"parameters.rounds": 1, "parameters.round_reader_steps": 30, "parameters.round_steps": 40}
    settings |= {"parameters.recalibration_renders": 400}
    settings |= {"parameters.scene_renders": 1200, "parameters.round_scene_renders": 200}
    settings |= {"refine.batches": 2}
    config = preset("quick").set("features=count", settings)
    execution = Execution(1, cache=False, progress=False)
    run = fit(model, tmp_path / "target" / "images", config, out=tmp_path / "run", execution=execution)
    record = run.parameters
    assert [(site["name"], site["kinds"]) for site in record["sites"]] == [
        ("lamp.light", []),
        ("dot.x", ["dot"]),
        ("dot.y", ["dot"]),
    ]
    assert all(site["learnt"] for site in record["sites"]) and record["kept"] == "learnt", record["sites"]

    def prefixed(policy):
        seed_everything(0)
        scenes = sample(run.model, policy, 300)
        values = [(scenes.parameters[name], scenes.site_mask[name]) for name in scenes.parameters]
        of = dict(zip(scenes.parameters, [value[mask] for value, mask in values], strict=True))
        return {
            name: (float((of[f"{name}/dot.y"] - 20).abs().mean()), float(of[f"{name}/lamp.light"].mean()))
            for name in NUMBERS
        }

    prior, learnt = prefixed(run.model.prior), prefixed(run.guide)
    for name in NUMBERS:
        assert learnt[name][0] < 0.3 * prior[name][0] and learnt[name][1] > 0.8 > 0.7 > prior[name][1], name
