"""What a domain file exports: a ``SceneModel``."""

from collections.abc import Callable
from dataclasses import dataclass

from .drawing import Drawing
from .errors import ModelError
from .grammar import Grammar
from .policy import Policy
from .world import World


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
                f"Expected Groups along 'x' or 'y' with max_groups of at least 1, actual {self.along!r} and "
                f"{self.max_groups}."
            )


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A generative model of one domain.

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

    Raises:
        ModelError: a class that the grammar has no object of, groups of no class or of the only one, stuff that is no
            class or all classes, a canvas or ``max_steps`` that is not positive.
    """

    name: str
    grammar: Grammar
    prior: Policy
    program: Callable[..., Drawing | World]
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

    def __post_init__(self):
        unknown = [c for c in self.classes if c not in self.grammar.kinds]
        if unknown or not self.classes:
            raise ModelError(
                f"Expected the classes of model {self.name!r} among the grammar's objects {list(self.grammar.kinds)}, "
                f"actual {unknown or 'none'}."
            )
        if self.groups is not None and (self.groups.kind not in self.classes or len(self.classes) < 2):
            raise ModelError(
                f"Expected the groups of model {self.name!r} by one of several classes {list(self.classes)}, actual "
                f"{self.groups.kind!r}."
            )
        if not set(self.stuff) < set(self.classes):
            raise ModelError(
                f"Expected the stuff of model {self.name!r} among its classes {list(self.classes)} and not all of "
                f"them, actual {list(self.stuff)}."
            )
        if min(self.canvas) < 1 or self.max_steps < 1:
            raise ModelError(
                f"Expected a positive canvas and max_steps in model {self.name!r}, "
                f"actual canvas {self.canvas} and max_steps {self.max_steps}."
            )
        if self.channels not in (1, 3):
            raise ModelError(f"Expected channels 1 or 3 in model {self.name!r}, actual {self.channels}.")

    @property
    def pretraining_policy(self) -> Policy:
        """What a guide is pretrained on."""
        return self.prior if self.pretraining is None else self.pretraining

    def __call__(self, num_scenes: int, structure: Policy | None = None) -> Drawing | World:
        """Run the program; under the prior where no structure policy is given."""
        return self.program(num_scenes, self.prior if structure is None else structure)
