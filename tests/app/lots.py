"""A small model in 3D: boxes of two colours, some under a lid, on a ground with a grey strip in the middle."""

import numpy as np
import pyro
import pyro.distributions as dist
import torch

from probscene.derive import derive
from probscene.grammar import Grammar
from probscene.mesh import Mesh, Surface
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts
from probscene.world import Camera, Ground, Meshes

GRAMMAR = Grammar("Scene -> Boxes\nBoxes -> box(Lid) Boxes | ε\nLid -> lid | ε")
CANVAS = (94, 310)


def cuboid(length: float, width: float, height: float, colour=(200, 60, 40), **more) -> Mesh:
    """A box on the ground, its faces outward; the two triangles of its front have another colour and no tint."""
    x, y, z = length / 2, width / 2, height
    corners = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0), (-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)]
    quads = [(1, 2, 6, 5), (0, 4, 7, 3), (0, 1, 5, 4), (2, 3, 7, 6), (4, 5, 6, 7), (0, 3, 2, 1)]
    triangles = [(a, b, c) for a, b, c, d in quads] + [(a, c, d) for a, b, c, d in quads]
    colours = np.tile(np.uint8(colour), (12, 1))
    tinted = np.ones(12, bool)
    for front in (0, 6):
        colours[front], tinted[front] = (250, 250, 120), False
    return Mesh(np.float32(corners), np.int32(triangles), colours, tinted, **more)


CHECKS = np.kron(np.uint8([[90, 140], [140, 90]]), np.ones((4, 4), np.uint8))[..., None].repeat(3, 2)
SURFACES = (
    Surface("terrain", np.full((4, 4, 3), (90, 130, 70), np.uint8), (4.0, 4.0)),
    Surface("road", np.ascontiguousarray(CHECKS), (4.0, 2.0)),
)
UV = np.tile(np.float32([[0, 0], [1, 0], [1, 1]]), (12, 1, 1))
BOXES = (cuboid(4.0, 1.8, 1.5), cuboid(6.0, 2.2, 2.8, (90, 90, 160), uv=UV, texture=np.ascontiguousarray(CHECKS)))
LID = (cuboid(1.5, 1.5, 0.3, (240, 240, 240)),)


def program(num_scenes, structure):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, 16))
        pitch = pyro.sample("camera.pitch", dist.Uniform(-0.02, 0.05))
        with scene.nodes("box"):
            x = pyro.sample("box.x", dist.Uniform(0.0, 1.0))
            y = pyro.sample("box.y", dist.Uniform(-6.0, 6.0))
            yaw = pyro.sample("box.yaw", dist.Uniform(-3.1, 3.1))
            make = pyro.sample("box.make", dist.Uniform(0.0, 1.0))
    x = 9 + 9 * scene.rank("box") + 3 * x
    height = torch.where(make > 0.5, 2.8, 1.5)
    edges = torch.tensor([[-4.0, 4.0]])
    return scene.build(
        Meshes("box", BOXES, (make > 0.5).long(), x, y, yaw=yaw, tint=(0.7, 1.0, 0.8)),
        Meshes("lid", LID, 0, scene.of_parent(x), scene.of_parent(y), scene.of_parent(height), scene.of_parent(yaw)),
        camera=Camera.kitti(CANVAS, pitch=pitch),
        ground=Ground(SURFACES, edges, torch.tensor([[0, 1, 0]])),
    )


PRIOR = StructurePrior(GRAMMAR, Boxes=counts(0, 1, 1, 1))
MODEL = SceneModel("lots", GRAMMAR, PRIOR, program, CANVAS, 16, ("box", "lid"))
