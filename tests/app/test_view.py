"""Renders enter a feature network as the same pictures do when they are read from files."""

from dataclasses import replace

import torch

from probscene.app.generate import generate_scenes
from probscene.app.loading import load_model
from probscene.app.view import View
from probscene.dataset import ImageFolder
from probscene.sampling import sample, seed_everything


class Seen:
    """A feature network that keeps what it is shown."""

    names = ("mean",)

    def embed(self, images):
        self.images = images
        return images.float().mean((1, 2, 3)).unsqueeze(1)


def test_a_grey_models_coloured_renders_are_read_as_its_files_are(discs, tmp_path):
    model = replace(load_model(str(discs.file)), channels=1)
    generate_scenes(model, model.prior, 8, tmp_path / "drawn", format="images")
    files = ImageFolder(tmp_path / "drawn" / "images", model.canvas, 1)
    view, net = View(model, threads=1), Seen()
    seed_everything(3)
    scenes = sample(model, model.prior, 8)
    view.observe(net)(scenes)
    assert net.images.shape[1] == view.draw(8).image.shape[1] == files.load(0).shape[0] == 1
    render = view.render(scenes.drawing).image
    assert not torch.equal(render[:, 0], render[:, 2])  # there is colour to be lost
    luma = (render.float() * torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)).sum(1, keepdim=True)
    assert (net.images.float() - luma).abs().max() <= 1
