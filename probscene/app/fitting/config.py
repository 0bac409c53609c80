"""Everything that a fit depends on beside the model, the target and the seed.

A ``FitConfig`` is a tree of frozen dataclasses, one of each choice: a setting that a choice does not read is not a
field of it, and so cannot be given. ``FitConfig.set`` changes single values by their path, as ``--set`` does.
"""

import math
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Union, cast, get_args, get_origin, get_type_hints

from probscene.errors import ModelError, ProbsceneError
from probscene.inference.divergence import MMD, Divergence, JensenShannon, KDELogRatio
from probscene.inference.features.base import Features
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.training import CountFeatures
from probscene.inference.features.detections.net import DETECTIONS, DetectionFeatures
from probscene.inference.features.names import PRETRAINED, network_name
from probscene.inference.features.photographs.choices import COUNT_ON_PRETRAINED, PretrainedCountFeatures
from probscene.inference.features.presence import PRESENCE, PRESENCE_COUNTS, PresenceFeatures
from probscene.inference.features.projection import ProjectedFeatures
from probscene.inference.guides.lstm import GUIDES, make_guide
from probscene.inference.objective import BASELINES
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.schedule import ParameterSchedule
from probscene.inference.parameters.tilting.schedule import TiltingSchedule

from .plugins import (
    IN_MEMORY,
    GuideMaker,
    Plugins,
    as_divergence,
    as_features,
    as_guide_maker,
    in_memory,
    is_file_part,
    lasting_word,
    load_part,
)

COUNT = "count"
TRAINED = (COUNT, COUNT_ON_PRETRAINED, PRESENCE, PRESENCE_COUNTS)  # on renders of the prior
STRUCTURE, BOTH = "structure", "structure,parameters"
LIKELIHOOD, TILTING, META_SIM = "likelihood", "tilting", "meta-sim"  # how parameters are learnt
NONE, ANY = "none", "any"  # parameters keep the prior; are learnt as they are configured, else by likelihood
DIVERGENCES = ("kde", "js", "witness", "mmd")


@dataclass(frozen=True)
class LSTMConfig:
    """An ``LSTMGuide``; arguments as of it."""

    hidden: int = 50
    num_latents: int = 1
    index: bool = True

    kind: ClassVar[str] = "lstm"


@dataclass(frozen=True)
class PCFGConfig:
    """A ``PCFG``, one weight a rule."""

    kind: ClassVar[str] = "pcfg"


@dataclass(frozen=True)
class GrammarVAEConfig:
    """A ``GrammarVAE``; arguments as of it."""

    hidden: int = 100
    num_latents: int = 32

    kind: ClassVar[str] = "grammar-vae"


@dataclass(frozen=True)
class Pretrain:
    """Maximum likelihood of a guide on derivations of the prior.

    Args:
        derivations: how many.
        epochs: over them.
        learning_rate: of Adam.
        on_prior: the prior itself, and the guide may take whatever the grammar has, as in the paper; else the policy
            that the model names for it, and the guide stays within its support.
    """

    derivations: int = 5000
    epochs: int = 10
    learning_rate: float = 1e-3
    on_prior: bool = False


@dataclass(frozen=True)
class ScoreFunctionTraining:
    """Training of the guide's structures on a ``ScoreFunction``.

    Args:
        batches: of rendered scenes. With 0 structures stay those that the guide was pretrained on.
        num_scenes: scenes a batch.
        num_real: real images a batch, drawn anew each time (the paper); all of them where None.
        draws_per_structure: drawings of each structure, of which the clearest is looked at.
        render_cache: renders of scenes of equal counts before one of them, at random, is taken again instead of a new
            one, for renderers that are slow; every scene is rendered where 0. See ``RenderCache``.
        updates, baseline, scale, incompletion_weight, prior_kl_weight: see ``ScoreFunction``, whose prior is the policy
            that guides are pretrained on.
        learning_rate: of Adam, the first; it falls to 0 along a cosine, or stays where ``cosine`` is False (the paper).
    """

    batches: int = 60
    num_scenes: int = 500
    num_real: int | None = None
    draws_per_structure: int = 4
    render_cache: int = 0
    updates: int = 3
    learning_rate: float = 1e-2
    cosine: bool = True
    baseline: str = "leave_one_out"
    scale: float = 1.0
    incompletion_weight: float = 1.0
    prior_kl_weight: float = 0.0


