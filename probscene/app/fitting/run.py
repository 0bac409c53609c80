"""A run: its folder, and what it is made of: model, features, divergence, guide."""

import copy
import os
import shutil
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from probscene.errors import RunError
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, Features
from probscene.inference.guides.base import Guide
from probscene.inference.guides.scenario import guide_of
from probscene.model import SceneModel
from probscene.policy import Policy

from ..files import make_folder, write_json, write_whole
from ..loading import BUILT_IN, assets_record, lasting_reference, load_model, recorded_model, split_reference
from ..modules import file_digest
from ..neighbours import neighbours
from .config import FitConfig, GuideConfig, from_flat_preset
from .learnt_parameters import split_tensors, with_parameters
from .plugins import (
    IN_MEMORY,
    Plugins,
    ValidatedDivergence,
    ValidatedNet,
    as_divergence,
    check_guide,
    is_file_part,
    part_file,
)
from .store import FORMAT, Storage, check_free, load_state, read_record

WHOLE_MODEL = "model"  # folder
PRIOR_KEPT = "prior_kept"  # the only tensor of a guide that was given up
GENERATED_SOURCES = ("prior", "start", "structure", "parameters", "learnt")
"""What a run can generate: of the prior; of the initialisation; of learnt structures with the prior's parameters; of
the prior's structures with learnt parameters; of both as they were learnt."""


