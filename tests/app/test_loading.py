"""What the application makes of a model: a renderer for whatever it returns."""

import numpy as np
import torch

from probscene.app.loading import renderer_for
from probscene.camera_effects import CameraEffects
from probscene.drawing import Drawing, Sprites, resolve
from probscene.mesh import Mesh
from probscene.models.multi_mnist import MODEL
from probscene.world import Camera, Light, Meshes, World, resolve_meshes, resolve_scene

ONE = torch.ones(1, 1, dtype=torch.bool)
KIND = torch.zeros(1, 1, dtype=torch.int64)


def test_one_renderer_draws_drawings_and_worlds():
    render = renderer_for(MODEL, threads=1)
    sprite = Sprites.disc("a", *torch.full((2, 1, 1), 20.0), torch.tensor(6.0))
    flat = render(Drawing(KIND, ("a",), (resolve(sprite, ONE),)))
    assert flat.pixels.item() > 90 and flat.space is None

    wall = Mesh(np.array([[0, -2, 0], [0, 2, 0], [0, 0, 4]]), np.array([[0, 2, 1]]), (255, 0, 0))
    layer = resolve_meshes(Meshes("a", (wall,), 0, 10.0, 0.0), ONE)
    parts = {"camera": Camera.kitti(MODEL.canvas), "light": Light(), "photo": CameraEffects()}
    parts = {name: resolve_scene(part, 1) for name, part in parts.items()}
    deep = render(World(KIND, ("a",), (layer,), ground=None, **parts))
    assert deep.image.shape == (1, 3, *MODEL.canvas) and deep.pixels.item() > 90
    assert torch.isclose(deep.space.depth[deep.instance == 1], torch.tensor(10.0)).all()