@dataclass(frozen=True)
class Refinement:
    """A second, shorter training of structures, whose scenes have the learnt parameters, with the settings of the
    first.

    Args:
        batches: none where 0.
    """

    batches: int = 40


@dataclass(frozen=True)
class Auto:
    """``CountFeatures`` where the target looks like renders; else, or with labels, ``PretrainedCountFeatures``, with
    the settings that suit them (``Features.settings``).

    Args:
        renders: the former.
    """

    renders: CountFeatures = field(default_factory=CountFeatures)


GuideConfig = LSTMConfig | PCFGConfig | GrammarVAEConfig
Parameters = ParameterSchedule | TiltingSchedule | MetaSimSchedule
METHODS: dict[str, type] = {LIKELIHOOD: ParameterSchedule, TILTING: TiltingSchedule, META_SIM: MetaSimSchedule}
_GUIDES = {made.kind: made for made in (LSTMConfig, PCFGConfig, GrammarVAEConfig)}
_CHOICES: dict[str, tuple[type, ...]] = {
    "features": (Auto, CountFeatures, PretrainedCountFeatures, PresenceFeatures, ProjectedFeatures, DetectionFeatures),
    "divergence": (KDELogRatio, JensenShannon, MMD),
    "guide": tuple(_GUIDES.values()),
    "parameters": tuple(METHODS.values()),
}
_KINDS = {made.__name__: made for choices in _CHOICES.values() for made in choices}
KIND = "kind"  # names a choice's class in records

