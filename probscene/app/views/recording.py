"""Scenes as a Rerun recording, which one can turn: objects with 3D boxes, camera, image, depth and masks, scene graph.

``pip install probscene[view]`` brings Rerun; its viewer opens the file: ``rerun scene.rrd``.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from probscene.batch import RenderBatch
from probscene.derivation import Derivation
from probscene.errors import MachineError
from probscene.model import SceneModel
from probscene.world import World

from ..files import make_folder, write_whole
from ..pictures import colour_of
from .scene_parts import camera_matrix, intrinsics, pieces


def write_recording(path: Path, model: SceneModel, derivation: Derivation, drawing, batch: RenderBatch) -> None:
    """Write scenes as a recording, one after the other on the timeline ``scene``; the file is whole or absent.

    Args:
        derivation, drawing, batch: the scenes, what they are drawn from, and their renders.

    Raises:
        MachineError: Rerun is not installed, or the file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise MachineError(
            "expected the package rerun-sdk, which recordings are made with, got none; install it with "
            "pip install 'probscene[view]'."
        ) from error
    kinds = model.grammar.kinds
    colours = [(0, 0, 0), *(colour_of(k, len(kinds)) for k in range(len(kinds)))]

    def write(temporary: Path) -> None:
        recording = rr.RecordingStream("probscene")
        recording.save(temporary, default_blueprint=_blueprint(isinstance(drawing, World)))
        classes = [rr.AnnotationInfo(k, "" if k == 0 else kinds[k - 1], colours[k]) for k in range(len(colours))]
        recording.log("/", rr.AnnotationContext(classes), static=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for scene in range(len(drawing)):
            recording.set_time("scene", sequence=scene)
            recording.log("world/objects", rr.Clear(recursive=True))
            _log_graph(rr, recording, model, derivation, scene)
            if isinstance(drawing, World):
                _log_world(rr, recording, drawing, batch, scene, colours)
                image = "world/camera/image"
            else:
                image = "image"
            _log_image(rr, recording, image, model, batch, scene, colours)
        recording.flush()
        recording.disconnect()

    make_folder(path.parent)
    write_whole(path, write)


def _blueprint(in_3d: bool):
    """How the viewer lays a scene out: the world, the image with boxes, masks, depth, and the scene graph."""
    import rerun.blueprint as rrb

    image = "world/camera/image" if in_3d else "image"

    def flat(name: str, *parts: str):
        return rrb.Spatial2DView(origin=image, name=name, contents=[f"/{image}/{part}" for part in parts])

    views: list[rrb.View] = [flat("image", "colour", "boxes"), flat("classes", "classes")]
    views += [flat("depth", "depth")] * in_3d
    views.append(rrb.GraphView(origin="graph", name="scene graph"))
    if not in_3d:
        return rrb.Blueprint(rrb.Horizontal(*views), collapse_panels=True)
    contents = ["+ /world/**", *(f"- /{image}/{part}" for part in ("boxes", "classes", "depth"))]
    world = rrb.Spatial3DView(origin="world", name="world", contents=contents)
    return rrb.Blueprint(rrb.Horizontal(world, rrb.Vertical(*views)), collapse_panels=True)


def _log_graph(rr, recording, model: SceneModel, derivation: Derivation, scene: int) -> None:
    kind, parent = derivation.kind[scene].tolist(), derivation.parent[scene].tolist()
    nodes = [m for m, k in enumerate(kind) if k >= 0]
    labels = ["scene", *(model.grammar.kinds[kind[m]] for m in nodes)]
    recording.log("graph", rr.GraphNodes(["scene", *map(str, nodes)], labels=labels))
    edges = [("scene" if parent[m] < 0 else str(parent[m]), str(m)) for m in nodes]
    recording.log("graph", rr.GraphEdges(edges, graph_type="directed"))


def _log_world(rr, recording, world: World, batch: RenderBatch, scene: int, colours: list) -> None:
    used: dict[str, int] = {}
    for piece in pieces(world, scene):
        number = used[piece.name] = used.get(piece.name, -1) + 1
        corners = piece.positions @ piece.matrix[:3, :3].T + piece.matrix[:3, 3]
        turned = piece.normals @ np.linalg.inv(piece.matrix[:3, :3])
        texture = {} if piece.uv is None else {"vertex_texcoords": piece.uv, "albedo_texture": piece.texture}
        mesh = rr.Mesh3D(
            vertex_positions=corners,
            vertex_normals=turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12),
            vertex_colors=np.rint(piece.colour).astype(np.uint8),
            **texture,
        )
        recording.log(f"world/objects/{piece.name.replace(' ', '/')}/{number}", mesh)
    to_world = camera_matrix(world, scene)
    height, width = batch.image.shape[-2:]
    recording.log(
        "world/camera",
        rr.Transform3D(translation=to_world[:3, 3], quaternion=Rotation.from_matrix(to_world[:3, :3]).as_quat()),
    )
    recording.log(
        "world/camera/image",
        rr.Pinhole(
            image_from_camera=intrinsics(world, scene), width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF
        ),
    )
    if batch.space is None:  # as of a renderer that gives none
        return
    drawn = (batch.kind[scene] >= 0).nonzero().flatten().tolist()
    box = batch.space.box[scene][drawn].double().numpy()  # h w l x y z rotation_y
    middle = box[:, 3:6] - np.c_[np.zeros(len(box)), box[:, 0] / 2, np.zeros(len(box))]
    turned = Rotation.from_matrix(to_world[:3, :3]) * Rotation.from_euler("y", box[:, 6:])
    kind = batch.kind[scene][drawn].tolist()
    recording.log(
        "world/boxes",
        rr.Boxes3D(
            centers=middle @ to_world[:3, :3].T + to_world[:3, 3],
            sizes=box[:, [2, 0, 1]],  # along the object's own x, down and z
            quaternions=turned.as_quat(),
            class_ids=[k + 1 for k in kind],
            labels=[world.kinds[k] for k in kind],
            colors=[colours[k + 1] for k in kind],
        ),
    )
    depth = batch.space.depth[scene].numpy()
    recording.log("world/camera/image/depth", rr.DepthImage(np.where(np.isfinite(depth), depth, 0.0), meter=1.0))


def _log_image(rr, recording, path: str, model: SceneModel, batch: RenderBatch, scene: int, colours: list) -> None:
    recording.log(f"{path}/colour", rr.Image(batch.image[scene].permute(1, 2, 0).contiguous().numpy()))
    kind = np.r_[0, batch.kind[scene].numpy() + 1]
    recording.log(f"{path}/classes", rr.SegmentationImage(kind[batch.instance[scene].numpy()].astype(np.uint8)))
    seen = [m for m in range(batch.kind.shape[1]) if batch.kind[scene, m] >= 0 and batch.pixels[scene, m] > 0]
    kinds = batch.kind[scene][seen].tolist()
    recording.log(
        f"{path}/boxes",
        rr.Boxes2D(
            array=batch.box[scene][seen].numpy(),
            array_format=rr.Box2DFormat.XYXY,
            class_ids=[k + 1 for k in kinds],
            labels=[model.grammar.kinds[k] for k in kinds],
            colors=[colours[k + 1] for k in kinds],
        ),
    )
