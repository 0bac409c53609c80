"""How long and how to learn: everything that a fit depends on beside the model, the target and the seed."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

from probscene.errors import ModelError, ProbsceneError
from probscene.inference.divergence import MMD, Divergence, JensenShannon, KDELogRatio
from probscene.inference.features.base import Features
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.training import CountFeatures
from probscene.inference.features.names import network_name
from probscene.inference.features.photographs.choices import COUNT_ON_PRETRAINED, PretrainedCountFeatures
from probscene.inference.features.presence import PRESENCE, PRESENCE_COUNTS, PresenceFeatures
from probscene.inference.features.projection import ProjectedFeatures
from probscene.inference.guides.lstm import GUIDES
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.schedule import ParameterSchedule
from probscene.inference.parameters.tilting.schedule import TiltingSchedule

from .plugins import IN_MEMORY, ValidatedDivergence, as_divergence, as_features, is_file_part, load_part

FOR_RENDERS, FOR_PHOTOGRAPHS = "count", COUNT_ON_PRETRAINED
TRAINED = (FOR_RENDERS, FOR_PHOTOGRAPHS, PRESENCE, PRESENCE_COUNTS)  # on the prior's renders
_RENAMED = {"candidates": "draws_per_structure", "leak": "incompletion_weight", "anchor": "prior_kl_weight"}
STRUCTURE, BOTH = "structure", "structure,parameters"
LIKELIHOOD, TILTING, META_SIM = "likelihood", "tilting", "meta-sim"  # by which parameters are learnt
_SCHEDULES = {LIKELIHOOD: "parameters", TILTING: "tilting", META_SIM: "meta_sim"}
_OF_PRESENCE = ("presence_images", "presence_epochs", "presence_width", "presence_hidden")
OBJECTIVES = ("kde", "js", "witness", "mmd")
_FEATURE_SETTINGS = {
    FOR_RENDERS: ("count", "width", "blocks"),
    FOR_PHOTOGRAPHS: ("pairs", "head_epochs", "photographs"),
    PRESENCE: _OF_PRESENCE,
    PRESENCE_COUNTS: _OF_PRESENCE,
}


@dataclass(frozen=True)
class Preset:
    """A fit's configuration; it is recorded with the run.

    Args:
        features: ``"count"`` for the count network, ``"count=efficientnet"`` for counts read from a pretrained one's
            maps, ``"presence"`` for the paper's network, ``"presence=counts"`` for that of its Aerial 2D; one of
            ``names.CHOICES`` for a pretrained one, projected; ``FILE.py:NAME`` for one's own.
        count: the count network's schedule.
        width, blocks: the count network's size.
        presence_images, presence_epochs: the paper's network's training set and its longest training.
        presence_width, presence_hidden: its size, which the paper leaves open, see ``PresenceNet``.
        pairs: structures that are drawn twice, for a pretrained network's projection or for the heads that count on its
            maps.
        directions: features of a projection; 0 for a pretrained network's own, as they are.
        head_epochs: training of those heads.
        photographs: images of the target, at most, by which it is chosen how those heads are read.
        views: of each real image in the density of their features, the image itself and parts of it
            (``Images.load``). Among few images they take some noise out of the density.
        guide: ``"lstm"``, ``"pcfg"`` or ``"grammar-vae"``, see ``make_guide``; ``FILE.py:NAME`` for one's own.
        objective: ``"kde"``, the log density ratio; ``"js"``, bounded, of the same densities; ``"witness"``, MMD with a
            value for each scene; ``"mmd"``, MMD as a reward that all scenes share; ``FILE.py:NAME`` for one's own.
        variance, marginal_variance, leave_one_out, equal_sizes, stabilised: see ``KDELogRatio``; the first and the last
            also of ``MMD``.
        pretrain_derivations, pretrain_epochs, pretrain_rate: maximum likelihood on the prior.
        on_prior: guides are pretrained on the prior itself and may take whatever the grammar has, as in the paper; else
            on the policy that the model names for it, within its support.
        batches, num_scenes, num_real, updates, learning_rate, cosine: see ``StructureTraining`` and ``ScoreFunction``.
            With 0 batches structures stay those that guides are pretrained on, and parameters alone are learnt.
        draws_per_structure: drawings of each structure, of which the clearest is looked at.
        reuse: renders of scenes of equal counts before one of them, at random, is taken again instead of a new one,
            for renderers that are slow; every scene is rendered where 0. See ``RenderCache``.
        baseline, scale, incompletion_weight, prior_kl_weight: see ``ScoreFunction``, whose prior is the policy
            that guides are pretrained on.
        hidden, num_latents, index: see ``LSTMGuide``; the first two also of ``GrammarVAE``.
        prior_if_worse: keep the prior where what was learnt is farther from the target, beyond chance.
        learn: ``"structure"``, or ``"structure,parameters"``, where things stand and how they look as well.
        parameter_method: of the latter: ``"likelihood"`` of what is read in the target; ``"tilting"``, by how images
            look as wholes, for photographs; or ``"meta-sim"``, a baseline.
        parameters, tilting, meta_sim: their schedules.
        batches_again: of structure's second pass, whose scenes have learnt parameters; none where 0.
    """

    features: str = "count"
    count: CountSchedule = field(default_factory=CountSchedule)
    width: tuple[int, int, int] = (16, 32, 64)
    blocks: tuple[int, int] = (1, 1)
    presence_images: int = 5000
    presence_epochs: int = 10
    presence_width: int = 8
    presence_hidden: int = 64
    pairs: int = 500
    directions: int = 8
    head_epochs: int = 8
    photographs: int = 500
    views: int = 1
    guide: str = "lstm"
    objective: str = "kde"
    variance: float | None = 1.0
    marginal_variance: float | None = 0.1
    leave_one_out: bool = True
    equal_sizes: bool = False
    stabilised: bool = False
    pretrain_derivations: int = 5000
    pretrain_epochs: int = 10
    pretrain_rate: float = 1e-3
    on_prior: bool = False
    batches: int = 60
    num_scenes: int = 500
    num_real: int | None = None
    draws_per_structure: int = 4
    reuse: int = 0
    updates: int = 3
    learning_rate: float = 1e-2
    cosine: bool = True
    baseline: str = "leave_one_out"
    scale: float = 1.0
    incompletion_weight: float = 1.0
    prior_kl_weight: float = 0.0
    hidden: int = 50
    num_latents: int = 1
    index: bool = True
    prior_if_worse: bool = True
    learn: str = STRUCTURE
    parameter_method: str = LIKELIHOOD
    parameters: ParameterSchedule = field(default_factory=ParameterSchedule)
    tilting: TiltingSchedule = field(default_factory=TiltingSchedule)
    meta_sim: MetaSimSchedule = field(default_factory=MetaSimSchedule)
    batches_again: int = 40

    @staticmethod
    def of(record: dict[str, Any]) -> "Preset":
        """From ``dataclasses.asdict``, as a run's JSON keeps it, under the names of today or of version 0.1."""
        record = {_RENAMED.get(key, key): value for key, value in record.items()}
        whole = {key: tuple(value) if isinstance(value, list) else value for key, value in record.items()}
        nested: dict[str, Any] = {"count": CountSchedule(**record["count"])}
        schedules = {"parameters": ParameterSchedule, "tilting": TiltingSchedule, "meta_sim": MetaSimSchedule}
        nested |= {name: made(**record[name]) for name, made in schedules.items() if name in record}
        return Preset(**{**whole, **nested})

    def with_objective(self, objective: str) -> "Preset":
        """This preset with another objective.

        All that give each scene a cost of its own learn with this preset's steps. Shared MMD is one score for all
        scenes: the others' mean as a baseline would cancel it, and several clipped steps away from everything that was
        drawn move the guide to what was not, derivations that do not end.

        Raises:
            ProbsceneError: an unknown objective.
        """
        if objective not in OBJECTIVES and not is_file_part(objective):
            raise ProbsceneError(
                f"expected an objective among {', '.join(OBJECTIVES)}, or FILE.py:NAME, got {objective!r}."
            )
        if objective == self.objective or objective != "mmd":
            return replace(self, objective=objective)
        rate = min(self.learning_rate, 1e-3)
        return replace(self, objective=objective, baseline="moving_average", updates=1, learning_rate=rate)

    def with_features(self, features: str) -> "Preset":
        """This preset with another feature network, and what suits it (``Features.settings``).

        Args:
            features: as of ``Preset``.

        Raises:
            ProbsceneError: an unknown network, or no file named.
        """
        made = replace(self, features=features).make_features()
        return self.with_features_of(made, features if is_file_part(features) else "")

    def with_features_of(self, features: Features, word: str = "") -> "Preset":
        """This preset with features that are given.

        Args:
            word: what is recorded of them; their name where there is none.

        Raises:
            ModelError: their settings are not a preset's.
        """
        settings = features.settings(self)
        known = [each.name for each in fields(self)]
        if not isinstance(settings, dict) or not set(settings) <= set(known):
            actual = (
                ", ".join(sorted(set(settings) - set(known))) if isinstance(settings, dict) else type(settings).__name__
            )
            raise ModelError(
                f"expected of {type(features).__name__}.settings a dict with fields of Preset ({', '.join(known)}), "
                f"got {actual}."
            )
        return replace(self, features=word or features.name, **settings)

    def make_features(self) -> Features:
        """The features that the preset names, with its settings.

        Raises:
            ProbsceneError: an unknown word.
            ModelError: see ``load_part``.
        """
        if is_file_part(self.features):
            return as_features(load_part(self.features))
        presence = self.presence_images, self.presence_epochs, self.presence_width, self.presence_hidden
        made = {
            "count": lambda: CountFeatures(self.count, self.width, self.blocks),
            PRESENCE: lambda: PresenceFeatures(*presence),
            PRESENCE_COUNTS: lambda: PresenceFeatures(*presence, counts=True),
            COUNT_ON_PRETRAINED: lambda: PretrainedCountFeatures(
                self.pairs, self.head_epochs, self.photographs, self.num_scenes
            ),
        }
        if self.features not in made:
            network_name(self.features, TRAINED)
            return ProjectedFeatures(self.features, self.pairs, self.directions, self.num_scenes)
        return made[self.features]()

    def with_guide(self, kind: str) -> "Preset":
        """This preset with another guide. A PCFG's weights, one a rule, are many small steps of Adam away from any
        prior; the Grammar VAE's context is in its latent vectors alone, of which it takes many.

        Raises:
            ProbsceneError: an unknown guide.
        """
        if is_file_part(kind):
            return replace(self, guide=kind)
        if kind not in GUIDES:
            raise ProbsceneError(f"expected a guide among {', '.join(GUIDES)}, or FILE.py:NAME, got {kind!r}.")
        if kind == "pcfg":
            return replace(self, guide=kind, pretrain_rate=3e-2)
        if kind == "grammar-vae":
            return replace(self, guide=kind, pretrain_rate=5e-3, hidden=100, num_latents=32)
        return replace(self, guide=kind)

    @property
    def images(self) -> int:
        """About how many images a fit has drawn, at most: for its features, its batches and its parameters."""
        structure = self.batches * self.num_scenes * self.draws_per_structure
        if self.learn != BOTH:
            return self.make_features().images + structure
        again = self.batches_again * self.num_scenes
        of_parameters = getattr(self, _SCHEDULES[self.parameter_method]).drawn
        return self.make_features().images + structure + of_parameters + again

    def unread(self) -> dict[str, str]:
        """Settings that the chosen guide, objective, features or way of learning do not read, and why."""
        guide, found = set(self.guide_settings()), {}
        if not is_file_part(self.features) and not self.features.startswith(IN_MEMORY):
            own = _FEATURE_SETTINGS.get(self.features, ("pairs", "directions"))
            others = {name for names in _FEATURE_SETTINGS.values() for name in (*names, "directions")}
            found |= dict.fromkeys(others.difference(own), f"the features {self.features!r} have no such setting")
        if self.learn != BOTH:
            settings = (*_SCHEDULES.values(), "parameter_method", "batches_again")
            found |= dict.fromkeys(settings, f"the fit learns {self.learn} alone")
        else:
            others = [name for method, name in _SCHEDULES.items() if method != self.parameter_method]
            found |= dict.fromkeys(others, f"parameters are learnt by {self.parameter_method}")
        for name in ("hidden", "num_latents", "index"):
            if name not in guide:
                found[name] = f"the guide {self.guide!r} has no such setting"
        of_kde = "" if self.objective in ("kde", "js") else "only the objectives kde and js estimate densities"
        of_any = "" if self.objective in OBJECTIVES else f"the objective {self.objective!r} has settings of its own"
        if of_any:
            found |= dict.fromkeys(("variance", "stabilised"), of_any)
        if of_kde:
            found |= dict.fromkeys(("marginal_variance", "leave_one_out", "equal_sizes"), of_kde)
        return found

    def guide_settings(self) -> dict[str, Any]:
        """The arguments of ``make_guide`` that a run keeps."""
        of_kind = {"lstm": ("hidden", "num_latents", "index"), "pcfg": (), "grammar-vae": ("hidden", "num_latents")}
        return {"kind": self.guide} | {name: getattr(self, name) for name in of_kind.get(self.guide, ())}

    def divergence(self) -> Divergence:
        """The objective's divergence.

        Raises:
            ModelError: see ``load_part``.
        """
        if is_file_part(self.objective):
            return ValidatedDivergence(as_divergence(load_part(self.objective)))
        if self.objective in ("mmd", "witness"):
            return MMD(self.variance, self.objective == "mmd", self.stabilised)
        ratio = JensenShannon if self.objective == "js" else KDELogRatio
        return ratio(self.variance, self.marginal_variance, self.leave_one_out, self.equal_sizes, self.stabilised)
