"""What a domain file exports: a ``SceneModel``, and ``scene_model``, the short way to one.

Axis letters: N scenes, M nodes.
"""

import functools
import importlib
import inspect
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import pyro

from .batch import Renderer
from .derive import derive
from .errors import ModelError
from .generator import Command, Generator
from .grammar import Grammar
from .policy import Policy
from .request import Renderable
from .scene import SceneGraph
from .structure import StructurePrior, support_of_policies
from .support import Support


@dataclass(frozen=True)
class Groups:
    """Objects are counted separately for each parent of one kind, in order: cars by road, from the top of the image.

    Totals can be right although the count of every single group is wrong. Context that a guide is to learn therefore
    has to be counted by group.

    Args:
        kind: the parent that makes a group, such as ``"road"``.
        along: the axis along which groups are ordered, ``"x"`` (from the left) or ``"y"`` (from the top), by the middle
            of their boxes. The model has to derive them in this order.
        max_groups: how many groups have counts of their own; objects of further groups are counted with the last.

    Raises:
        ModelError: another axis, or fewer than one group.
    """

    kind: str
    along: str = "y"
    max_groups: int = 4

    def __post_init__(self):
        if self.along not in ("x", "y") or self.max_groups < 1:
            raise ModelError(
                f"expected Groups along 'x' or 'y' with max_groups of at least 1, got {self.along!r} and "
                f"{self.max_groups}."
            )


class SceneProgram:
    """The Pyro program ``program(num_scenes, structure)`` around a function of a scene graph: it makes the plate
    ``"scenes"`` (dim -2), derives structures under the policy ``structure`` and hands over their ``SceneGraph``.

    Args:
        draw: samples parameters on the nodes and returns what to draw.
        grammar: the grammar.
        max_steps: T_max.
    """

    def __init__(self, draw: Callable[[SceneGraph], Renderable], grammar: Grammar, max_steps: int):
        functools.update_wrapper(self, draw)
        self.draw, self.grammar, self.max_steps = draw, grammar, max_steps

    def __call__(self, num_scenes: int, structure: Policy) -> Renderable:
        with pyro.plate("scenes", num_scenes, dim=-2):
            return self.draw(SceneGraph(self.grammar, derive(self.grammar, structure, num_scenes, self.max_steps)))

    def __deepcopy__(self, memo: dict) -> "SceneProgram":
        return self

    def __reduce__(self):
        """The function's own name in its module is now the model, where another process finds it."""
        return _found_again, (self.draw.__module__, self.draw.__qualname__, self.grammar, self.max_steps)


