"""CPU time of rendering streets of meshes, against moderngl on Mesa's llvmpipe and the time to write the bytes.

    python benchmarks/render_meshes.py --scenes 32 --repeats 5

30 objects a scene, 14,000 triangles, a third of them textured, all with smooth normals; ground in seven strips, sun
with a shadow map, haze. The peer draws the same triangles by the same matrices into an image, an id buffer and a depth
buffer, back faces culled, shadows from a map of the same size with 2 x 2 samples, and reads all three back; its lists
of what to draw are prepared outside the time, and it finds no boxes, counts or silhouettes, the renderer does. "fill"
writes the bytes of image, ids, classes and depth into fresh memory. Figures are CPU milliseconds an image over all
threads, the least of interleaved repeats; "ids" is the share of pixels at which the two ids differ.
"""

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
import torch

from probscene.mesh import Mesh, Surface
from probscene.renderers import mesh_tables as tables
from probscene.renderers.mesh_atlas import MeshAtlas
from probscene.renderers.mesh_instances import instances
from probscene.renderers.mesh_scenes import view
from probscene.renderers.meshes import MeshRenderer
from probscene.world import Camera, Ground, Light, Meshes, Photo, World, resolve_ground, resolve_meshes, resolve_scene

OBJECTS = 30
EDGES = (-9.0, -3.6, -0.1, 0.1, 3.6, 9.0)
CHOICE = (1, 2, 0, 3, 0, 2, 1)


def body(length, width, height, power, columns=18, rows=14, texture=None) -> Mesh:
    """A rounded block of 468 triangles."""
    around, up = np.arange(columns) * 2 * np.pi / columns, np.arange(1, rows) * np.pi / rows - np.pi / 2

    def bent(value):
        return np.sign(value) * np.abs(value) ** power

    ring = np.stack([bent(np.cos(around)), bent(np.sin(around))], 1)
    size = np.array([length / 2, width / 2, height / 2])
    points = [np.array([*(corner * bent(np.cos(angle))), bent(np.sin(angle))]) for angle in up for corner in ring]
    points = np.array([*points, [0, 0, -1], [0, 0, 1]])
    normals = points / size
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bottom, triangles = len(points) - 2, []
    for i in range(columns):
        j = (i + 1) % columns
        triangles += [(bottom, j, i), (bottom + 1, (rows - 2) * columns + i, (rows - 2) * columns + j)]
        for k in range(rows - 2):
            a, b, c, d = k * columns + i, k * columns + j, (k + 1) * columns + i, (k + 1) * columns + j
            triangles += [(a, b, d), (a, d, c)]
    triangles = np.array(triangles)
    uv = (points[triangles][..., [0, 2]] + 1) * 2
    return Mesh(points * size + [0, 0, size[2]], triangles, (220, 215, 210), None, normals[triangles], uv, texture)


def noise(generator, colour, size=128) -> np.ndarray:
    return np.clip(np.array(colour) + generator.normal(0, 14, (size, size, 1)), 0, 255).astype(np.uint8)


