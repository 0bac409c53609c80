"""One scene as a glTF file (GLB): its objects, ground and camera, for Blender and other programs, through trimesh.

glTF's y axis points up and its cameras look along -z; the root node turns the world's axes.
"""

import logging
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from probscene.world import World

from ..files import make_folder, write_whole
from .scene_parts import camera_matrix, intrinsics, pieces

UP = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # x forward, z up to -z forward, y up
LOOK = np.diag([1.0, -1, -1, 1])  # from a camera that looks along -z, y up, to one along z, y down


def write_gltf(path: Path, world: World, scene: int, canvas: tuple[int, int]) -> None:
    """Write scene number ``scene`` as a binary glTF file, whole or not at all.

    Args:
        canvas: height and width of the image, for the camera's field of view.

    Raises:
        MachineError: the file cannot be written.
    """
    import trimesh  # takes a second
    from trimesh.scene import Camera
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    whole = trimesh.Scene()
    used: dict[str, int] = {}
    for piece in pieces(world, scene):
        number = used[piece.name] = used.get(piece.name, -1) + 1
        material = PBRMaterial(
            baseColorTexture=None if piece.texture is None else Image.fromarray(piece.texture),
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        # trimesh counts v from the texture's lower edge.
        uv = np.zeros((len(piece.positions), 2)) if piece.uv is None else piece.uv * [1, -1] + [0, 1]
        visual = TextureVisuals(uv, material=material)
        linear = np.c_[_linear(piece.colour / 255), np.ones(len(uv))]
        visual.vertex_attributes["color"] = np.rint(255 * linear).astype(np.uint8)
        mesh = trimesh.Trimesh(
            piece.positions,
            np.arange(len(piece.positions)).reshape(-1, 3),
            vertex_normals=piece.normals,
            visual=visual,
            process=False,
        )
        name = piece.name if number == 0 else f"{piece.name} part {number}"
        whole.add_geometry(mesh, node_name=name, geom_name=name, transform=UP @ piece.matrix)
    focal = intrinsics(world, scene)[0, 0]
    fov = [2 * np.degrees(np.arctan(size / 2 / focal)) for size in canvas[::-1]]
    whole.camera = Camera("camera", resolution=canvas[::-1], fov=fov)
    whole.camera_transform = UP @ camera_matrix(world, scene) @ LOOK
    data = cast(bytes, whole.export(file_type="glb"))
    make_folder(path.parent)
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def _linear(colour: np.ndarray) -> np.ndarray:
    """sRGB in 0..1 to linear light, as glTF's vertex colours are."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
