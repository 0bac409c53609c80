"""Driving scenes (Meta-Sim2, section 4.3): city, suburban and rural streets as KITTI's camera sees them.

``driving(scenario, prior)`` is a model; ``SCENARIOS`` are the three under the tuned priors, for ``--scenarios``, and
``SIMPLE`` under the simple one. Structures are in ``driving_grammars``, what is drawn on which node in
``driving_parameters``, where things stand in ``driving_strips`` and ``driving_things``. Traffic keeps to the right. The
camera drives in one of its direction's lanes, at x = 0. Nothing stands inside anything else, by the rectangles that
meshes cover on the ground, to within a centimetre.

Departures from the paper: roads are straight; a median is there or not by a production of its own; vans and trucks are
kinds of their own, left out unless asked for (``vehicles``), because a van that is labelled as a car is labelled wrong.

``--assets DIR``, or the environment variable ``PROBSCENE_ASSETS``, draws with a folder of meshes, one subfolder a kind.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import pyro

from probscene.derive import derive
from probscene.mesh import Mesh, Surface
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.scene import SceneGraph
from probscene.world import Meshes, World

from .assets.meshes.folder import described, folder
from .assets.surfaces import surfaces
from .assets.things.catalogue import GROUPS, street
from .streets import grammars as structures
from .streets.backdrop import backdrop
from .streets.ground import fences, ground, slabs
from .streets.light import camera, light, photo
from .streets.nodes import Nodes
from .streets.placement import things

CANVAS = (188, 621)  # half of KITTI
CLASSES = ("car", "van", "truck", "pedestrian", "cyclist", "pole", "sign", "object", "tree", "bush", "building")
STUFF = ("tree", "bush", "building")


class Assets(NamedTuple):
    """What a street is drawn with: meshes by kind, kerbs, slabs, lawns and fences among them."""

    meshes: Mapping[str, tuple[Mesh, ...]]
    surfaces: Mapping[str, Surface]


# Of the project's own meshes, what stands where; all of a kind that is not named.
FITTING = {
    "city": {"building": ("town", "block"), "tree": ("broad",)},
    "suburban": {"building": ("house",)},
    "rural": {"pole": ("mast", "lamp")},
}


def assets(scenario: str, path: str | None = None) -> Assets:
    """The project's own meshes, those of the kinds in a folder replaced by what is there."""
    own = street()
    meshes = dict(folder(path) if path else own)
    for kind, groups in FITTING[scenario].items():
        if meshes[kind] is own[kind]:
            meshes[kind] = tuple(own[kind][i] for group in groups for i in GROUPS[kind][group])
    return Assets(meshes, surfaces())


def with_assets(path: str, scenario: str, **more) -> SceneModel:
    """A scenario's model with meshes from a folder; ``more`` is as of ``driving``."""
    return driving(scenario, look=partial(assets, path=path), assets=described(path), **more)


def street_scenes(
    num_scenes: int, structure: Policy, scenario: str, vehicles: tuple[str, ...], canvas, look: Callable[[str], Assets]
) -> World:
    """The program of prior and target."""
    grammar = structures.grammar(scenario, vehicles)
    with pyro.plate("scenes", num_scenes, dim=-2):
        graph = SceneGraph(grammar, derive(grammar, structure, num_scenes, structures.MAX_STEPS))
        nodes = Nodes(graph, scenario)
    meshes, surfaces = look(scenario)
    road, there = things(nodes, meshes)
    standing = [Meshes(kind, meshes[kind], *there) for kind in nodes.things]
    farthest = (there.x * graph.mask(*nodes.things)).amax(1, keepdim=True)
    decoration = [slabs(nodes, road, meshes), fences(nodes, road, meshes), backdrop(nodes, farthest)]
    return graph.build(
        *standing,
        *(layer for layer in decoration if layer is not None),
        camera=camera(nodes.only, canvas),
        light=light(nodes.only),
        ground=ground(nodes, road, surfaces),
        photo=photo(nodes.only),
    )


def driving(
    scenario: str,
    prior: str = "tuned",
    canvas: tuple[int, int] = CANVAS,
    look: Callable[[str], Assets] = assets,
    assets: str = "",
    vehicles: tuple[str, ...] = structures.VEHICLES,
) -> SceneModel:
    """A scenario's model.

    Args:
        scenario: ``"city"``, ``"suburban"`` or ``"rural"``.
        prior: ``"tuned"`` to the scenario, or ``"simple"``: 0 to 2 of everything.
        canvas: height and width, pixels; the camera is KITTI's, resized to the width.
        look: gives what a scenario is drawn with; ``assets`` names it in words.
        vehicles: what stands in lanes, among ``"car"``, ``"van"`` and ``"truck"``.
    """
    grammar = structures.grammar(scenario, vehicles)

    def model(name: str, structure: Policy, **more) -> SceneModel:
        program = partial(street_scenes, scenario=scenario, vehicles=vehicles, canvas=canvas, look=look)
        classes = tuple(kind for kind in CLASSES if kind in grammar.kinds)
        more = {"assets": assets, "stuff": tuple(kind for kind in STUFF if kind in classes), **more}
        return SceneModel(name, grammar, structure, program, canvas, structures.MAX_STEPS, classes, **more)

    def target(seed: int) -> SceneModel:
        """The hidden truth of an experiment: another distribution of structures, drawn from ``seed``."""
        return model(f"driving_{scenario}_target", structures.target(scenario, seed, vehicles))

    name = f"driving_{scenario}" if prior == "tuned" else f"driving_{scenario}_{prior}"
    pretraining = structures.pretraining(scenario, prior, vehicles)
    other = partial(with_assets, scenario=scenario, prior=prior, canvas=canvas, vehicles=vehicles)
    structure = structures.prior(scenario, prior, vehicles)
    drawn_with = {"with_assets": other, "assets_variable": "PROBSCENE_ASSETS"}
    return model(name, structure, pretraining=pretraining, target=target, **drawn_with)


def scenarios(prior: str = "tuned", **more) -> dict[str, SceneModel]:
    """The models of all scenarios by name; ``more`` is as of ``driving``."""
    return {name: driving(name, prior, **more) for name in structures.ROWS}


SCENARIOS = scenarios()
SIMPLE = scenarios("simple")