def streets(scenes: int, canvas: tuple[int, int]) -> World:
    """30 objects in front of a camera over a road."""
    generator = np.random.default_rng(0)
    shape = scenes, OBJECTS
    panes = np.kron(generator.integers(60, 255, (8, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    meshes = body(4.2, 1.8, 1.5, 0.5), body(0.6, 0.6, 1.8, 1.0), body(6, 6, 7, 0.3, texture=panes)
    x = generator.uniform(8, 60, shape)
    columns = {
        "mesh": generator.integers(0, 3, shape),
        "x": x,
        "y": generator.uniform(-0.7, 0.7, shape) * x,
        "yaw": generator.uniform(-3, 3, shape),
        "tint": generator.uniform(0.4, 1, (*shape, 3)),
    }
    layer = Meshes("thing", meshes, **{name: torch.from_numpy(value) for name, value in columns.items()})
    colours = {"road": (100, 100, 104), "grass": (85, 120, 60), "path": (150, 145, 140), "marking": (225, 225, 225)}
    surfaces = tuple(Surface(name, noise(generator, colour), (4.0, 4.0)) for name, colour in colours.items())
    ground = Ground(surfaces, torch.tensor([EDGES]), torch.tensor([CHOICE]))
    return World(
        torch.zeros(shape, dtype=torch.int64),
        ("thing",),
        (resolve_meshes(layer, torch.ones(shape, dtype=torch.bool)),),
        resolve_scene(Camera.kitti(canvas), scenes),
        resolve_scene(Light(), scenes),
        resolve_ground(ground, scenes),
        resolve_scene(Photo(), scenes),
    )


HEAD = "#version 330\n"
SHADED = """
uniform sampler2DShadow shadow;
uniform float map_size;
uniform vec3 sun;
uniform float haze;
uniform vec3 horizon;
uniform int label;
layout(location = 0) out vec4 image;
layout(location = 1) out int id;
void shade(vec3 albedo, vec3 normal, vec3 lit, float far) {
    float cosine = max(dot(normal, sun), 0.0);
    vec3 at = vec3((lit.xy + 0.5) / map_size, -(lit.z + 0.1) / 800 + 0.5);
    bool inside = all(greaterThan(at.xy, vec2(0))) && all(lessThan(at.xy, vec2(1)));
    if (cosine > 0 && inside) cosine *= texture(shadow, at);
    vec3 colour = albedo * (0.7 * cosine + 0.45 * (0.75 + 0.25 * normal.z));
    image = vec4(mix(horizon, colour, exp(-haze * far)), 1);
    id = label;
}
"""
MAP_VERTEX = """
uniform vec4 to_map[3];
uniform float map_size;
in vec3 position;
void main() {
    vec4 p = vec4(position, 1);
    vec2 at = (vec2(dot(to_map[0], p), dot(to_map[1], p)) + 0.5) / map_size * 2 - 1;
    gl_Position = vec4(at, -dot(to_map[2], p) / 400, 1);
}"""
EMPTY = "void main() {}"
VERTEX = """
uniform vec4 to_image[3];
uniform vec4 to_map[3];
uniform mat3 turn;
uniform vec3 tint;
uniform vec2 canvas;
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 colour;
out vec3 facing;
out vec2 place;
out vec3 base;
out vec3 lit;
out float far;
void main() {
    vec4 p = vec4(position, 1);
    vec3 at = vec3(dot(to_image[0], p), dot(to_image[1], p), dot(to_image[2], p));
    lit = vec3(dot(to_map[0], p), dot(to_map[1], p), dot(to_map[2], p));
    facing = turn * normal;
    place = uv;
    base = colour * tint;
    far = at.z;
    gl_Position = vec4((at.xy + 0.5 * at.z) / canvas * 2 - at.z, at.z * 1.0004 - 0.20004, at.z);
}"""
MESH_FRAGMENT = """
uniform sampler2D panes;
uniform bool textured;
in vec3 facing;
in vec2 place;
in vec3 base;
in vec3 lit;
in float far;
void main() {
    vec3 albedo = base;
    if (textured) albedo *= texture(panes, place).rgb;
    shade(albedo, facing, lit, far);
}"""
GROUND_VERTEX = """
uniform mat3 to_image;
uniform vec3 eye;
uniform vec4 to_map[3];
uniform vec2 canvas;
in vec2 position;
out vec2 where;
out vec3 lit;
out float far;
void main() {
    vec3 at = to_image * (vec3(position, 0) - eye);
    vec4 p = vec4(position, 0, 1);
    lit = vec3(dot(to_map[0], p), dot(to_map[1], p), dot(to_map[2], p));
    where = position;
    far = at.z;
    gl_Position = vec4((at.xy + 0.5 * at.z) / canvas * 2 - at.z, at.z * 1.0004 - 0.20004, at.z);
}"""
GROUND_FRAGMENT = """
uniform float edges[6];
uniform int choice[7];
uniform sampler2DArray surfaces;
in vec2 where;
in vec3 lit;
in float far;
void main() {
    int strip = 0;
    while (strip < 6 && where.y >= edges[strip]) strip += 1;
    vec3 albedo = texture(surfaces, vec3(-where.y / 4, where.x / 4, choice[strip])).rgb;
    shade(albedo, vec3(0, 0, 1), lit, far);
}"""
SKY_VERTEX = """
in vec2 position;
out vec2 at;
void main() { at = position; gl_Position = vec4(position, 0.999999, 1); }"""
SKY_FRAGMENT = """
uniform vec2 canvas;
uniform vec3 lens;
uniform vec3 zenith;
uniform vec3 horizon;
in vec2 at;
layout(location = 0) out vec4 image;
layout(location = 1) out int id;
void main() {
    vec2 ray = ((at + 1) / 2 * canvas - 0.5 - lens.yz) / lens.x;
    image = vec4(mix(horizon, zenith, max(-ray.y * inversesqrt(1 + dot(ray, ray)), 0.0)), 1);
    id = 0;
}"""


class Peer:
    """The same scenes through OpenGL, on the CPU."""

    def __init__(self, world: World, canvas: tuple[int, int], map_size: int):
        import moderngl

        self.canvas, self.map_size, atlas, sight = canvas, map_size, MeshAtlas(), view(world)
        table = instances(world, atlas, canvas, map_size)
        self.real = table.real.reshape(-1, tables.REALS).astype(np.float32)
        self.whole = table.whole.reshape(-1, tables.INTEGERS)
        scenes = table.scenes.reshape(-1, tables.SCENE)
        self.first, (layer,) = table.first, world.layers
        self.yaw = layer.yaw.numpy()
        self.mesh = layer.mesh.numpy()
        light, camera = world.light, world.camera
        height, width = canvas
        context = self.context = moderngl.create_standalone_context(backend="egl")
        self.name = context.info["GL_RENDERER"]
        self.map = context.depth_texture((map_size, map_size))
        self.map.compare_func = "<="
        self.map.filter = moderngl.LINEAR, moderngl.LINEAR
        self.map_buffer = context.framebuffer(depth_attachment=self.map)
        image, ids = context.renderbuffer((width, height), 3), context.renderbuffer((width, height), 1, dtype="i2")
        self.buffer = context.framebuffer([image, ids], context.depth_renderbuffer((width, height)))
        self.draw, self.cast = self._program(VERTEX, SHADED + MESH_FRAGMENT), self._program(MAP_VERTEX, EMPTY)
        self.ground = self._program(GROUND_VERTEX, SHADED + GROUND_FRAGMENT)
        self.sky = self._program(SKY_VERTEX, SKY_FRAGMENT)
        horizon = tuple(light.horizon[0].tolist())
        for program in (self.draw, self.ground):
            program["map_size"], program["canvas"] = map_size, (width, height)
            program["sun"], program["haze"] = tuple(sight.sun[0, 2]), float(light.haze[0])
            program["horizon"], program["shadow"] = horizon, 0
        self.cast["map_size"] = map_size
        self.draw["panes"], self.ground["surfaces"], self.ground["label"] = 1, 1, 0
        self.ground["edges"], self.ground["choice"] = EDGES, CHOICE
        self.ground["to_image"] = tuple(sight.image[0].T.ravel())
        self.ground["eye"] = tuple(sight.eye[0])
        self.sky["canvas"], self.sky["horizon"] = (width, height), horizon
        self.sky["zenith"] = tuple(light.zenith[0].tolist())
        self.sky["lens"] = float(camera.focal[0]), float(camera.centre_x[0]), float(camera.centre_y[0])
        on_map = scenes[:, tables.ON_MAP : tables.ON_MAP + 12].reshape(-1, 3, 4)
        per_metre = np.linalg.norm(np.linalg.solve(sight.ray.swapaxes(1, 2), on_map[:, :, 1:].swapaxes(1, 2)), axis=1)
        rows = sight.sun * per_metre[:, :, None]
        self.ground_map = np.concatenate([rows, on_map[:, :, :1] - rows @ sight.eye[:, :, None]], 2).astype("f4")
        self._meshes(layer.meshes, world.ground.surfaces)

    def _program(self, vertex: str, fragment: str):
        return self.context.program(vertex_shader=HEAD + vertex, fragment_shader=HEAD + fragment)

    def _meshes(self, meshes, surfaces):
        self.drawn, self.casting, self.panes = [], [], []
        context = self.context
        for mesh in meshes:
            corners = mesh.positions[mesh.triangles]
            colour = np.repeat(mesh.colour[:, None] / 255, 3, 1)
            data = np.concatenate([corners, mesh.normals, mesh.uv, colour], 2).astype("f4").reshape(-1, 11)
            unique, index = np.unique(data, axis=0, return_inverse=True)
            vertices, index = context.buffer(unique.tobytes()), context.buffer(index.astype("i4").tobytes())
            names = "position", "normal", "uv", "colour"
            self.drawn.append(context.vertex_array(self.draw, [(vertices, "3f 3f 2f 3f", *names)], index))
            self.casting.append(context.vertex_array(self.cast, [(vertices, "3f 32x", "position")], index))
            self.panes.append(None)
            if mesh.texture is not None:
                self.panes[-1] = context.texture(mesh.texture.shape[1::-1], 3, mesh.texture.tobytes())
                self.panes[-1].build_mipmaps()
        size = surfaces[0].texture.shape[1::-1]
        data = b"".join(surface.texture.tobytes() for surface in surfaces)
        self.surfaces = context.texture_array((*size, len(surfaces)), 3, data)
        self.surfaces.build_mipmaps()
        corners = np.array([[-9, -900], [900, -900], [-9, 900], [900, 900]], "f4")
        self.plane = context.vertex_array(self.ground, [(context.buffer(corners.tobytes()), "2f", "position")])
        corners = np.array([[-1, -1], [3, -1], [-1, 3]], "f4")
        self.beyond = context.vertex_array(self.sky, [(context.buffer(corners.tobytes()), "2f", "position")])

    def __call__(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        import moderngl

        (height, width), number, context = self.canvas, len(self.first) - 1, self.context
        image, ids = np.empty((number, height, width, 3), np.uint8), np.empty((number, height, width), np.int16)
        depth = np.empty((number, height, width), np.float32)
        context.front_face = "cw"  # the image is upside down
        for scene in range(number):
            part = range(self.first[scene], self.first[scene + 1])
            mesh = {k: self.mesh[scene, self.whole[k, tables.NODE]] for k in part}
            context.enable_only(moderngl.DEPTH_TEST)
            self.map_buffer.use()
            self.map_buffer.clear(depth=1.0)
            for k in part:
                self.cast["to_map"].write(self.real[k, tables.TO_MAP : tables.TO_MAP + 12])
                self.casting[mesh[k]].render()
            context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            self.buffer.use()
            self.buffer.clear(depth=1.0)
            self.map.use(0)
            for k in part:
                node = self.whole[k, tables.NODE]
                cos, sin = np.cos(self.yaw[scene, node]), np.sin(self.yaw[scene, node])
                self.draw["to_image"].write(self.real[k, tables.TO_IMAGE : tables.TO_IMAGE + 12])
                self.draw["to_map"].write(self.real[k, tables.TO_MAP : tables.TO_MAP + 12])
                self.draw["turn"], self.draw["label"] = (cos, sin, 0, -sin, cos, 0, 0, 0, 1), int(node) + 1
                self.draw["tint"].write(self.real[k, tables.TINT : tables.TINT + 3])
                self.draw["textured"] = panes is not None if (panes := self.panes[mesh[k]]) else False
                if panes:
                    panes.use(1)
                self.drawn[mesh[k]].render()
            context.enable_only(moderngl.DEPTH_TEST)
            self.ground["to_map"].write(self.ground_map[scene])
            self.surfaces.use(1)
            self.plane.render(moderngl.TRIANGLE_STRIP)
            self.beyond.render(moderngl.TRIANGLES)
            self.buffer.read_into(image[scene], components=3, attachment=0, alignment=1)
            self.buffer.read_into(ids[scene], components=1, attachment=1, dtype="i2", alignment=1)
            self.buffer.read_into(depth[scene], components=1, attachment=-1, dtype="f4", alignment=1)
        return image, ids, depth


def floor(scenes: int, canvas: tuple[int, int]) -> None:
    """Write the bytes of images, ids, classes and depth into fresh memory."""
    np.empty((scenes, *canvas, 3), np.uint8).fill(1)
    np.empty((scenes, *canvas), np.int16).fill(1)
    np.empty((scenes, *canvas), np.uint8).fill(1)
    np.empty((scenes, *canvas), np.float32).fill(1)


def least(runs: dict[str, Callable], repeats: int, scenes: int) -> dict[str, float]:
    """CPU milliseconds an image of each, interleaved."""
    times = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.process_time()
            run()
            times[name].append((time.process_time() - start) * 1000 / scenes)
    return {name: min(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", help="a folder for the first scene as both draw it")
    arguments = parser.parse_args()
    os.environ["LP_NUM_THREADS"] = str(arguments.threads if arguments.threads > 1 else 0)
    torch.set_num_threads(arguments.threads)
    scenes = arguments.scenes
    print(f"CPU ms an image, {scenes} scenes of {OBJECTS} objects, {arguments.threads} threads")
    heads = ("probscene", "4 samples", "OpenGL", "fill", "OpenGL /", "/ fill", "ids")
    print("canvas  ", *(f"{head:>9}" for head in heads))
    for canvas in ((375, 1242), (188, 621), (94, 310)):
        world = streets(scenes, canvas)
        renderer, smooth = (MeshRenderer(canvas, arguments.threads, samples) for samples in (1, 4))
        peer = Peer(world, canvas, renderer.map_size)
        runs = {
            "ours": lambda renderer=renderer, world=world: renderer(world),
            "smooth": lambda smooth=smooth, world=world: smooth(world),
            "peer": peer,
            "fill": lambda canvas=canvas: floor(scenes, canvas),
        }
        figure = least(runs, arguments.repeats, scenes)
        batch, (image, ids, _) = renderer(world), peer()
        differ = float((batch.instance.numpy() != ids).mean())
        figures = (*figure.values(), figure["peer"] / figure["ours"], figure["ours"] / figure["fill"], differ)
        print(f"{canvas[1]}x{canvas[0]}", *(f"{value:9.3f}" for value in figures), f" {peer.name}", flush=True)
        if arguments.pictures:
            import cv2

            both = np.concatenate([batch.image[0].permute(1, 2, 0).numpy(), image[0]])
            cv2.imwrite(f"{arguments.pictures}/{canvas[1]}.png", both[..., ::-1])


if __name__ == "__main__":
    main()
