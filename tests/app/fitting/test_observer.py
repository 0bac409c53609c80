"""Renders enter a feature network as the same pictures do when they are read from files."""

from dataclasses import replace

import pytest
import torch

from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.sampling import sample, seed_everything
from probscene.structure import StructurePrior, counts


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
    view, net = RenderedFeatures(model, threads=1), Seen()
    seed_everything(3)
    scenes = sample(model, model.prior, 8)
    view.observe(net)(scenes)
    assert net.images.shape[1] == view.draw(8).image.shape[1] == files.load(0).shape[0] == 1
    render = view.render(scenes.drawing).image
    assert not torch.equal(render[:, 0], render[:, 2])  # there is colour to be lost
    luma = (render.float() * torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)).sum(1, keepdim=True)
    assert (net.images.float() - luma).abs().max() <= 1


def watched(model):
    """A view that keeps what it renders, and a network that keeps what it is shown."""
    view, rendered = RenderedFeatures(model, threads=1), []
    render = view.render
    view.render = lambda drawing: rendered.append(render(drawing)) or rendered[-1]
    return view, Seen(), rendered


class Labels(Seen):
    """A feature network that keeps the labelled renders that it is given."""

    uses_labels = True

    def embed_from_labels(self, drawn):
        self.drawn = drawn
        return drawn.visible.sum(1, keepdim=True)


@pytest.mark.parametrize("name", ["aerial2d", "driving_simple"])
def test_who_looks_at_labels_alone_is_given_those_of_the_pictures(name):
    model, net = load_model(name), Labels()
    seed_everything(1)
    scenes = sample(model, model.prior, 4)
    RenderedFeatures(model, threads=1).observe(net)(scenes)
    whole = RenderedFeatures(model, threads=1).labelled(scenes)
    assert all(torch.equal(a, b) for a, b in zip(net.drawn[1:], whole[1:], strict=True))
    assert net.drawn.image.shape == whole.image.shape


def test_what_hides_something_is_drawn_again_and_the_clearest_is_seen(discs):
    model = load_model(str(discs.file))
    three = StructurePrior(model.grammar, Discs=counts(0, 0, 0, 1))
    seed_everything(0)
    scenes = sample(model, three, 60)
    view, net, rendered = watched(model)
    view.observe(net, draws_per_structure=6)(scenes)
    first, again = rendered[0], rendered[1]
    whole = first.visible.where(first.kind >= 0, 1.0).amin(1) == 1
    assert whole.any() and not whole.all() and len(again.image) == int((~whole).sum())
    once, seen = view.render(scenes.drawing).image, net.images
    assert torch.equal(seen[whole], once[whole])

    def shown(images):  # discs that hide one another cover less
        return (images.amax(1) > 60).sum((1, 2)).float()[~whole].mean()

    assert shown(seen) > 1.05 * shown(once)


def test_what_carries_others_is_meant_to_be_covered():
    """Roads are covered by their cars, which are whole, and reach beyond the canvas: nothing is drawn again."""
    model = load_model("aerial2d")
    seed_everything(0)
    view, net, rendered = watched(model)
    busy = StructurePrior(model.grammar, Roads=counts(0, 1, 1), Cars=counts(1, 1, 1, 1))
    scenes = sample(model, busy, 20)
    view.observe(net, draws_per_structure=4)(scenes)
    empty = (rendered[0].kind != model.grammar.kind("car")).all(1)
    assert len(rendered) == 1 and (rendered[0].visible[empty, 0] < 1).any()
