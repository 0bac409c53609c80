"""A world as the mesh kernels' tables: one row an instance, in the order of scene, node, layer; decoration comes last.

Float64 arithmetic on the numbers of one scene alone, element by element, so that rows do not depend on their batch.
"""

from typing import NamedTuple

import numpy as np

from probscene.errors import ModelError
from probscene.world import World

from .scenes import MAX_POSITION, Sight, dot, fit, ground_tables, product, scene_table, view
from .tables import layout
from .tables.atlas import MeshAtlas

MAX_NODES, MAX_INSTANCES, MAX_SCALE = 32767, 65535, 1e4


class Placed(NamedTuple):
    """Every mesh that stands in the world, unsorted. I instances.

    ``scene, node (I,)`` int64, the node -1 without a label; ``layer (I,)``; ``rows (I, 6)`` of the atlas; ``middle,
    half (I, 3)`` of the mesh's own box; ``at (I, 3)`` metres; ``yaw (I,)``; ``scale, tint (I, 3)``.
    """

    scene: np.ndarray
    node: np.ndarray
    layer: np.ndarray
    rows: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    at: np.ndarray
    yaw: np.ndarray
    scale: np.ndarray
    tint: np.ndarray


class Instances(NamedTuple):
    """The kernel's tables, flat, of at least one row each, and what the host tells about the scenes.

    ``first (N + 1,)`` int32, where each scene's instances begin; ``drawn (N, M)`` bool, which nodes have a label; ``box
    (N, M, 7)`` float64 as of ``SceneGeometry``; ``most``: vertices of the largest mesh, and triangles in sight of the
    fullest scene.
    """

    whole: np.ndarray
    real: np.ndarray
    scenes: np.ndarray
    edges: np.ndarray
    strips: np.ndarray
    tiles: np.ndarray
    first: np.ndarray
    drawn: np.ndarray
    box: np.ndarray
    most: tuple[int, int]


def names(world: World) -> tuple[str, ...]:
    """What the semantic image's numbers mean."""
    surfaces = () if world.ground is None else dict.fromkeys(surface.name for surface in world.ground.surfaces)
    return ("sky", *world.kinds, *surfaces, "decoration")


def instances(world: World, atlas: MeshAtlas, canvas: tuple[int, int], map_size: int) -> Instances:
    """Build the tables, and check all that the kernels rely on.

    Raises:
        ModelError: more than 32767 nodes or 65535 instances a scene, more than 255 classes, layers of another shape
            than the world, values that are not finite, or a mesh more than 1e6 m away or scaled by over 1e4.
    """
    N, M = world.kind.shape
    if M > MAX_NODES:
        raise ModelError(f"expected at most {MAX_NODES} nodes a scene, got {M}; draw fewer things.")
    classes = names(world)
    if len(classes) > 256:
        raise ModelError(f"expected at most 256 classes in a world, got {len(classes)}; join some of them.")
    atlas.add(
        [mesh for layer in world.layers for mesh in layer.meshes],
        [] if world.ground is None else list(world.ground.surfaces),
    )
    placed = _placed(world, atlas)
    order = np.lexsort((placed.layer, np.where(placed.node < 0, MAX_NODES, placed.node), placed.scene))
    placed = Placed(*(values[order] for values in placed))
    count = np.bincount(placed.scene, minlength=N)
    if len(count) and count.max() > MAX_INSTANCES:
        raise ModelError(f"expected at most {MAX_INSTANCES} meshes in a scene, got {count.max()}; draw fewer.")

    sight = view(world)
    rows = max(1, len(order))
    whole, real = np.zeros((rows, layout.INTEGERS), np.int64), np.zeros((rows, layout.REALS))
    shadow = _fill(whole, real, placed, sight, canvas, map_size)
    first_surface = 1 + len(world.kinds)
    if len(order):
        kind = world.kind.cpu().numpy()[placed.scene, np.maximum(placed.node, 0)] if M else placed.node
        unknown = (placed.node < 0) | (kind < 0)
        whole[:, layout.SEMANTIC] = np.where(unknown, len(classes) - 1, 1 + kind)
    semantic = {name: first_surface + i for i, name in enumerate(classes[first_surface:-1])}
    drawn = np.zeros((N, M), bool)
    labelled = placed.node >= 0
    drawn[placed.scene[labelled], placed.node[labelled]] = True
    in_sight = np.zeros(max(1, N), np.int64)
    np.add.at(in_sight, placed.scene, (whole[:, layout.TRIANGLES] * whole[:, layout.SEEN])[: len(order)])
    return Instances(
        whole=whole.ravel(),
        real=real.ravel(),
        scenes=scene_table(world, sight, shadow).ravel(),
        **dict(zip(("edges", "strips", "tiles"), ground_tables(world, atlas, semantic), strict=True)),
        first=np.searchsorted(placed.scene, np.arange(N + 1)).astype(np.int32),
        drawn=drawn,
        box=_boxes(placed, sight, N, M),
        most=(int(whole[:, layout.VERTICES].max()), int(in_sight.max())),
    )


