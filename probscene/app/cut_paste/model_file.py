"""The text of a model file that pastes cut-outs on grounds."""

import json
import math
import re
from typing import NamedTuple

MORE = 1.5  # times as many objects as were seen in an image
FEATHERS = (0.0, 1.0, 2.0)  # pixels
SIZES = (0.8, 1.2)  # factors of a cut-out's own size
MIN_SPREAD = 0.05  # of the logarithm of exposure


class ClassPart(NamedTuple):
    """What a model says of a class.

    Attributes:
        kind: its name in the grammar.
        ignored: whether it is drawn without a label.
        most: objects in an image.
        seen: the least and most objects in an image.
        objects, cutouts: how many are labelled, and drawn.
        x, y: ranges of their middles, pixels; from the middle of what they lie on.
        turn: whether they lie in any direction.
        on: the kind of what they lie on; empty for none.
    """

    kind: str
    ignored: bool
    most: int
    seen: tuple[int, int]
    objects: int
    cutouts: int
    x: tuple[float, float]
    y: tuple[float, float]
    turn: bool
    on: str = ""

    @property
    def list(self) -> str:
        """Of its objects, in the grammar."""
        return f"List_{self.kind}"

    @property
    def longest(self) -> int:
        """Objects that a scene may have."""
        return max(self.most + 1, math.ceil(MORE * self.most))


class ModelPart(NamedTuple):
    """What a model says.

    Attributes:
        name: a Python name.
        canvas: height and width, pixels.
        channels: 1 where photographs are grey.
        classes: the back first.
        photographs: how many were cut.
        overlapping: whether objects cover one another there.
        radius: half the side of a typical object's box, pixels.
        spread: how far the logarithm of the photographs' light goes from its median.
    """

    name: str
    canvas: tuple[int, int]
    channels: int
    classes: tuple[ClassPart, ...]
    photographs: int
    overlapping: bool
    radius: float
    spread: float


def model_text(model: ModelPart) -> str:
    """The file."""
    labelled = [part for part in model.classes if not part.ignored]
    exposure = math.exp(max(model.spread, MIN_SPREAD))
    values = {
        "NAMES": _listed([part.kind for part in labelled]),
        "PHOTOGRAPHS": "one photograph" if model.photographs == 1 else f"{model.photographs} photographs",
        "HEIGHT": f"{model.canvas[0]}",
        "WIDTH": f"{model.canvas[1]}",
        "LISTS": " ".join(part.list for part in labelled if not part.on),
        "RULES": "\n    ".join(_rules(part, labelled) for part in labelled),
        "ON": ", ".join(f'"{part.kind}": "{part.on}"' for part in labelled if part.on),
        "COUNTS": "\n    ".join(
            f'"{part.list}": ps.counts(*[1] * {part.longest + 1}),  # {part.seen[0]} to {part.seen[1]} in a photograph'
            for part in labelled
        ),
        "CUTOUTS": "\n    ".join(
            f'"{part.kind}": ps.Atlas.from_folder(HERE / "cutouts/{part.kind}"),  # {part.cutouts} of {part.objects}'
            for part in model.classes
        ),
        "PLACES": "\n    ".join(
            f'"{part.kind}": (({part.x[0]:.1f}, {part.x[1]:.1f}), ({part.y[0]:.1f}, {part.y[1]:.1f})),'
            for part in model.classes
        ),
        "EDGES": f"{FEATHERS}",
        "SIZES": f"{SIZES}",
        "TURNED": _tuple([part.kind for part in model.classes if part.turn]),
        "CLASSES": _tuple([part.kind for part in labelled]),
        "STEPS": f"{_steps(labelled)}",
        "CHANNELS": f"channels={model.channels}",
        "MODEL": model.name,
        "DARK": f"{1 / exposure:.2f}",
        "LIGHT": f"{exposure:.2f}",
        "RADIUS": f"{model.radius:.1f}",
        "IGNORED": "\n    ".join(f'"{part.kind}": {part.longest},' for part in model.classes if part.ignored),
    }
    parts = [*(["APART"] if not model.overlapping else []), *(["DIRT"] if values["IGNORED"] else [])]
    parts += ["ON"] if values["ON"] else []
    lines = [line for line in TEMPLATE.splitlines() if not (found := re.match(r"(\w+)\|", line)) or found[1] in parts]
    text = "\n".join(re.sub(r"^\w+\|", "", line) for line in lines) + "\n"
    return re.sub(r"«(\w+)»", lambda name: values[name[1]], text)


def _rules(part: ClassPart, parts: list[ClassPart]) -> str:
    below = " ".join(other.list for other in parts if other.on == part.kind)
    return f"{part.list} -> {part.kind}{f'({below})' if below else ''} {part.list} | ε"


def _steps(parts: list[ClassPart]) -> int:
    """Rules of the longest derivation, and a quarter more."""
    longest = {part.kind: part.longest for part in parts}
    objects = sum(part.longest * longest.get(part.on, 1) for part in parts)
    lists = sum(longest.get(part.on, 1) for part in parts)
    return math.ceil(1.25 * (objects + lists)) + 2


