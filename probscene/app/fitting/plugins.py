"""Parts of a fit that a user brings: features, a divergence, a guide; by object or as ``FILE.py:NAME``.

Each is checked where it is first used, so that what it returns wrongly is named at the first batch and not by a matrix
product an hour later. Axis letters: N scenes, L images, D features, T steps, K rules.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import pyro
import torch
from torch import Tensor

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.errors import ModelError, ProbsceneError
from probscene.grammar import Grammar
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, Features, Fixed
from probscene.inference.guides.base import Guide
from probscene.policy import Policy

from ..modules import file_digest, import_file, module_digests

IN_MEMORY = "object:"  # begins the word that a run records of a part that is no file's

GuideMaker = Callable[[Grammar, int], Guide]
"""Makes an untrained guide of a grammar and T_max."""


@dataclass(frozen=True)
class Plugins:
    """What a user brings as objects; None for what the preset names."""

    features: Features | None = None
    divergence: Divergence | None = None
    guide: GuideMaker | None = None


def in_memory(name: str) -> str:
    """The word of a part that is no file's."""
    return f"{IN_MEMORY}{name}"


def is_file_part(word: str) -> bool:
    """Whether a word has the form ``FILE.py:NAME``."""
    return ".py:" in word


def part_file(word: str) -> Path:
    """The file of a word ``FILE.py:NAME``."""
    return Path(word.rpartition(":")[0])


def lasting_word(word: str) -> str:
    """A word ``FILE.py:NAME`` that means the same from every folder; any other as it is."""
    return f"{part_file(word).resolve()}:{word.rpartition(':')[2]}" if is_file_part(word) else word


def load_part(word: str) -> Any:
    """What ``FILE.py:NAME`` names. A file is executed once, as long as neither it nor what it imports from beside it
    changes.

    Raises:
        ModelError: the file does not import, or has no such name.
    """
    file, name = part_file(word), word.rpartition(":")[2]
    digests = {"": file_digest(file), **module_digests(file)} if file.is_file() else {}
    module = _imported(file.resolve(), tuple(sorted(digests.items())))
    if not hasattr(module, name):
        raise ModelError(f"expected {name!r} in {file}, got none; write FILE.py:NAME with a name that it has.")
    return getattr(module, name)


@cache
def _imported(file: Path, digests: tuple[tuple[str, str], ...]) -> ModuleType:
    return import_file(file)


def as_features(given: Any) -> Features:
    """Features from an object, or from a class that is made without arguments: ``Features``, or a network with
    ``names`` and ``embed``, which is taken as it is.

    Raises:
        ModelError: something else.
    """
    made = _made(given, "features")
    if callable(getattr(made, "build", None)) and isinstance(getattr(made, "name", None), str):
        methods = ("training", "adapt", "divergence", "target_fingerprint", "settings")
        missing = [name for name in methods if not callable(getattr(made, name, None))]
        missing += [name for name in ("resolution", "pretrained", "takes_labels") if not hasattr(made, name)]
        if missing:
            raise ModelError(
                f"expected features with {', '.join(methods)}, got {type(made).__name__} without "
                f"{', '.join(missing)}; subclass probscene.Features, which has them."
            )
        return made
    if is_network(made):
        return Fixed(made)
    raise ModelError(
        f"expected features with a name and build(model), or a network with names and embed(images), got "
        f"{type(made).__name__}; see probscene.Features."
    )


def is_network(given: Any) -> bool:
    """Whether something has ``names``, at least one, and ``embed``."""
    names = getattr(given, "names", None)
    named = isinstance(names, tuple | list) and len(names) > 0 and all(isinstance(name, str) for name in names)
    return named and callable(getattr(given, "embed", None))


def as_divergence(given: Any) -> Divergence:
    """A divergence from an object, a function, or a class that is made without arguments.

    Raises:
        ModelError: it cannot be called.
    """
    made = _made(given, "a divergence")
    if not _takes(made, 2):
        raise ModelError(
            f"expected a divergence, called with features (N, D) and (L, D), got {_called(made)}; see "
            "probscene.Divergence."
        )
    return cast(Divergence, made)


def as_guide_maker(given: Any) -> GuideMaker:
    """What makes guides: a class of guides or a function.

    Raises:
        ModelError: it cannot be called.
    """
    if isinstance(given, Policy) or not _takes(given, 2):
        raise ModelError(
            f"expected a class of guides or a function, called with the grammar and max_steps, got {_called(given)};"
            " every fit makes its own guide."
        )
    return cast(GuideMaker, given)


def _made(given: Any, what: str) -> Any:
    """An object, or one of a class."""
    if not isinstance(given, type):
        return given
    if not _takes(given, 0):
        raise ModelError(
            f"expected {what}, or a class of them that is made without arguments, got {given.__name__}"
            f"{inspect.signature(given)}; give defaults, or name an object."
        )
    return given()


def _takes(given: Any, arguments: int) -> bool:
    """Whether something can be called with so many arguments."""
    if not callable(given):
        return False
    try:
        inspect.signature(given).bind(*range(arguments))
    except TypeError:
        return False
    except ValueError:  # some that are built in have no signature
        return True
    return True


