"""Draws a laid table with Blender's Cycles; probscene starts it, see ``table.py`` beside it.

It runs in the environment that ``make blender`` makes, of bpy, numpy and OpenEXR, and needs no probscene.
"""

import math
import os
import sys
import tempfile

import bpy
import numpy as np
import OpenEXR

sys.path.insert(0, os.environ["PROBSCENE_WORKER"])
from probscene_worker import serve

SAMPLES = 4
IDS = "Object Index"  # in the name of a channel; "IndexOB" before Blender 5
COLOURS = {"plate": (0.85, 0.84, 0.80), "mug": (0.25, 0.35, 0.60), "bottle": (0.10, 0.35, 0.20)}


class Studio:
    """A table, a camera and lights; meshes and materials are made once, so that memory stays where it is."""

    def __init__(self):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.scene.render.engine, self.scene.cycles.device = "CYCLES", "CPU"
        self.scene.cycles.samples, self.scene.cycles.max_bounces = SAMPLES, 3
        self.scene.render.threads_mode, self.scene.render.threads = "FIXED", 1
        self.scene.render.use_persistent_data = True
        self.scene.view_settings.view_transform = "Standard"
        bpy.context.view_layer.use_pass_object_index = True
        self.meshes = {
            "disc": self.mesh(bpy.ops.mesh.primitive_cylinder_add, vertices=32, radius=0.5, depth=1),
            "cone": self.mesh(bpy.ops.mesh.primitive_cone_add, vertices=32, radius1=0.5, radius2=0.3, depth=1),
            "ring": self.mesh(bpy.ops.mesh.primitive_torus_add, major_radius=0.5, minor_radius=0.14),
            "top": self.mesh(bpy.ops.mesh.primitive_plane_add, size=1),
        }
        self.materials = {kind: self.material(kind) for kind in (*COLOURS, "table")}
        self.put("top", (0, 0, 0), (6, 6, 1), "table")
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.data.angle = math.radians(38)
        camera.location, camera.rotation_euler = (0, -1.35, 1.15), (math.radians(48), 0, 0)
        self.scene.collection.objects.link(camera)
        self.scene.camera = camera
        self.light = self.lamp()
        self.folder = tempfile.mkdtemp()

    def mesh(self, add, **size):
        add(**size)
        made = bpy.context.object
        mesh = made.data
        mesh.shade_smooth()
        bpy.data.objects.remove(made)
        return mesh

    def material(self, kind):
        """Plain colours, each object's own."""
        made = bpy.data.materials.new(kind)
        made.use_nodes = True
        shader = made.node_tree.nodes["Principled BSDF"]
        shader.inputs["Roughness"].default_value = 0.7
        if kind == "table":
            shader.inputs["Base Color"].default_value = (0.30, 0.18, 0.09, 1)
        else:
            colour = made.node_tree.nodes.new("ShaderNodeObjectInfo")
            made.node_tree.links.new(colour.outputs["Color"], shader.inputs["Base Color"])
        return made

    def lamp(self):
        """A sun, and some light from everywhere."""
        world = bpy.data.worlds.new("world")
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs[0].default_value = (0.45, 0.47, 0.5, 1)
        self.scene.world = world
        sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
        self.scene.collection.objects.link(sun)
        return sun

    def shine(self, values):
        """Let the light be that of a scene."""
        self.light.data.energy = 2.5 * values["light"]
        self.light.rotation_euler = (math.radians(40), 0, values["sun"])

    def put(self, mesh, where, scale, kind, id=0, turn=(0, 0, 0), shade=1.0):
        made = bpy.data.objects.new(kind, self.meshes[mesh].copy() if id == 0 else self.meshes[mesh])
        made.location, made.scale, made.rotation_euler, made.pass_index = where, scale, turn, id
        made.color = (*(shade * part for part in COLOURS.get(kind, (1, 1, 1))), 1)
        self.scene.collection.objects.link(made)
        made.material_slots or made.data.materials.append(None)
        made.material_slots[0].link = "OBJECT"
        made.material_slots[0].material = self.materials[kind]
        return made

    def body(self, node):
        """The parts of an object that stands on the table at x, y."""
        v = node.values
        x, y, shade = v["x"], v["y"], v["shade"]
        if node.kind == "plate":
            size = v["size"]
            rim = self.put("disc", (x, y, 0.008), (size, size, 0.016), "plate", node.id, shade=shade)
            inner = self.put(
                "disc", (x, y, 0.010), (0.7 * size, 0.7 * size, 0.016), "plate", node.id, shade=0.92 * shade
            )
            return [rim, inner]
        if node.kind == "mug":
            side = v["turn"]
            at = (x + 0.045 * math.cos(side), y + 0.045 * math.sin(side), 0.045)
            cup = self.put("disc", (x, y, 0.045), (0.08, 0.08, 0.09), "mug", node.id, shade=shade)
            return [cup, self.put("ring", at, (0.05, 0.05, 0.05), "mug", node.id, (math.pi / 2, 0, side), shade)]
        high = v["size"]
        trunk = self.put("disc", (x, y, 0.35 * high), (0.07, 0.07, 0.7 * high), "bottle", node.id, shade=shade)
        neck = self.put("cone", (x, y, 0.85 * high), (0.05, 0.05, 0.3 * high), "bottle", node.id, shade=shade)
        return [trunk, neck]

    def render(self, scene):
        self.scene.render.resolution_x, self.scene.render.resolution_y = scene.width, scene.height
        self.scene.cycles.seed = scene.seed
        self.shine(scene.values)
        parts = [part for node in scene.nodes for part in self.body(node)]
        bpy.ops.render.render()
        for part in parts:
            bpy.data.objects.remove(part)
        return self.saved(scene)

    def saved(self, scene):
        """Colours and ids of the render that is there."""
        files = os.path.join(self.folder, "image.png"), os.path.join(self.folder, "ids.exr")
        output, result = self.scene.render.image_settings, bpy.data.images["Render Result"]
        for file, media, kind in zip(
            files, ("IMAGE", "MULTI_LAYER_IMAGE"), ("PNG", "OPEN_EXR_MULTILAYER"), strict=True
        ):
            output.media_type, output.file_format = media, kind
            output.color_depth = "8" if kind == "PNG" else "32"
            result.save_render(file, scene=self.scene)
        with OpenEXR.File(files[1], separate_channels=True) as file:
            channels = {name: channel for part in file.parts for name, channel in part.channels.items()}
            ids = next(channel.pixels for name, channel in channels.items() if IDS in name)
        image = bpy.data.images.load(files[0])
        pixels = np.empty(4 * scene.height * scene.width, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
        colours = np.rint(255 * pixels.reshape(scene.height, scene.width, 4)[::-1, :, :3])
        return {"image": colours.astype(np.uint8), "instance": np.rint(ids).astype(np.uint16)}


if __name__ == "__main__":
    serve(Studio().render, version="1")
