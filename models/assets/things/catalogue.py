"""What a street is built of: the project's own meshes, by kind, so that nothing needs to be downloaded.

Every mesh stands as ``probscene.mesh`` says: metres, +x forward, on the ground, centred. Houses and signs face +x,
street lamps reach out over it. Tinted are the paint of vehicles, the walls of buildings, leaves, jackets, the frames
of bicycles; with a tint of 1 they are white cars, pale jackets, and the walls and leaves of their own colours.
"""

from functools import cache

from probscene.mesh import Mesh

from .. import kerbs as linings
from . import buildings, furniture, lorries, people, plants, posts, vehicles

KINDS = (
    "car", "van", "truck", "building", "tree", "bush", "pole", "sign", "pedestrian", "cyclist", "object",
)  # fmt: skip
DECORATION = ("slab", "kerb", "lawn", "fence")
GROUPS = {
    "truck": {"truck": range(0, 6), "bus": range(6, 8)},
    "building": {"house": buildings.HOUSES, "town": buildings.TOWN, "block": buildings.BLOCKS},
    "tree": {"broad": range(0, 6), "poplar": range(6, 8), "conifer": range(8, 11)},
    "bush": {"loose": range(0, 3), "clipped": range(3, 6)},
    "pole": {"lamp": range(0, 4), "mast": range(4, 5), "light": range(5, 7)},
}  # which of a kind's meshes are what, for a model that puts some in cities only


@cache
def street() -> dict[str, tuple[Mesh, ...]]:
    """Meshes by kind: ``KINDS``, and ``DECORATION`` for what has no node.

    ``slab`` (pavement) and ``lawn`` (raised grass) are boxes of 1 m by 1 m across, 8, 32 and 128 m long, to be scaled
    across and upward and not along; ``kerb`` is as long and of its real size; a ``fence`` is 6 m long. All four run
    along x.
    """
    return {
        "car": vehicles.cars(),
        "van": vehicles.vans(),
        "truck": lorries.trucks(),
        "building": buildings.buildings(),
        "tree": plants.trees(),
        "bush": plants.bushes(),
        "pole": posts.poles(),
        "sign": posts.signs(),
        "pedestrian": people.pedestrians(),
        "cyclist": people.cyclists(),
        "object": furniture.objects(),
        "slab": linings.slabs(),
        "kerb": linings.kerbs(),
        "lawn": linings.lawns(),
        "fence": linings.fences(),
    }