# Ranges of settings by name: the least whole number where it is not 1, and numbers that must be above 0.
_LEAST_WHOLE = {
    "num_scenes": 2, "scenes": 2, "batches": 0, "rounds": 0, "directions": 0,
    "render_cache": 0,
}  # fmt: skip
_ABOVE_ZERO = ("learning_rate", "variance", "marginal_variance", "scale", "difference")
_WORDS = {"baseline": BASELINES}


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How a fit learns; recorded with the run.

    Args:
        features: what images and renders are compared by; ``"FILE.py:NAME"`` or an object for one's own.
        divergence: what is descended, of features of generated scenes from those of the target; likewise.
        guide: what learns structures; likewise, or what makes one from a grammar and T_max.
        pretrain: of the guide on the prior.
        structure: of the guide on the target.
        parameters: how the distributions of the program's sites are learnt; None where they keep the prior.
        refine: of structures once more, where parameters are learnt; None where they are not.
        num_crops: of each real image in the density of their features, the image itself and parts of it
            (``Images.load``). Among few images they take some noise out of the density.
        fallback_to_prior: keep the prior where what was learnt is farther from the target, beyond chance.

    Raises:
        ProbsceneError: a value out of its range, or a combination that learns nothing.
    """

    features: Features | Auto | str = field(default_factory=Auto)
    divergence: Divergence | str = field(default_factory=KDELogRatio)
    guide: GuideConfig | GuideMaker | str = field(default_factory=LSTMConfig)
    pretrain: Pretrain = field(default_factory=Pretrain)
    structure: ScoreFunctionTraining = field(default_factory=ScoreFunctionTraining)
    parameters: Parameters | None = field(default_factory=ParameterSchedule)
    refine: Refinement | None = field(default_factory=Refinement)
    num_crops: int = 1
    fallback_to_prior: bool = True
    _set: tuple[tuple[str, str], ...] = field(
        default=(), repr=False, compare=False
    )  # by ``set``, applied again by ``Auto``

    def __post_init__(self) -> None:
        for path, value in _values(self):
            _check_range(path, value)
        if self.parameters is None:
            object.__setattr__(self, "refine", None)
        if isinstance(self.features, ProjectedFeatures | PretrainedCountFeatures):  # whose unit is chosen for batches
            object.__setattr__(self, "features", replace(self.features, scenes=self.structure.num_scenes))
        if isinstance(self.divergence, MMD) and self.divergence.shared and self.structure.baseline == "leave_one_out":
            raise ProbsceneError(
                "expected the baseline moving_average or none with a shared MMD, got leave_one_out: all scenes have "
                "one cost, so that their advantages would all be 0; set structure.baseline."
            )
        if self.structure.batches == 0 and self.parameters is None:
            raise ProbsceneError(
                "expected structure.batches of at least 1 where structure alone is learnt, got 0; learn parameters, "
                f"too, with --learn {BOTH}, or leave it out."
            )

    def set(self, *settings: str | Mapping[str, Any]) -> "FitConfig":
        """This configuration with other values, such as ``"structure.batches=2"`` or ``{"structure.batches": 2}``.

        ``none`` stands for no value, ``true`` and ``false`` for themselves. The names of ``features``, ``divergence``,
        ``guide`` and ``parameters`` are those of the command line; they come first, with all that suits them.

        Raises:
            ProbsceneError: no ``=``, an unknown path, or a value of another type or out of range.
        """
        pairs = list(_pairs(settings))
        changed = self
        for key, text in sorted(pairs, key=lambda pair: pair[0] not in _CHOICES):
            if key in _CHOICES:
                changed = getattr(changed, f"with_{key}")(lasting_word(text))
            elif isinstance(changed.features, Auto) and key.startswith("features."):
                changed._check_auto(key, text)
            else:
                changed = _replaced(changed, key.split("."), text, key)
        return replace(changed, _set=(*self._set, *pairs))

    def _check_auto(self, key: str, text: str) -> None:
        """See that a setting of features that are not chosen yet is one of those that may be."""
        faults = []
        for features in (self._auto.renders, PretrainedCountFeatures()):
            try:
                _replaced(replace(self, features=features), key.split("."), text, key)
                return
            except ProbsceneError as error:
                faults.append(error)
        raise faults[0]

    @property
    def _auto(self) -> Auto:
        assert isinstance(self.features, Auto)
        return self.features

    def for_renders(self) -> "FitConfig":
        """Of a target that looks like renders; itself where features are chosen."""
        if not isinstance(self.features, Auto):
            return self
        return replace(self, features=self._auto.renders)._set_again()

    def for_photographs(self) -> "FitConfig":
        """Of a target of photographs; itself where features are chosen."""
        if not isinstance(self.features, Auto):
            return self
        return self.with_features(COUNT_ON_PRETRAINED)._set_again()

    def _set_again(self) -> "FitConfig":
        """With the values that ``set`` was given since, as far as the features have them."""
        changed = self
        for key, text in self._set:
            if key not in _CHOICES and _has(changed, key.split(".")):
                changed = _replaced(changed, key.split("."), text, key)
        return changed

    def with_features(self, choice: str | Features, suited: bool = True) -> "FitConfig":
        """With other features.

        Args:
            choice: a word of the command line, or features.
            suited: with the settings that suit them, see ``Features.settings``.

        Raises:
            ProbsceneError: an unknown word, or no file named.
            ModelError: their settings are none of a configuration's.
        """
        made = _features(choice, self) if isinstance(choice, str) else as_features(choice)
        changed = replace(self, features=choice if isinstance(choice, str) and is_file_part(choice) else made)
        if not suited or isinstance(made, Auto):
            return changed
        settings = made.settings(self)
        if not isinstance(settings, dict):
            raise ModelError(
                f"expected of {type(made).__name__}.settings a dict of paths such as 'structure.batches', got "
                f"{type(settings).__name__}."
            )
        for key, value in settings.items():
            if key == "parameters":
                chosen = any(name == key for name, _ in self._set)
                changed = changed if chosen or self.parameters is None else changed.with_parameters(value)
            elif key.startswith("divergence.") and not _has(changed, key.split(".")):
                continue  # of a kernel that the divergence does not have
            else:
                if not _has(changed, key.split(".")):
                    raise ModelError(
                        f"expected paths of a configuration from {type(made).__name__}.settings, such as "
                        f"'structure.batches', got {key!r}."
                    )
                changed = _with(changed, key.split("."), value)
        return changed

    def with_divergence(self, choice: str | Divergence) -> "FitConfig":
        """With another divergence, and the kernel's settings of before.

        All that give each scene a cost of its own learn with the same steps. A shared MMD is one cost for all scenes:
        the others' mean as a baseline would cancel it, and several clipped steps away from everything that was drawn
        move the guide to what was not, derivations that do not end.

        Raises:
            ProbsceneError: an unknown word.
        """
        if not isinstance(choice, str) or is_file_part(choice):
            return replace(self, divergence=choice)
        if choice not in DIVERGENCES:
            raise ProbsceneError(
                f"expected a divergence among {', '.join(DIVERGENCES)}, or FILE.py:NAME, got {choice!r}."
            )
        made = {"kde": KDELogRatio, "js": JensenShannon}.get(choice, MMD)
        before = self.divergence if is_dataclass(self.divergence) else made()
        kept = {name.name: getattr(before, name.name) for name in fields(made) if hasattr(before, name.name)}
        if made is MMD:
            kept["shared"] = choice == "mmd"
        structure = self.structure
        if choice == "mmd" and not (isinstance(self.divergence, MMD) and self.divergence.shared):
            rate = min(structure.learning_rate, 1e-3)
            structure = replace(structure, baseline="moving_average", updates=1, learning_rate=rate)
        return replace(self, divergence=made(**kept), structure=structure)

    def with_guide(self, choice: str | GuideConfig | GuideMaker) -> "FitConfig":
        """With another guide, and a rate of pretraining that suits it: a PCFG's weights, one a rule, are many small
        steps of Adam away from any prior; the Grammar VAE's context is in its latent vectors alone, of which it takes
        many.

        Raises:
            ProbsceneError: an unknown word.
        """
        if not isinstance(choice, str) or is_file_part(choice):
            return replace(self, guide=choice)
        if choice not in GUIDES:
            raise ProbsceneError(f"expected a guide among {', '.join(GUIDES)}, or FILE.py:NAME, got {choice!r}.")
        rate = {"pcfg": 3e-2, "grammar-vae": 5e-3}.get(choice, self.pretrain.learning_rate)
        guide = self.guide if getattr(self.guide, KIND, "") == choice else _GUIDES[choice]()
        return replace(self, guide=guide, pretrain=replace(self.pretrain, learning_rate=rate))

    def with_parameters(self, method: str) -> "FitConfig":
        """With parameters learnt by a method, ``"likelihood"``, ``"tilting"`` or ``"meta-sim"``; or ``"none"``.

        Raises:
            ProbsceneError: another word.
        """
        if method == NONE:
            return replace(self, parameters=None)
        if method == ANY:
            return self if self.parameters is not None else self.with_parameters(LIKELIHOOD)
        if method not in METHODS:
            raise ProbsceneError(f"expected parameters to be learnt by {', '.join(METHODS)} or {NONE}, got {method!r}.")
        kept = isinstance(self.parameters, METHODS[method])
        refine = self.refine or Refinement()
        return self if kept else replace(self, parameters=METHODS[method](), refine=refine)

    @property
    def parameter_method(self) -> str | None:
        """The word for how parameters are learnt; None where they are not."""
        return next((word for word, made in METHODS.items() if isinstance(self.parameters, made)), None)

    def plugins(self) -> Plugins:
        """The user's own parts, checked. None for the library's, and for what was
        in memory alone.

        Raises:
            ModelError: one that is no such part, or see ``load_part``.
        """
        own: dict[str, Any] = {}
        for name, check in (("features", as_features), ("divergence", as_divergence), ("guide", as_guide_maker)):
            part = getattr(self, name)
            if isinstance(part, str):
                part = load_part(part) if is_file_part(part) else None
            elif isinstance(part, _CHOICES[name]):
                part = None
            own[name] = None if part is None else check(part)
        return Plugins(**own)

    def words(self) -> dict[str, str]:
        """The words ``FILE.py:NAME`` and ``object:NAME`` of features, divergence and guide that are the user's own."""
        words = {}
        for name in ("features", "divergence", "guide"):
            part = getattr(self, name)
            if isinstance(part, str):
                words[name] = lasting_word(part)
            elif not isinstance(part, _CHOICES[name]):
                words[name] = in_memory(_name(part, name))
        return words

    def guide_record(self) -> dict[str, Any]:
        """For tables and JSON: the guide's word, as ``kind``, and its settings."""
        if not isinstance(self.guide, GuideConfig):
            return {KIND: self.words()["guide"]}
        return {KIND: self.guide.kind} | {name: getattr(self.guide, name) for name in _names(self.guide)}

    @property
    def divergence_name(self) -> str:
        """In tables."""
        if isinstance(self.divergence, MMD):
            return "mmd" if self.divergence.shared else "witness"
        known = {KDELogRatio: "kde", JensenShannon: "js"}
        return known.get(type(self.divergence)) or self.words()["divergence"]

    def make_features(self) -> Features:
        """The chosen features.

        Raises:
            ModelError: see ``load_part``.
        """
        if isinstance(self.features, str):
            return as_features(load_part(self.features))
        return self.features.renders if isinstance(self.features, Auto) else as_features(self.features)

    def make_divergence(self) -> Divergence:
        """The chosen divergence.

        Raises:
            ModelError: see ``load_part``.
        """
        return as_divergence(load_part(self.divergence) if isinstance(self.divergence, str) else self.divergence)

    def guide_maker(self) -> GuideMaker:
        """What makes an untrained guide of a grammar and T_max.

        Raises:
            ModelError: see ``load_part``.
        """
        if isinstance(self.guide, GuideConfig):
            settings = self.guide_record()
            return lambda grammar, max_steps: make_guide(grammar=grammar, max_steps=max_steps, **settings)
        return as_guide_maker(load_part(self.guide) if isinstance(self.guide, str) else self.guide)

    @property
    def images(self) -> int:
        """About how many images a fit has drawn, at most: for its features, its batches and its parameters."""
        training = self.structure
        images = self.make_features().images + training.batches * training.num_scenes * training.draws_per_structure
        images += 0 if self.refine is None else self.refine.batches * training.num_scenes
        return images + (0 if self.parameters is None else self.parameters.drawn)

    def to_record(self) -> dict[str, Any]:
        """For JSON, which ``from_record`` reads."""
        return _record(replace(self, **self.words()))

    @staticmethod
    def from_record(record: dict[str, Any]) -> "FitConfig":
        """From ``to_record``."""
        return _from_record(FitConfig, record)

    def flat(self) -> dict[str, Any]:
        """Every value of ``to_record`` by its path."""
        return dict(_flat(self.to_record()))