def _tuple(names: list[str]) -> str:
    return f"({', '.join(json.dumps(name, ensure_ascii=False) for name in names)}{',' if len(names) == 1 else ''})"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


# Lines that begin with APART stand where objects never overlap, with ON where some lie on others, with DIRT where there
# is what is no object.
TEMPLATE = '''\
"""Scenes of «NAMES», cut out of «PHOTOGRAPHS» by ``probscene begin``.

Look at ``cutouts.png``, delete pictures in ``cutouts`` that are cut badly, and edit what follows.
"""

import math
from pathlib import Path

import pyro
import pyro.distributions as dist

import probscene as ps

HERE = Path(__file__).resolve().parent
HEIGHT, WIDTH = «HEIGHT», «WIDTH»  # pixels
GRAMMAR = ps.Grammar("""
    Scene -> «LISTS»
    «RULES»
""")
COUNTS = {  # how many a scene has: flat, up to half again of the most in a photograph
    «COUNTS»
}
CUTOUTS = {
    «CUTOUTS»
}
GROUNDS = ps.Atlas.from_folder(HERE / "grounds")
EDGES = «EDGES»  # pixels by which edges are feathered: a detector cannot go by one kind of seam
PASTED = {name: atlas.feathered(EDGES) for name, atlas in CUTOUTS.items()}
PLACES = {  # of middles, x and y, pixels: where they are in the photographs, and a little farther
    «PLACES»
}
SIZES = «SIZES»  # factors of a cut-out's own size
TURNED = «TURNED»  # lie in any direction: are round, or differ in direction
CLASSES = «CLASSES»
APART|RADIUS = «RADIUS»  # pixels that objects keep around their middles: in the photographs none covers another
ON|ON = {«ON»}  # what lies on what; PLACES are from its middle then
DIRT|DIRT = {  # what is no object, and how much of it there may be
DIRT|    «IGNORED»
DIRT|}


def pasted(kinds, name, place, look, present=None):
    """The layer of a class, or of what is none."""
    (which, edge, size, turn), (x, y) = look, place
    sprite = CUTOUTS[name].pick(which) * len(EDGES) + (edge * len(EDGES)).long()
    return ps.Sprites(kinds, PASTED[name], sprite, x, y, turn, size, present=present)


def sites(name):
    """Where an object stands, and how it looks."""
    (left, right), (top, bottom) = PLACES[name]
    x = pyro.sample(f"{name}.x", dist.Uniform(left, right))
    y = pyro.sample(f"{name}.y", dist.Uniform(top, bottom))
    which, edge = (pyro.sample(f"{name}.{site}", dist.Uniform(0.0, 1.0)) for site in ("cutout", "edge"))
    size = pyro.sample(f"{name}.size", dist.Uniform(*SIZES))
    turn = pyro.sample(f"{name}.turn", dist.Uniform(-math.pi, math.pi)) if name in TURNED else 0.0
    return (x, y), (which, edge, size, turn)


@ps.scene_model(
    GRAMMAR,
    ps.StructurePrior(GRAMMAR, **COUNTS),
    canvas=(HEIGHT, WIDTH),
    max_steps=«STEPS»,
    classes=CLASSES,
    «CHANNELS»,
    assets=" ".join(atlas.fingerprint for atlas in (GROUNDS, *PASTED.values())),
)
def «MODEL»(scene):
    # Light differs as it does between the photographs; blur and noise come on top of their own.
    light = {"exposure": («DARK», «LIGHT»), "contrast": (0.9, 1.1), "blur": (0.0, 0.6), "noise": (0.0, 3.0)}
    photo = scene.photo(**light)
    ground = pyro.sample("ground", dist.Uniform(0.0, 1.0))
    layers = [ps.Sprites((), GROUNDS, GROUNDS.pick(ground), WIDTH / 2, HEIGHT / 2, present=ground >= 0)]
DIRT|    for name, most in DIRT.items():
DIRT|        with pyro.plate(f"{name}.plate", most, dim=-1):
DIRT|            there = pyro.sample(f"{name}.there", dist.Uniform(0.0, 1.0)) < 0.5
DIRT|            layers.append(pasted((), name, *sites(name), present=there))
    places, looks = {}, {}
    for name in CLASSES:
        with scene.nodes(name):
            places[name], looks[name] = sites(name)
ON|        if name in ON:
ON|            (x, y), (under_x, under_y) = places[name], places[ON[name]]
ON|            places[name] = scene.of_parent(under_x) + x, scene.of_parent(under_y) + y
APART|    masks = {name: scene.mask(name) for name in CLASSES}
APART|    x, y = (sum(places[name][axis] * masks[name] for name in CLASSES) for axis in (0, 1))
APART|    x, y = ps.separate(x, y, RADIUS, scene.mask(*CLASSES), (HEIGHT, WIDTH))
APART|    places = dict.fromkeys(CLASSES, (x, y))
    layers += [pasted(name, name, places[name], looks[name]) for name in CLASSES]
    return scene.draw(*layers, photo=photo)
'''