def _called(given: Any) -> str:
    """Something as a message names it."""
    name = getattr(given, "__name__", type(given).__name__)
    return f"{name}{inspect.signature(given)}" if callable(given) else name


class ValidatedNet:
    """A user's feature network, whose first answer is looked at."""

    def __init__(self, net: Any, features: Any):
        if not is_network(net):
            raise ModelError(
                f"expected of {type(features).__name__}.build a network with names, one a feature, and embed(images), "
                f"got {type(net).__name__}; see probscene.FeatureNet."
            )
        self.net: FeatureNet = net
        self.names = tuple(net.names)
        self._checked = False

    def __getattr__(self, name: str) -> Any:
        if name == "net":  # of a copy that is not filled yet
            raise AttributeError(name)
        return getattr(self.net, name)

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)``, see ``FeatureNet``.

        Raises:
            ModelError: something else, or another answer to the same image.
            ProbsceneError: NaN or infinity.
        """
        found = self.net.embed(images)
        where = f"{type(self.net).__name__}.embed"
        _check_tensor(found, (len(images), len(self.names)), where, "features (N, D), one column a name")
        if not self._checked and len(images):
            alone = self.net.embed(images[:1])
            if alone.shape != found[:1].shape or not torch.allclose(alone, found[:1], rtol=1e-4, atol=1e-5):
                raise ModelError(
                    f"expected {where} to give an image the same features alone and in a batch, got others; use no "
                    "statistics of the batch and no random numbers, and call eval()."
                )
            self._checked = True
        return found.float()


def inner(net: FeatureNet) -> FeatureNet:
    """The network itself, without the checks around a user's."""
    return net.net if isinstance(net, ValidatedNet) else net


class ValidatedDivergence:
    """A user's divergence, whose answers are looked at."""

    def __init__(self, divergence: Divergence):
        self.divergence = divergence
        self._checked = False

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor:
        """``(N,)``, see ``Divergence``.

        Raises:
            ModelError: something else, or another answer to the same features.
        """
        cost = self.divergence(generated, real)
        what = getattr(self.divergence, "__name__", None) or f"{type(self.divergence).__name__}.__call__"
        _check_tensor(cost, (len(generated),), what, "one cost a generated scene (N,)")
        if not self._checked:
            if not torch.equal(self.divergence(generated, real), cost):
                raise ModelError(
                    f"expected {what} to give the same costs whenever it is given the same features, got others; "
                    "draw no random numbers in it, and keep nothing from call to call."
                )
            self._checked = True
        return cost.detach().float()


def check_guide(guide: Any, max_steps: int) -> Guide:
    """A user's guide, run once on its own grammar.

    Raises:
        ModelError: it is none, or its logits or log-probabilities are of a wrong shape, type or value, or differ
            between two calls.
    """
    name = type(guide).__name__
    if not isinstance(guide, Guide):
        raise ModelError(f"expected a guide, got {name}; subclass probscene.Guide.")
    if not any(p.requires_grad for p in guide.parameters()):
        raise ModelError(f"expected a guide with parameters to learn, got {name} with none.")
    with torch.no_grad(), pyro.poutine.block():
        # Complete or not: an untrained guide's scenes may well be endless.
        derivation = derive(guide.grammar, _Logits(guide, name), 4, max_steps)
        found = [guide.log_prob(derivation) for _ in range(2)]
    _check_tensor(found[0], (4,), f"{name}.log_prob", "one log-probability a derivation (N,)")
    if not torch.equal(*found):
        raise ModelError(
            f"expected {name}.log_prob to say the same of the same derivations, got two different answers; use no "
            "random numbers in it, such as dropout."
        )
    return guide


class _Logits(Policy):
    """A guide whose steps are looked at."""

    def __init__(self, guide: Guide, name: str):
        self.guide, self.name, self.grammar = guide, name, guide.grammar

    def start(self, num_scenes: int) -> Any:
        return self.guide.start(num_scenes)

    def step(self, memory: Any, frontier: Any, previous_rule: Tensor) -> tuple[Tensor, Any]:
        found = self.guide.step(memory, frontier, previous_rule)
        if not isinstance(found, tuple) or len(found) != 2:
            raise ModelError(f"expected (logits, memory) of {self.name}.step, got {type(found).__name__}.")
        shape = (len(previous_rule), len(self.grammar.rules))
        _check_tensor(found[0], shape, f"{self.name}.step", "logits (N, K), one column a rule")
        return found

    def log_prob(self, derivation: Derivation) -> Tensor:
        return self.guide.log_prob(derivation)


def _check_tensor(found: Any, shape: tuple[int, ...], where: str, what: str) -> None:
    if not isinstance(found, Tensor) or tuple(found.shape) != shape or not found.is_floating_point():
        actual = f"{found.dtype} {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
        raise ModelError(f"expected of {where} {what}: a float tensor {shape}, got {actual}.")
    if not torch.isfinite(found).all():
        raise ProbsceneError(f"expected finite values of {where}, got NaN or infinity; fix it there.")
