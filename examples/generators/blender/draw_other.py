"""The table of ``draw.py`` as another artist would make it: wood with a grain, glossy glazes, lamps above the table."""

import bpy
from draw import COLOURS, Studio
from probscene_worker import serve

COLOURS.update(plate=(0.65, 0.72, 0.80), mug=(0.55, 0.16, 0.12), bottle=(0.22, 0.30, 0.10))


class Evening(Studio):
    """Another studio with the same things on the table."""

    def material(self, kind):
        made = super().material(kind)
        nodes, links = made.node_tree.nodes, made.node_tree.links
        shader = nodes["Principled BSDF"]
        shader.inputs["Roughness"].default_value = 0.25
        if kind == "table":
            wave, ramp = nodes.new("ShaderNodeTexWave"), nodes.new("ShaderNodeValToRGB")
            wave.inputs["Scale"].default_value, wave.inputs["Distortion"].default_value = 6, 5
            ramp.color_ramp.elements[0].color = (0.42, 0.30, 0.18, 1)
            ramp.color_ramp.elements[1].color = (0.52, 0.39, 0.25, 1)
            links.new(wave.outputs["Fac"], ramp.inputs["Fac"])
            links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
        return made

    def lamp(self):
        world = bpy.data.worlds.new("world")
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs[0].default_value = (0.30, 0.25, 0.20, 1)
        self.scene.world = world
        lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "AREA"))
        lamp.data.size, lamp.data.color, lamp.location = 0.8, (1, 0.85, 0.7), (0, 0, 1.6)
        self.scene.collection.objects.link(lamp)
        return lamp

    def shine(self, values):
        self.light.data.energy = 25 * values["light"]
        self.light.location.x = 0.3 * values["sun"]


if __name__ == "__main__":
    serve(Evening().render, version="1")