def _found_again(module: str, name: str, grammar: Grammar, max_steps: int) -> SceneProgram:
    model = operator.attrgetter(name)(importlib.import_module(module))
    return SceneProgram(model.program.draw, grammar, max_steps)


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A generative model of one domain; ``scene_model`` makes one with less to write.

    Args:
        name: how the command line and the run folder call it.
        grammar: its structures.
        prior: a policy over derivations, the structure prior.
        program: ``program(num_scenes, structure)``, a Pyro program that derives structures under the policy
            ``structure``, samples parameters on the nodes and returns what to draw.
        canvas: height and width of the image, pixels.
        max_steps: T_max; a longer derivation is redrawn.
        classes: the kinds that are labelled and counted, in the order of the categories.
        channels: 1 if colour carries nothing (images are then read as grey), else 3.
        assets: what it draws with beside its own code, in words; a run is bound to it.
        with_assets: ``with_assets(folder)``, the same model drawn with what is in a folder, an absolute path; it looks
            through all of it at once. None where there is nothing that could be replaced.
        groups: counts objects by group; over the whole image if None.
        stuff: the classes whose instances cannot be counted reliably in photographs, such as the trees of a wood or the
            houses of a row. Where counts are read in photographs, stuff is compared only through the overall appearance
            of the image, and all other classes, the things, by their counts.
        pretraining: the policy whose derivations a guide is pretrained on; the prior if None. A guide learns only from
            scenes that it draws itself, so let this policy draw longer lists now and then if the target may have them.
        scenarios: the models that this one is joined of, by name, see ``scenarios.join``.
        target: ``target(seed)``, the synthetic experiment: a model with another structure policy and another layout.
        renderer: ``renderer(canvas, threads)`` makes the ``Renderer`` of what the program returns; ``threads`` is a
            number, or None for one for every core. Sprites and meshes are drawn with the built-in ones where None.
        generator: what draws instead of a renderer where the program returns ``scene.request(...)``: a function
            ``render(scene)``, or a ``Command`` that calls ``serve`` (probscene.worker says what both are given).
        assets_variable: the environment variable that names the folder for ``with_assets`` where no ``--assets`` does;
            it is read when a model is loaded.

    Raises:
        ModelError: no ``Grammar``, classes or stuff that are a string, a class that the grammar has no object of,
            groups of no class or of the only one, stuff that is no class or all classes, a canvas that is not two
            positive whole numbers, a ``max_steps`` that is not one, a renderer or generator that cannot be called, a
            variable of a model without ``with_assets``.
    """

    name: str
    grammar: Grammar
    prior: Policy
    program: Callable[..., Renderable]
    canvas: tuple[int, int]
    max_steps: int
    classes: tuple[str, ...]
    channels: int = 3
    assets: str = ""
    with_assets: Callable[[str], "SceneModel"] | None = None
    groups: Groups | None = None
    stuff: tuple[str, ...] = ()
    pretraining: Policy | None = None
    target: Callable[[int], "SceneModel"] | None = None
    scenarios: tuple[tuple[str, "SceneModel"], ...] = ()
    renderer: Callable[[tuple[int, int], int | None], Renderer] | None = None
    assets_variable: str = ""
    generator: Generator | None = None

    def __post_init__(self):
        if not isinstance(self.grammar, Grammar):
            raise ModelError(
                f"expected a Grammar in model {self.name!r}, got {type(self.grammar).__name__}; make one of the "
                "text: Grammar(text)."
            )
        for what in ("classes", "stuff"):
            value = getattr(self, what)
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise ModelError(
                    f"expected the {what} of model {self.name!r} as a tuple of names, got {value!r}; write "
                    f"{what}=({value if isinstance(value, str) else 'plate'!r},), with the comma."
                )
        unknown = [c for c in self.classes if c not in self.grammar.kinds]
        if unknown or not self.classes:
            raise ModelError(
                f"expected the classes of model {self.name!r} among the grammar's objects {list(self.grammar.kinds)}, "
                f"got {unknown or 'none'}."
            )
        if self.groups is not None and (self.groups.kind not in self.classes or len(self.classes) < 2):
            raise ModelError(
                f"expected the groups of model {self.name!r} by one of several classes {list(self.classes)}, got "
                f"{self.groups.kind!r}."
            )
        if not set(self.stuff) < set(self.classes):
            raise ModelError(
                f"expected the stuff of model {self.name!r} among its classes {list(self.classes)} and not all of "
                f"them, got {list(self.stuff)}."
            )
        if not _is_canvas(self.canvas) or not _is_positive(self.max_steps):
            raise ModelError(
                f"expected a positive canvas and max_steps in model {self.name!r}, "
                f"got canvas {self.canvas} and max_steps {self.max_steps}; write canvas=(height, width), two whole "
                "numbers of pixels without the channels, and max_steps as a whole number of rules."
            )
        if self.channels not in (1, 3):
            raise ModelError(f"expected channels 1 or 3 in model {self.name!r}, got {self.channels}.")
        if self.renderer is not None and not callable(self.renderer):
            raise ModelError(
                f"expected the renderer of model {self.name!r} as a class or function that is called with the canvas "
                f"and a number of threads, got {type(self.renderer).__name__}; give the class, not an instance."
            )
        if self.generator is not None and not isinstance(self.generator, Command) and not callable(self.generator):
            raise ModelError(
                f"expected the generator of model {self.name!r} as a function of a scene or a Command, got "
                f"{type(self.generator).__name__}; write Command([...]) around the words of a command line."
            )
        if self.assets_variable and self.with_assets is None:
            raise ModelError(
                f"expected with_assets in model {self.name!r}, whose assets {self.assets_variable} names, got none."
            )
        if isinstance(self.program, SceneProgram):  # grammar and T_max are the model's, also after dataclasses.replace
            program = SceneProgram(self.program.draw, self.grammar, self.max_steps)
            object.__setattr__(self, "program", program)

    @property
    def pretraining_policy(self) -> Policy:
        """What a guide is pretrained on."""
        return self.prior if self.pretraining is None else self.pretraining

    @functools.cached_property
    def support(self) -> Support | None:
        """What its prior or its policy of pretraining may derive; None where one of them is no ``StructurePrior``."""
        return support_of_policies(self.grammar, (self.prior, self.pretraining_policy))

    def guide_support(self, prior_kinds: Sequence[str] = ()) -> Support | None:
        """What a guide is bound to: ``support``, where nonterminals that derive objects of ``prior_kinds`` alone keep
        the prior's probabilities."""
        if self.support is None or not isinstance(self.prior, StructurePrior):
            return self.support
        return self.support.with_prior(self.prior.table, prior_kinds)

    def __call__(self, num_scenes: int, structure: Policy | None = None) -> Renderable:
        """Run the program; under the prior where no structure policy is given."""
        return self.program(num_scenes, self.prior if structure is None else structure)


