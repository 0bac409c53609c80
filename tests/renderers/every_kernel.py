"""Compiles every kernel that draws, and prints for each the real functions that it calls: kernels by commas, names by
spaces."""

from collections import defaultdict

import numpy as np
import torch

from probscene.camera_effects import CameraEffects
from probscene.drawing import Drawing, Sprites, resolve
from probscene.mesh import Mesh
from probscene.renderers import engine
from probscene.renderers.camera.effects import apply_camera_effects
from probscene.renderers.meshes import MeshRenderer
from probscene.renderers.sprites import SpriteRenderer
from probscene.world import Camera, Light, Meshes, World, resolve_meshes, resolve_scene

CANVAS = 20, 20
function, called = engine.ti.lang.kernel_impl.Func, defaultdict(set)
call = function.func_call_rvalue


def recorded(self, key, args):
    called[id(engine.ti.lang.impl.get_runtime().compiling_callable)].add(self.func.__name__)
    return call(self, key, args)


function.func_call_rvalue = recorded
one = torch.ones(1, 1)
kind = torch.zeros(1, 1, dtype=torch.int64)
sprites = resolve(Sprites.disc("a", 9 * one, 9 * one, 5 * one), one > 0)
SpriteRenderer(CANVAS)(Drawing(kind, ("a",), (sprites,)))
effects = CameraEffects(contrast=0.5, blur=1.0, noise=1.0, jpeg_quality=50.0)
apply_camera_effects(resolve_scene(effects, 1), torch.zeros(1, 3, *CANVAS, dtype=torch.uint8))
mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), (9, 9, 9))
meshes = resolve_meshes(Meshes("a", (mesh,), 0, 9.0, 0.0), one > 0)
camera, light, photo = (resolve_scene(part, 1) for part in (Camera(), Light(), CameraEffects()))
world = World(kind, ("a",), (meshes,), camera=camera, light=light, photo=photo, ground=None)
for samples in (1, 4):
    MeshRenderer(CANVAS, samples=samples)(world)
print(*(" ".join(sorted(names)) for names in called.values()), sep=",")