def configuration(
    preset: FitConfig,
    features: str | Features | None = None,
    divergence: str | Divergence | None = None,
    guide: str | GuideMaker | None = None,
    parameters: str | None = None,
    settings: Iterable[str] | Mapping[str, Any] = (),
) -> FitConfig:
    """A preset with what was chosen beside it, as by the options of ``probscene fit``.

    Raises:
        ProbsceneError: see ``FitConfig.set``.
    """
    changed = preset
    for name, choice in (
        ("parameters", parameters),
        ("divergence", divergence),
        ("guide", guide),
        ("features", features),
    ):
        if choice is None:
            continue
        choice = lasting_word(choice) if isinstance(choice, str) else choice
        changed = getattr(changed, f"with_{name}")(choice)
        if name == "parameters":
            changed = replace(changed, _set=(*changed._set, (name, str(choice))))
    return changed.set(*([settings] if isinstance(settings, Mapping) else settings))


def parameter_choice(learn: str | None, method: str | None) -> str | None:
    """The word of ``FitConfig.with_parameters`` for the options ``--learn`` and ``--parameters``; who says how
    parameters are learnt means that they are.

    Raises:
        ProbsceneError: another word; only structure is to be learnt, and yet it is said how parameters are.
    """
    if learn not in (None, STRUCTURE, BOTH):
        raise ProbsceneError(f"expected --learn among {STRUCTURE} and {BOTH}, got {learn!r}.")
    if learn == STRUCTURE and method is not None:
        raise ProbsceneError(
            f"expected --learn {BOTH} where --parameters {method} says how, got {STRUCTURE}; leave one out."
        )
    return NONE if learn == STRUCTURE else method or (None if learn is None else ANY)