def scene_model(
    grammar: Grammar,
    prior: Policy,
    *,
    canvas: tuple[int, int],
    max_steps: int,
    classes: Sequence[str],
    name: str | None = None,
    **fields: Any,
) -> Callable[[Callable[[SceneGraph], Renderable]], SceneModel]:
    """Decorator that makes a ``SceneModel`` of a function of a scene graph.

    The function samples parameters at Pyro sites on the nodes and returns ``scene.draw(...)`` or ``scene.build(...)``;
    it runs inside the plate ``"scenes"`` (dim -2) of N scenes::

        @scene_model(GRAMMAR, PRIOR, canvas=(256, 256), max_steps=40, classes=("plate", "mug"))
        def tabletop(scene):
            with scene.nodes("plate"):
                x = pyro.sample("plate.x", dist.Uniform(50.0, 206.0))  # (N, M) pixels
            ...
            return scene.draw(Sprites.disc("plate", x, 128.0, radius=38.0))

    What comes of it is still a Pyro program, ``tabletop(num_scenes, structure)``, with sites ``rule_t``.

    Args:
        grammar, prior, canvas, max_steps, classes, fields: as of a ``SceneModel``.
        name: of the model, the function's own if None.

    Raises:
        ModelError: no grammar, or a prior of another one; a field that a ``SceneModel`` does not have or that the
            function gives; no function of one argument; see ``SceneModel``.
    """
    if not isinstance(grammar, Grammar):
        raise ModelError(
            f"expected scene_model(grammar, prior, canvas=..., max_steps=..., classes=...) above the function, got "
            f"{type(grammar).__name__} for a grammar; give it a Grammar."
        )
    if not callable(getattr(prior, "step", None)) or getattr(prior, "grammar", grammar).rules != grammar.rules:
        raise ModelError(
            "expected the prior of scene_model to be a policy of the same grammar, such as StructurePrior(grammar), "
            f"got {type(prior).__name__}{' of another grammar' if hasattr(prior, 'grammar') else ''}."
        )
    unknown = sorted(fields.keys() - (SceneModel.__dataclass_fields__.keys() - {"program"}))
    if unknown:
        raise ModelError(f"expected fields of a SceneModel in scene_model(...), got {', '.join(unknown)}.")
    kinds = (classes,) if isinstance(classes, str) else tuple(classes) if isinstance(classes, Iterable) else classes

    def decorated(draw: Callable[[SceneGraph], Renderable]) -> SceneModel:
        called = getattr(draw, "__name__", "") if name is None else name
        if not _takes_one(draw) or not called:
            raise ModelError(
                f"expected scene_model above a function of one argument, the SceneGraph, got {_described(draw)}; "
                "for a program(num_scenes, structure) that derives by itself write SceneModel(...)."
            )
        program = SceneProgram(draw, grammar, max_steps)
        return SceneModel(called, grammar, prior, program, canvas, max_steps, kinds, **fields)

    return decorated


def _is_canvas(canvas: Any) -> bool:
    return isinstance(canvas, Sequence) and len(canvas) == 2 and all(map(_is_positive, canvas))


def _is_positive(number: Any) -> bool:
    return isinstance(number, Integral) and int(number) >= 1


def _takes_one(draw: Any) -> bool:
    if not callable(draw) or isinstance(draw, type | SceneModel):
        return False
    try:
        inspect.signature(draw).bind(None)
    except (TypeError, ValueError):
        return False
    return True


def _described(draw: Any) -> str:
    if inspect.isfunction(draw):
        return f"{draw.__name__}{inspect.signature(draw)}"
    return draw.__name__ if isinstance(draw, type) else type(draw).__name__