class RunFolder(Storage):
    """A run folder.

    Args:
        model: the scene model, where it is in memory; else it is loaded once, when it is asked for.
        plugins: what the user brought as objects.

    Attributes:
        path: the folder.
        record: the contents of ``run.json``.
    """

    def __init__(
        self, path: Path, record: dict[str, Any], model: SceneModel | None = None, plugins: Plugins | None = None
    ):
        super().__init__(path, record)
        self.plugins, self._model = plugins or Plugins(), model
        self._network: FeatureNet | None = None

    @classmethod
    def create(
        cls,
        path: Path,
        model: str | SceneModel,
        record: dict[str, Any],
        assets: Path | None = None,
        loaded: SceneModel | None = None,
        plugins: Plugins | None = None,
    ) -> Self:
        """A new run folder; ``record`` is kept in ``run.json``.

        Args:
            model: a reference; or a model that is in memory alone, which the folder then cannot give back.
            assets: a folder that the model is drawn with, from now on whenever the run is opened.
            loaded: the model of a reference, where it is loaded already.
            plugins: what the user brought as objects.

        Raises:
            RunError: the folder holds a run or other files already.
            MachineError: it cannot be written.
        """
        check_free(path := Path(path))
        if isinstance(model, SceneModel):
            reference, file, digest, loaded = f"{IN_MEMORY}{model.name}", None, None, model
            prefixed = {}
        else:
            loaded = loaded or load_model(model, assets)
            reference, name = lasting_reference(model), split_reference(model)[0]
            file = None if name in BUILT_IN else Path(name)
            digest = None if file is None else file_digest(file)
            prefixed = {} if file is None else neighbours(file)
        make_folder(path)
        about: dict[str, Any] = {"format": FORMAT, "model": reference, "model_sha256": digest}
        if prefixed:
            about["modules"] = {name: file_digest(each) for name, each in prefixed.items()}
        about |= assets_record(loaded, assets)
        about |= {"within_support": not record.get("config", {}).get("pretrain", {}).get("on_prior")}
        run = cls(path, record | about, loaded, plugins)
        write_json(path / "run.json", run.record)  # first: with it, what is interrupted here can be resumed
        if file is not None:
            write_whole(path / "model.py", lambda temporary: shutil.copyfile(file, temporary))
            for name, each in {file.name: file, **prefixed}.items() if prefixed else ():
                make_folder((path / WHOLE_MODEL / name).parent)
                write_whole(path / WHOLE_MODEL / name, partial(shutil.copyfile, each))
        return run

    @classmethod
    def at(cls, path: Path, model: SceneModel | None = None, plugins: Plugins | None = None) -> Self:
        """An existing run folder.

        Args:
            model, plugins: see ``RunFolder``; for a run that was begun with what was in memory alone.

        Raises:
            RunError: there is none, it is damaged, or another version wrote it.
        """
        return cls(path, read_record(Path(path)), model, plugins)

    @property
    def model(self) -> SceneModel:
        """The scene model, loaded once.

        Raises:
            RunError: the model's file is gone or has changed since the fit, or it draws with other assets; it was in
                memory alone.
        """
        if self._model is None:
            reference = self.record["model"]
            self.check_objects("model")
            file = Path(split_reference(reference)[0])
            self._unchanged(file, self.record["model_sha256"], "model")
            for name, digest in self.record.get("modules", {}).items():
                self._unchanged(file.parent / name, digest, "model's")
            self._model = recorded_model(self.record, self.path)
        if self._on_prior and self._model.pretraining is not None:
            self._model = replace(self._model, pretraining=None)
        return self._model

    def check_objects(self, *needed: str) -> None:
        """See that what was in memory is given again.

        Args:
            needed: of ``model``, ``features``, ``divergence`` and ``guide``.

        Raises:
            RunError: one of them is not.
        """
        objects, given = self.objects, {**vars(self.plugins), "model": self._model}
        if set(missing := [name for name in objects if given[name] is None]) & set(needed):
            named = ", ".join(f"{name} ({objects[name]})" for name in missing)
            again = ", ".join(f"{name}=..." for name in missing)
            raise RunError(
                f"expected all that the run in {self.path} was begun with, got its folder, which cannot give back "
                f"what was in memory: {named}. Open it from Python: probscene.Run.open({str(self.path)!r}, {again})."
            )

    @property
    def target(self) -> Path:
        """The folder of its target's images; of others what they are called."""
        if (named := self.record["target"]) is None:
            return Path("images in memory")
        return Path(named) if isinstance(named, str) else Path(os.path.commonpath([Path(f).parent for f in named]))

    @cached_property
    def config(self) -> FitConfig:
        """How the run learns. Parts that were in memory alone are words in it, see ``objects``."""
        if "config" in self.record:
            return FitConfig.from_record(self.record["config"])
        return from_flat_preset(self.record.get("preset", {}), self.record.get("guide", {}))

    @property
    def _on_prior(self) -> bool:
        """Whether guides are pretrained on the prior itself; an evaluation's bare record says nothing of it."""
        return ("config" in self.record or "preset" in self.record) and self.config.pretrain.on_prior

    @cached_property
    def features(self) -> Features:
        """The run's choice of features.

        Raises:
            RunError: they were in memory alone, or their file is gone or has changed.
        """
        if self.plugins.features is not None:
            return self.plugins.features
        self.check_objects("features")
        self._check_unchanged("features")
        return self.config.make_features()

    def build_network(self) -> FeatureNet:
        """The feature network as it is before any training.

        Raises:
            DataError: see ``pretrained``.
            ModelError: a user's own that cannot be built, or that is no network.
        """
        net = self.features.build(self.model)
        return net if _is_ours(net) else ValidatedNet(net, self.features)

    def network(self) -> FeatureNet | None:
        """The feature network with its state, once it is trained; None before. Loaded once, see ``load_state``."""
        tensors = self.read_tensors("features") if self._network is None else None
        if tensors is not None:
            net = self.build_network()
            load_state(net, tensors)
            self._network = net
        return self._network

    def keep_network(self, net: FeatureNet) -> None:
        """Take a network, which has its state, as the one that ``network`` gives."""
        self._network = net

    @cached_property
    def feature_names(self) -> tuple[str, ...]:
        """One name a feature."""
        return tuple((self._network or self.build_network()).names)

    def divergence(self, net: FeatureNet) -> Divergence:
        """What the fit descends, as it suits the network.

        Raises:
            RunError: it was in memory alone, or its file is gone or has changed.
        """
        if self.plugins.divergence is not None:
            chosen: Divergence = ValidatedDivergence(self.plugins.divergence)
        else:
            self.check_objects("divergence")
            self._check_unchanged("divergence")
            made = self.config.make_divergence()
            chosen = made if _is_ours(made) else ValidatedDivergence(made)
        found = self.features.divergence(net, chosen)
        return found if _is_ours(found) else ValidatedDivergence(as_divergence(found))

    def new_guide(self) -> Guide:
        """An untrained guide of the kind and size that the run was begun with.

        Raises:
            RunError: its class was in memory alone, or its file is gone or has changed.
            ModelError: see ``check_guide``.
        """
        model = self.model
        self.check_objects("guide")
        self._check_unchanged("guide")
        make = self.plugins.guide or self.config.guide_maker()
        made = guide_of(model.grammar, model.max_steps, make)
        if self.plugins.guide is not None or not isinstance(self.config.guide, GuideConfig):
            made = check_guide(made, model.max_steps)
        if self.record.get("within_support"):  # runs of before have none, and stay as they were
            made.bind(model.guide_support(self.unread))
        return made

    @cached_property
    def guide(self) -> Policy:
        """The learnt guide; the model's prior where what was learnt is farther from the target, see ``outcome``.

        Raises:
            RunError: the fit is not finished, or the file does not hold this run's guide.
        """
        tensors = self.read_tensors("guide")
        if tensors is None:
            raise RunError(f"expected a finished fit in {self.path}, got an unfinished one; continue with --resume.")
        if PRIOR_KEPT in tensors:
            return self.model.prior
        guide = self.new_guide()
        try:
            guide.load_state_dict(split_tensors(tensors)[0])
        except RuntimeError as error:
            raise RunError(f"expected a guide for model {self.model.name} in {self.path}, got another.") from error
        return with_parameters(self.model, self.config, self.parameters, guide.eval(), split_tensors(tensors)[1])

    def policy(self, source: str) -> Policy:
        """What draws the scenes of a source, of ``GENERATED_SOURCES``.

        Raises:
            RunError: see ``guide``.
        """
        if source == "prior":
            return self.model.prior
        if source == "start":
            return self.model.pretraining_policy
        if source == "learnt":
            return self.guide
        found = copy.copy(self.model.prior if source == "parameters" else self.guide)
        found.with_parameters = self.guide.with_parameters if source == "parameters" else None
        return found

    def generated_sources(self) -> tuple[str, ...]:
        """Those of ``GENERATED_SOURCES`` that are no copy of another.

        Raises:
            RunError: see ``guide``.
        """
        same = {"start"} if self.model.pretraining is None else set[str]()
        if self.guide.with_parameters is None:
            same |= {"structure", "parameters"}
        return tuple(name for name in GENERATED_SOURCES if name not in same)

    def give_back_parameters(self, because: str) -> None:
        """Let all sites keep the prior from now on.

        Args:
            because: what is said of each.
        """
        tensors, record = self.read_tensors("guide"), self.parameters
        if tensors is None or not record:
            return
        sites = [site | ({"learnt": False, "because": because} if site["learnt"] else {}) for site in record["sites"]]
        self.write_tensors("guide", split_tensors(tensors)[0])
        self.write_parameters(record | {"sites": sites})
        vars(self).pop("guide", None)

    def check_finished(self) -> None:
        """See that there is a learnt guide.

        Raises:
            RunError: see ``guide``.
        """
        _ = self.guide

    def _check_unchanged(self, part: str) -> None:
        """See that the file of features, divergence or guide is as it was."""
        if is_file_part(word := self.config.words().get(part, "")):
            parts = self.record.get("parts", {})
            for file in (part_file(word), *neighbours(part_file(word)).values()):
                self._unchanged(file, parts.get(str(file)), "part's")

    def _unchanged(self, file: Path, digest: str | None, what: str) -> None:
        if digest is not None and (not file.is_file() or file_digest(file) != digest):
            copy = self.path / (WHOLE_MODEL if self.record.get("modules") else "model.py")
            kept = (
                f"A copy is in {copy}: put it back, or fit again. Where the file only lies elsewhere "
                f"by now, probscene fit FILE --out {self.path} --resume tells the run so."
                if what.startswith("model")
                else ""
            )
            raise RunError(
                f"expected the {what} file {file} as it was when {self.path} was fitted, got a missing or changed "
                f"file. {kept or 'Put it back, or fit again.'}"
            )


def _is_ours(part: Any) -> bool:
    """Whether a part is the library's own, or what it has checked."""
    return type(part).__module__.startswith("probscene.")


def is_run(path: str) -> bool:
    """Whether a command's MODEL_OR_RUN names a run folder."""
    return path not in BUILT_IN and (Path(path) / "run.json").is_file()
