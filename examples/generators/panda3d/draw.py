"""Draws pallets, crates and drums with Panda3D; probscene starts it, see ``pallets.py`` beside it.

It needs panda3d and numpy, and not probscene: any Python that has these can run it.
"""

import math
import os
import sys

import numpy as np
from direct.showbase.ShowBase import ShowBase
from panda3d.core import (
    AmbientLight,
    DirectionalLight,
    Geom,
    GeomNode,
    GeomTriangles,
    GeomVertexData,
    GeomVertexFormat,
    GeomVertexWriter,
    NodePath,
    loadPrcFileData,
)

sys.path.insert(0, os.environ["PROBSCENE_WORKER"])
from probscene_worker import serve

FINER = 2  # rendered pixels along a pixel's side
STEP = 16  # between two levels of a colour channel that stands for an id
FLOOR, WOOD = (0.52, 0.53, 0.52), (0.72, 0.55, 0.36)


def prism(sides):
    """A prism on a regular polygon, standing on the floor, 1 wide and high: 4 sides make a box, 20 a drum."""
    data = GeomVertexData("prism", GeomVertexFormat.getV3n3(), Geom.UHStatic)
    vertex, normal = GeomVertexWriter(data, "vertex"), GeomVertexWriter(data, "normal")
    triangles = GeomTriangles(Geom.UHStatic)
    reach = math.sqrt(0.5) if sides == 4 else 0.5
    angles = [2 * math.pi * (i + 0.5) / sides for i in range(sides)]
    corner = [(reach * math.cos(angle), reach * math.sin(angle)) for angle in angles]

    def face(points, directions):
        first = vertex.getWriteRow()
        for point, direction in zip(points, directions, strict=True):
            vertex.addData3(*point)
            normal.addData3(*direction)
        for i in range(1, len(points) - 1):
            triangles.addVertices(first, first + i, first + i + 1)

    for i, (a, b) in enumerate(zip(corner, corner[1:] + corner[:1], strict=True)):
        flat = 2 * math.pi * (i + 1) / sides
        out = [(math.cos(flat), math.sin(flat), 0)] * 4 if sides == 4 else [(*a, 0), (*b, 0), (*b, 0), (*a, 0)]
        face([(*a, 0), (*b, 0), (*b, 1), (*a, 1)], out)
    face([(x, y, 1) for x, y in corner], [(0, 0, 1)] * sides)
    geom = Geom(data)
    geom.addPrimitive(triangles)
    node = GeomNode("prism")
    node.addGeom(geom)
    return NodePath(node)


class Stage:
    """A floor, a camera above it and a sun, at one size of image."""

    def __init__(self, height, width):
        size = f"win-size {FINER * width} {FINER * height}"
        loadPrcFileData("", f"{size}\nload-display p3tinydisplay\naudio-library-name null\nnotify-level error")
        self.base = ShowBase(windowType="offscreen")
        self.base.camLens.setFov(34)
        self.base.cam.setPos(0, -8.5, 7.5)
        self.base.cam.lookAt(0, 0.2, 0)
        self.shapes = {"floor": prism(4), "pallet": prism(4), "crate": prism(4), "drum": prism(20)}
        self.sun, self.sky = DirectionalLight("sun"), AmbientLight("sky")
        self.at_sun = self.base.render.attachNewNode(self.sun)
        self.base.render.setLight(self.at_sun)
        self.base.render.setLight(self.base.render.attachNewNode(self.sky))

    def frame(self):
        self.base.graphicsEngine.renderFrame()
        shot = self.base.win.getScreenshot()
        pixels = np.frombuffer(shot.getRamImageAs("RGB").getData(), np.uint8)
        return pixels.reshape(shot.getYSize(), shot.getXSize(), 3)[::-1]

    def render(self, scene):
        light = scene.values["light"]
        self.sun.setColor((light, light, 0.95 * light, 1))
        self.sky.setColor((0.6, 0.61, 0.64, 1))
        self.at_sun.setHpr(math.degrees(scene.values["sun"]), -55, 0)
        root = self.base.render.attachNewNode("scene")
        bodies = {0: self.put(root, "floor", 0, 0, -0.1, 0, (30, 30, 0.1), FLOOR)}
        for node in scene.nodes:
            if node.kind in self.shapes and node.kind != "floor":
                v = node.values
                colour = v.get("colour", WOOD)
                bodies[node.id] = self.put(root, node.kind, v["x"], v["y"], v["z"], v["yaw"], v["size"], colour)
        fine = self.frame().astype(np.uint16)
        height, width = scene.height, scene.width
        colours = fine.reshape(height, FINER, width, FINER, 3).mean((1, 3)).round().astype(np.uint8)
        root.setLightOff(1)
        for id, body in bodies.items():
            body.setColor((STEP * (id % 16) + 8) / 255, (STEP * (id // 16) + 8) / 255, 0, 1)
        shades = self.frame()[::FINER, ::FINER].astype(np.int64) // STEP
        root.removeNode()
        return {"image": colours, "instance": shades[..., 0] + 16 * shades[..., 1]}

    def put(self, root, kind, x, y, z, yaw, size, colour):
        body = self.shapes[kind].copyTo(root)
        body.setPos(x, y, z)
        body.setH(math.degrees(yaw))
        body.setScale(*size)
        body.setColor(*colour, 1)
        body.setBin("fixed", root.getNumChildren())  # else states are drawn in the order of their addresses
        return body


def main():
    stages = {}

    def render(scene):
        size = scene.height, scene.width
        if size not in stages:
            stages[size] = Stage(*size)
        return stages[size].render(scene)

    serve(render, version="1")


if __name__ == "__main__":
    main()
