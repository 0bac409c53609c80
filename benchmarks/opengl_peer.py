"""The mesh renderer's peer: the same scenes through moderngl on Mesa's llvmpipe.

It draws the same triangles by the same matrices into an image, an id buffer and a depth buffer, back faces culled,
shadows from a map of the same size with 2 x 2 samples, and reads all three back.
"""

import moderngl
import numpy as np
import opengl_shaders as glsl

from probscene.renderers.meshes.instances import instances
from probscene.renderers.meshes.scenes import view
from probscene.renderers.meshes.tables import layout
from probscene.renderers.meshes.tables.atlas import MeshAtlas
from probscene.world import World


class Peer:
    """The same scenes through OpenGL, on the CPU."""

    def __init__(self, world: World, canvas: tuple[int, int], map_size: int):
        self.canvas, self.map_size, atlas, sight = canvas, map_size, MeshAtlas(), view(world)
        table = instances(world, atlas, canvas, map_size)
        self.real = table.real.reshape(-1, layout.REALS).astype(np.float32)
        self.whole = table.whole.reshape(-1, layout.INTEGERS)
        scenes = table.scenes.reshape(-1, layout.SCENE)
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
        self.draw, self.cast = (
            self._program(glsl.VERTEX, glsl.SHADED + glsl.MESH_FRAGMENT),
            self._program(glsl.MAP_VERTEX, glsl.EMPTY),
        )
        self.ground = self._program(glsl.GROUND_VERTEX, glsl.SHADED + glsl.GROUND_FRAGMENT)
        self.sky = self._program(glsl.SKY_VERTEX, glsl.SKY_FRAGMENT)
        horizon = tuple(light.horizon[0].tolist())
        for program in (self.draw, self.ground):
            program["map_size"], program["canvas"] = map_size, (width, height)
            program["sun"], program["haze"] = tuple(sight.sun[0, 2]), float(light.haze[0])
            program["horizon"], program["shadow"] = horizon, 0
        self.cast["map_size"] = map_size
        self.draw["panes"], self.ground["surfaces"], self.ground["label"] = 1, 1, 0
        self.ground["edges"] = tuple(world.ground.edges[0].tolist())
        self.ground["choice"] = tuple(world.ground.surface[0].tolist())
        self.ground["to_image"] = tuple(sight.image[0].T.ravel())
        self.ground["eye"] = tuple(sight.eye[0])
        self.sky["canvas"], self.sky["horizon"] = (width, height), horizon
        self.sky["zenith"] = tuple(light.zenith[0].tolist())
        self.sky["lens"] = float(camera.focal[0]), float(camera.centre_x[0]), float(camera.centre_y[0])
        on_map = scenes[:, layout.ON_MAP : layout.ON_MAP + 12].reshape(-1, 3, 4)
        per_metre = np.linalg.norm(np.linalg.solve(sight.ray.swapaxes(1, 2), on_map[:, :, 1:].swapaxes(1, 2)), axis=1)
        rows = sight.sun * per_metre[:, :, None]
        self.ground_map = np.concatenate([rows, on_map[:, :, :1] - rows @ sight.eye[:, :, None]], 2).astype("f4")
        self._meshes(layer.meshes, world.ground.surfaces)

    def _program(self, vertex: str, fragment: str):
        return self.context.program(vertex_shader=glsl.HEAD + vertex, fragment_shader=glsl.HEAD + fragment)

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
        (height, width), number, context = self.canvas, len(self.first) - 1, self.context
        image, ids = np.empty((number, height, width, 3), np.uint8), np.empty((number, height, width), np.int16)
        depth = np.empty((number, height, width), np.float32)
        context.front_face = "cw"  # the image is upside down
        for scene in range(number):
            part = range(self.first[scene], self.first[scene + 1])
            mesh = {k: self.mesh[scene, self.whole[k, layout.NODE]] for k in part}
            context.enable_only(moderngl.DEPTH_TEST)
            self.map_buffer.use()
            self.map_buffer.clear(depth=1.0)
            for k in part:
                self.cast["to_map"].write(self.real[k, layout.TO_MAP : layout.TO_MAP + 12])
                self.casting[mesh[k]].render()
            context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            self.buffer.use()
            self.buffer.clear(depth=1.0)
            self.map.use(0)
            for k in part:
                node = self.whole[k, layout.NODE]
                cos, sin = np.cos(self.yaw[scene, node]), np.sin(self.yaw[scene, node])
                self.draw["to_image"].write(self.real[k, layout.TO_IMAGE : layout.TO_IMAGE + 12])
                self.draw["to_map"].write(self.real[k, layout.TO_MAP : layout.TO_MAP + 12])
                self.draw["turn"], self.draw["label"] = (cos, sin, 0, -sin, cos, 0, 0, 0, 1), int(node) + 1
                self.draw["tint"].write(self.real[k, layout.TINT : layout.TINT + 3])
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