def _features(word: str, config: FitConfig) -> Features | Auto:
    """What a word of the command line names; settings of before are kept where it names the same."""
    if is_file_part(word):
        return as_features(load_part(word))
    if word == COUNT:
        if isinstance(config.features, Auto):
            return config.features.renders
        return config.features if isinstance(config.features, CountFeatures) else CountFeatures()
    if word == COUNT_ON_PRETRAINED:
        return PretrainedCountFeatures()
    if word == DETECTIONS:
        return DetectionFeatures()
    if word in (PRESENCE, PRESENCE_COUNTS):
        before = config.features if isinstance(config.features, PresenceFeatures) else PresenceFeatures()
        return replace(before, counts=word == PRESENCE_COUNTS)
    network_name(word, TRAINED)
    before = config.features if isinstance(config.features, ProjectedFeatures) else ProjectedFeatures()
    return replace(before, network=word)


def takers_of_labels() -> list[str]:
    """The words for features that can make use of labels."""
    config = FitConfig()
    return [word for word in (*TRAINED, *PRETRAINED) if getattr(_features(word, config), "takes_labels", False)]


def _name(part: Any, kind: str) -> str:
    if kind == "features":
        return as_features(part).name
    return getattr(part, "__name__", type(part).__name__)


def _pairs(settings: Iterable[str | Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    for setting in settings:
        if isinstance(setting, Mapping):
            yield from ((str(key), _text(value)) for key, value in setting.items())
            continue
        key, equals, text = setting.partition("=")
        if not equals:
            raise ProbsceneError(f"expected a setting key=value, got {setting!r}.")
        yield key.strip(), text.strip()


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def _has(value: Any, path: list[str]) -> bool:
    name, *rest = path
    if not is_dataclass(value) or name not in _names(value):
        return False
    return not rest or _has(getattr(value, name), rest)


def _names(value: Any) -> list[str]:
    """Of the settings of a dataclass."""
    derived = ("scenes",) if isinstance(value, ProjectedFeatures | PretrainedCountFeatures) else ()
    return [one.name for one in fields(value) if not one.name.startswith("_") and one.name not in derived]


def _with(value: Any, path: list[str], new: Any) -> Any:
    """A copy of a tree of dataclasses with another value at a path.

    Raises:
        ProbsceneError: there is no such path.
    """
    name, *rest = path
    if isinstance(value, type) or not is_dataclass(value) or name not in _names(value):
        known = ", ".join(_names(value)) if is_dataclass(value) else "none"
        raise ProbsceneError(f"expected settings among {known}, got {name!r}.")
    return replace(cast(Any, value), **{name: _with(getattr(value, name), rest, new) if rest else new})


def _replaced(value: Any, path: list[str], text: str, key: str) -> Any:
    """``_with`` a value that is read from text."""
    name, *rest = path
    if name not in _names(value):
        raise ProbsceneError(_unknown(value, key))
    inner = getattr(value, name)
    if rest and not is_dataclass(inner):
        raise ProbsceneError(
            f"expected no setting of {key.removesuffix('.' + '.'.join(rest))} = {_shown(inner)}, which has none, got "
            f"{key!r}; leave it out."
        )
    if is_dataclass(inner):
        if not rest:
            raise ProbsceneError(f"expected a path such as {key}.{(_names(inner) or ['...'])[0]}, got {key!r} alone.")
        return replace(value, **{name: _replaced(inner, rest, text, key)})
    new = _read(text, get_type_hints(type(value))[name], key)
    _check_range(key, new)
    return replace(value, **{name: new})


def _unknown(value: Any, key: str) -> str:
    where, _, _ = key.rpartition(".")
    of = f" of {where} ({type(value).__name__})" if where else ""
    known = ", ".join(_names(value)) or "none"
    return f"expected a setting{of} among {known}, got {key!r}."


def _shown(value: Any) -> str:
    return NONE if value is None else str(value) if isinstance(value, str | int | float) else type(value).__name__


def _read(text: str, wanted: Any, key: str) -> Any:
    if isinstance(wanted, types.UnionType) or get_origin(wanted) is Union:
        if text.lower() == NONE:
            return None
        (wanted,) = (kind for kind in get_args(wanted) if kind is not types.NoneType)
    try:
        if get_origin(wanted) is tuple:
            parts = [part.strip() for part in text.strip("()").split(",")]
            return tuple(kind(part) for kind, part in zip(get_args(wanted), parts, strict=True))
        if wanted is bool:
            return {"true": True, "false": False}[text.lower()]
        return wanted(text)
    except (KeyError, ValueError):
        kind = wanted.__name__ if isinstance(wanted, type) else str(wanted)
        raise ProbsceneError(f"expected {key}=<{kind}>, got {text!r}.") from None


def _tuples(value: Any) -> Any:
    """What JSON has as a list."""
    return tuple(value) if isinstance(value, list) else value


def _optional(wanted: Any) -> Any:
    """A type without the None that it may be."""
    kinds = [kind for kind in get_args(wanted) if kind is not types.NoneType]
    return kinds[0] if isinstance(wanted, types.UnionType) and len(kinds) == 1 else wanted


def _values(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every number and word of a tree of dataclasses by its path."""
    for name in _names(value):
        inner, at = getattr(value, name), f"{path}.{name}".lstrip(".")
        if is_dataclass(inner) and not isinstance(inner, type):
            yield from _values(inner, at)
        else:
            yield at, inner


def _check_range(path: str, value: Any) -> None:
    name = path.rpartition(".")[2]
    if isinstance(value, str) and name in _WORDS and value not in _WORDS[name]:
        raise ProbsceneError(f"expected {path} among {', '.join(_WORDS[name])}, got {value!r}.")
    least = _LEAST_WHOLE.get(name, 1)
    if type(value) is int and value < least:
        raise ProbsceneError(f"expected {path} of at least {least}, got {value}.")
    above = name in _ABOVE_ZERO
    if type(value) is float and not (math.isfinite(value) and (value > 0 or (value == 0 and not above))):
        raise ProbsceneError(f"expected {path} {'above 0' if above else 'of at least 0'}, got {value}.")


def _record(value: Any) -> Any:
    if not is_dataclass(value) or isinstance(value, type):
        return list(value) if isinstance(value, tuple) else value
    record = {name: _record(getattr(value, name)) for name in _names(value)}
    return {KIND: type(value).__name__, **record} if type(value).__name__ in _KINDS else record


_FORMER_SETTINGS = {
    (ParameterSchedule, name) for name in ("energy_steps", "energy_scenes", "weighted_scenes", "energy_rate", "sure")
}  # of runs of format 4 from before there was one estimator


def _from_record(made: type, record: dict[str, Any]) -> Any:
    hints = get_type_hints(made)
    values = {}
    for name, value in record.items():
        if name == KIND or (made, name) in _FORMER_SETTINGS:
            continue
        if isinstance(value, dict):
            of = _KINDS[value[KIND]] if KIND in value else _optional(hints[name])
            value = _from_record(of, value)
        values[name] = _tuples(value)
    return made(**values)


def _flat(record: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(record, dict):
        yield path, record
        return
    for name, value in record.items():
        yield from _flat(value, f"{path}.{name}".lstrip("."))


_FORMER_NAMES = {
    "candidates": "draws_per_structure",
    "leak": "incompletion_weight",
    "anchor": "prior_kl_weight",
    "kept": "ess_fraction",
}


def _renamed(record: dict[str, Any]) -> dict[str, Any]:
    return {_FORMER_NAMES.get(key, key): _tuples(value) for key, value in record.items()}


def from_flat_preset(record: dict[str, Any], guide: dict[str, Any]) -> FitConfig:
    """The configuration of a run of format 3, or of version 0.1.

    Args:
        record: its ``preset``.
        guide: its ``guide``.
    """
    old = _renamed(record)

    def some(made: type, **names: str) -> dict[str, Any]:
        """Arguments of a class: those of its fields that the record has, under their names of then."""
        known = {one.name: names.get(one.name, one.name) for one in fields(made)}
        return {name: old[then] for name, then in known.items() if then in old}

    kernel = some(KDELogRatio, anscombe="stabilised")
    word = old.get("objective", "kde")
    divergence: Any = word
    if word in ("mmd", "witness"):
        divergence = MMD(
            shared=word == "mmd", **{name: kernel[name] for name in ("variance", "anscombe") if name in kernel}
        )
    elif word in DIVERGENCES:
        divergence = (JensenShannon if word == "js" else KDELogRatio)(**kernel)
    kind = guide.get("kind", "lstm")
    settings = {name: value for name, value in guide.items() if name != "kind"}
    schedules = {LIKELIHOOD: "parameters", TILTING: "tilting", META_SIM: "meta_sim"}
    method = old.get("parameter_method", LIKELIHOOD)
    parameters = None
    if old.get("learn", STRUCTURE) == BOTH:
        settings_then = _renamed(old.get(schedules[method], {}))
        known = {one.name for one in fields(METHODS[method])}
        parameters = METHODS[method](**{name: value for name, value in settings_then.items() if name in known})
    return FitConfig(
        features=_former_features(old, some),
        divergence=divergence,
        guide=_GUIDES[kind](**settings) if kind in _GUIDES else kind,
        pretrain=Pretrain(
            **some(
                Pretrain, derivations="pretrain_derivations", epochs="pretrain_epochs", learning_rate="pretrain_rate"
            )
        ),
        structure=ScoreFunctionTraining(**some(ScoreFunctionTraining, render_cache="reuse")),
        parameters=parameters,
        refine=Refinement(old.get("batches_again", 40)),
        num_crops=old.get("views", 1),
        fallback_to_prior=old.get("prior_if_worse", True),
    )


def _former_features(old: dict[str, Any], some: Callable[..., dict[str, Any]]) -> Features | str:
    word = old.get("features", COUNT)
    if is_file_part(word) or word.startswith(IN_MEMORY):
        return word
    if word == COUNT:
        return CountFeatures(CountSchedule(**old.get("count", {})), **some(CountFeatures, schedule=""))
    if word == COUNT_ON_PRETRAINED:
        return PretrainedCountFeatures(**some(PretrainedCountFeatures, epochs="head_epochs", scenes=""))
    if word in (PRESENCE, PRESENCE_COUNTS):
        names = {name: f"presence_{name}" for name in ("images", "epochs", "width", "hidden")}
        return PresenceFeatures(**some(PresenceFeatures, **names, counts=""), counts=word == PRESENCE_COUNTS)
    return ProjectedFeatures(word, **some(ProjectedFeatures, network="", scenes=""))
