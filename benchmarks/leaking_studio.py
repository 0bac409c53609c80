"""The table of ``examples/generators/blender`` by an artist who cleans nothing up: new meshes and materials for each
object of each scene stay in Blender's memory. ``generator_memory.py`` starts it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "generators" / "blender"))
from draw import Studio
from probscene_worker import serve


class Leaking(Studio):
    def put(self, mesh, where, scale, kind, *more, **named):
        made = super().put(mesh, where, scale, kind, *more, **named)
        made.data = made.data.copy()
        made.material_slots[0].link = "OBJECT"
        made.material_slots[0].material = self.material(kind)
        return made


if __name__ == "__main__":
    serve(Leaking().render, version="1")
