"""Photos of scenes through data sets: recorded, made again to the byte, and joined with scenarios that have none."""

import json

import cv2
import pyro
import pyro.distributions as dist
import pytest
import torch

from probscene.app.chunks import as_written
from probscene.app.datasets.generate import generate_scenes
from probscene.app.datasets.provenance import remake
from probscene.app.loading import renderer_for
from probscene.derivation import Derivation
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import scene_model
from probscene.sampling import run_program, sample
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts

DISCS = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
PRIOR = StructurePrior(DISCS, Discs=counts(1, 2, 2))


def place(scene):
    with scene.nodes("disc"):
        return pyro.sample("disc.x", dist.Uniform(8.0, 40.0))


@scene_model(DISCS, PRIOR, canvas=(40, 48), max_steps=8, classes=("disc",))
def photographed(scene):
    photo = scene.photo(
        exposure=(0.5, 1.5), red_gain=(0.8, 1.2), vignette=(0.0, 0.8), blur=(0.0, 2.0), noise=(0.0, 9.0),
        jpeg_quality=(30.0, 95.0),
    )  # fmt: skip
    return scene.draw(Sprites.disc("disc", place(scene), 20.0, radius=6.0), background=(0.5, 0.4, 0.3), photo=photo)


@scene_model(DISCS, PRIOR, canvas=(40, 48), max_steps=8, classes=("disc",))
def drawn(scene):
    return scene.draw(Sprites.disc("disc", place(scene), 20.0, radius=6.0), background=(0.5, 0.4, 0.3))


MODELS = {"photographed": photographed, "drawn": drawn}


@pytest.mark.parametrize("model", [photographed, join("both", MODELS)], ids=["one model", "scenarios"])
def test_every_photo_is_made_again_from_its_line(model, tmp_path):
    generate_scenes(model, model.prior, 12, tmp_path / "out", 3)
    lines = [json.loads(line) for line in (tmp_path / "out" / "provenance.jsonl").read_text().splitlines()]
    assert len(lines) == 12
    for line in lines:
        image, batch = remake(model, line)
        written = cv2.imread(str(tmp_path / "out" / line["image"]))[..., ::-1]
        assert torch.equal(image.permute(1, 2, 0), torch.from_numpy(written.copy()))
        assert batch.instance.shape == (1, 40, 48)
    sites = {site for line in lines for site, value in line["parameters"].items() if value}
    assert {site.rpartition("/")[2] for site in sites} >= {"photo.exposure", "photo.jpeg_quality", "photo.seed"}


def test_a_joint_batch_shows_what_each_scenarios_own_model_shows():
    joint = join("both", MODELS)
    scenes = sample(joint, joint.prior, 12)
    batch, seen = renderer_for(joint, 1)(scenes.drawing), set()
    for i, number in enumerate(joint.grammar.scenario(scenes.derivation).tolist()):
        name, model = joint.scenarios[number]
        own = Derivation.from_rules(model.grammar, joint.grammar.own(scenes.derivation[i : i + 1], number).rules)
        sites = {site: value for site, value in scenes.parameters.items() if site.startswith(f"{name}/")}
        M = own.kind.shape[1]
        values = {
            site.split("/")[1]: value[i : i + 1] if "/photo." in site else value[i : i + 1, :M]
            for site, value in sites.items()
        }
        alone = renderer_for(model, 1)(run_program(model, own, values).drawing)
        assert torch.equal(as_written(model, alone.image)[0], as_written(joint, batch.image)[i])
        seen.add(name)
    assert len(seen) == 2


def test_labels_of_a_photo_are_the_drawings():
    scenes = sample(photographed, PRIOR, 20)
    values = {name: value for name, value in scenes.parameters.items() if "photo" not in name}
    plain = run_program(drawn, scenes.derivation, values)
    photo, drawing = (renderer_for(photographed, 1)(each.drawing) for each in (scenes, plain))
    assert not torch.equal(photo.image, drawing.image)
    assert all(torch.equal(a, b) for a, b in zip(photo[1:7], drawing[1:7], strict=True))