def _placed(world: World, atlas: MeshAtlas) -> Placed:
    parts = []
    for i, layer in enumerate(world.layers):
        shape = tuple(world.kind.shape) if layer.labelled else (len(world), *layer.present.shape[1:])
        for name, value in vars(layer).items():
            if hasattr(value, "shape") and (tuple(value.shape[:2]) != shape or len(shape) != 2):
                raise ModelError(
                    f"expected {name} of layer {i} as (scenes, nodes) = {shape}, got {tuple(value.shape)}; "
                    "make layers with SceneGraph.build."
                )
        present = layer.present.cpu().numpy()
        scene, node = np.nonzero(present)
        if not len(scene):
            continue
        mesh = layer.mesh.cpu().numpy()[present]
        if mesh.min() < 0 or mesh.max() >= len(layer.meshes):
            raise ModelError(
                f"expected meshes of layer {i} in 0..{len(layer.meshes) - 1}, got {mesh.min()}..{mesh.max()}; "
                "choose meshes that it has."
            )
        values = {
            name: getattr(layer, name).detach().cpu().numpy()[present].astype(np.float64)
            for name in ("x", "y", "z", "yaw", "scale", "tint")
        }
        _check(values)
        rows, bounds = atlas.rows(layer.meshes)
        low, high = bounds[mesh, 0], bounds[mesh, 1]
        at = np.stack([values["x"], values["y"], values["z"]], 1)
        node = node if layer.labelled else np.full(len(scene), -1)
        here = np.full(len(scene), i)
        own_box = (low + high) / 2, (high - low) / 2
        parts.append(
            Placed(scene, node, here, rows[mesh], *own_box, at, values["yaw"], values["scale"], values["tint"])
        )
    if not parts:
        none, three = np.zeros(0, np.int64), np.zeros((0, 3))
        return Placed(none, none, none, np.zeros((0, 6), np.int64), three, three, three, np.zeros(0), three, three)
    return Placed(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _check(values: dict[str, np.ndarray]) -> None:
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise ModelError(f"expected finite {name} in a world, got NaN or infinity; check the program.")
    for name in ("x", "y", "z"):
        if (np.abs(values[name]) > MAX_POSITION).any():
            raise ModelError(
                f"expected {name} within {MAX_POSITION:g} m, got {np.abs(values[name]).max():g} away; "
                "check the program's units."
            )
    if not ((values["scale"] > 0) & (values["scale"] <= MAX_SCALE)).all():
        worst = values["scale"].min() if (values["scale"] <= 0).any() else values["scale"].max()
        raise ModelError(
            f"expected scales above 0 and at most {MAX_SCALE:g} in a world, got {worst:g}; bound the scale."
        )


def _fill(whole, real, placed: Placed, sight: Sight, canvas: tuple[int, int], map_size: int) -> tuple[np.ndarray, ...]:
    """Write the instances' rows; returns what ``fit`` does."""
    N, (height, width), scene = len(sight.eye), canvas, placed.scene
    cos, sin, scale = np.cos(placed.yaw), np.sin(placed.yaw), placed.scale
    turned = np.zeros((len(scene), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = cos
    turned[:, 1, 0], turned[:, 0, 1], turned[:, 2, 2] = sin, -sin, 1
    to_world, at = turned * scale[:, None], placed.at - sight.eye[scene]
    sun = sight.sun[scene]

    def extent(matrix, offset):
        middle = dot(matrix, placed.middle[:, None]) + offset
        half = dot(np.abs(matrix), placed.half[:, None])
        return middle - half, middle + half

    lit, lit_at = product(sun, to_world), dot(sun, at[:, None])
    image, image_at = product(sight.image[scene], to_world), dot(sight.image[scene], at[:, None])
    bottom, top = extent(to_world[:, 2:], placed.at[:, 2:])
    cast_low, cast_high = extent(lit[:, :2], lit_at[:, :2])
    low, high = np.zeros(N), np.zeros(N)
    np.minimum.at(low, scene, bottom[:, 0])
    np.maximum.at(high, scene, top[:, 0])
    least, largest = np.full((N, 2), np.inf), np.full((N, 2), -np.inf)
    np.minimum.at(least, scene, cast_low)
    np.maximum.at(largest, scene, cast_high)
    mapped, first, per_metre = fit(sight, canvas, map_size, low, high, least, largest)
    if not len(scene):
        return mapped, first, per_metre

    # Beside the canvas where u z < -z / 2 for all of the box, and so on; the last is z itself.
    u, v, z = image[:, 0], image[:, 1], image[:, 2]
    sides = np.stack([u + 0.5 * z, (width - 0.5) * z - u, v + 0.5 * z, (height - 0.5) * z - v, z], 1)
    u, v, z = image_at[:, 0], image_at[:, 1], image_at[:, 2]
    sides_at = np.stack([u + 0.5 * z, (width - 0.5) * z - u, v + 0.5 * z, (height - 0.5) * z - v, z], 1)
    seen = (extent(sides, sides_at)[1] >= [0, 0, 0, 0, layout.NEAR]).all(1)
    last = first + map_size / per_metre
    casts = mapped[scene] & (cast_high >= first[scene]).all(1) & (cast_low <= last[scene]).all(1)

    lit[:, :2] *= per_metre[scene][..., None]
    lit_at[:, :2] = (lit_at[:, :2] - first[scene]) * per_metre[scene]
    whole[:, : layout.CLOSED + 1] = placed.rows
    least, largest = ((across - first[scene]) * per_metre[scene] for across in (cast_low, cast_high))
    reach = np.concatenate([np.floor(least) - 1, largest + 1], 1)
    reach = np.clip(reach, [0, 0, -1, -1], [map_size, map_size, map_size - 1, map_size - 1])
    whole[:, layout.MAP_BOX : layout.MAP_BOX + 4] = np.where(casts[:, None], reach, [0, 0, -1, -1])
    whole[:, layout.NODE], whole[:, layout.SEEN], whole[:, layout.CASTS] = placed.node, seen, casts
    real[:, layout.TO_IMAGE : layout.TO_IMAGE + 12] = np.dstack([image, image_at]).reshape(-1, 12)
    real[:, layout.TO_MAP : layout.TO_MAP + 12] = np.dstack([lit, lit_at]).reshape(-1, 12)
    real[:, layout.TO_SUN : layout.TO_SUN + 3] = dot(np.swapaxes(turned, 1, 2), sun[:, 2:]) / scale
    real[:, layout.UNSCALE : layout.UNSCALE + 3] = 1 / scale
    real[:, layout.TINT : layout.TINT + 3] = np.clip(placed.tint, 0, 1)
    return mapped, first, per_metre


def _boxes(placed: Placed, sight: Sight, N: int, M: int) -> np.ndarray:
    """3D boxes as of ``SceneGeometry``; several layers of a node share one, turned as the first of them is."""
    box = np.zeros((N * M, 7))
    labelled = placed.node >= 0
    scene, at, yaw = placed.scene[labelled], placed.at[labelled], placed.yaw[labelled]
    key = scene * M + placed.node[labelled]
    nodes, first, own = np.unique(key, return_index=True, return_inverse=True)
    if not len(nodes):
        return box.reshape(N, M, 7)
    base_yaw, base = yaw[first], at[first]
    turn, away = yaw - base_yaw[own], at - base[own]
    middle, half = (placed.scale[labelled] * part[labelled] for part in (placed.middle, placed.half))
    cos, sin = np.cos(turn), np.sin(turn)
    base_cos, base_sin = np.cos(base_yaw), np.sin(base_yaw)
    middle_x = cos * middle[:, 0] - sin * middle[:, 1] + base_cos[own] * away[:, 0] + base_sin[own] * away[:, 1]
    middle_y = sin * middle[:, 0] + cos * middle[:, 1] - base_sin[own] * away[:, 0] + base_cos[own] * away[:, 1]
    half_x = np.abs(cos) * half[:, 0] + np.abs(sin) * half[:, 1]
    half_y = np.abs(sin) * half[:, 0] + np.abs(cos) * half[:, 1]
    middle = np.stack([middle_x, middle_y, middle[:, 2] + away[:, 2]], 1)
    half = np.stack([half_x, half_y, half[:, 2]], 1)
    low, high = np.full((len(nodes), 3), np.inf), np.full((len(nodes), 3), -np.inf)
    np.minimum.at(low, own, middle - half)
    np.maximum.at(high, own, middle + half)
    x, y = (low[:, 0] + high[:, 0]) / 2, (low[:, 1] + high[:, 1]) / 2
    across = np.stack([base_cos * x - base_sin * y, base_sin * x + base_cos * y, low[:, 2]], 1)
    axes = sight.axes[scene[first]]
    heading = dot(axes, np.stack([base_cos, base_sin, 0 * x], 1)[:, None])
    box[nodes, :3] = (high - low)[:, [2, 1, 0]]
    box[nodes, 3:6] = dot(axes, (base + across - sight.eye[scene[first]])[:, None])
    box[nodes, 6] = np.arctan2(-heading[:, 2], heading[:, 0])
    return box.reshape(N, M, 7)
