"""The baselines at their best: each guide and objective gets the same search over its settings, beside the default.

    python benchmarks/baselines.py [--fits lstm pcfg grammar-vae mmd witness js] [--draws 24] [--seeds 0]
        [--set variance=20 num_scenes=50]

Structures of Aerial 2D, with true counts of roads and of cars by road instead of images: what is compared is how a
distribution is learnt, and not how images are read. The search draws step size, steps a batch, baseline and number of
batches, the same for all fits, with each one's default among them. All are tried on one target with half the batches,
the better third on another with all of them; both have other distributions than the paper's target, on which the
winner and the default settings are then fitted. Settings whose fit fails, as by scenes that no longer end, are out.
Printed are the total variation of 20,000 structures from the target's distributions, and log q of 5,000 others, nats.
The row ``best-pcfg`` has the rule frequencies of the target's own structures, which no context-free grammar beats in
likelihood, and ``best-pcfg, bounded`` the weights of maximum likelihood where lists end at the longest that the model
declares, as they do in all fits. FOLDER holds ``results.json``, every fit; an interrupted search goes on.
"""

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from given import out_option
from learn_aerial import Truth, judged, show
from torch import Tensor

from probscene.app.files import write_json
from probscene.app.fitting.config import DIVERGENCES, FitConfig
from probscene.app.fitting.presets import DEFAULT
from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.drawing import Drawing
from probscene.errors import ProbsceneError
from probscene.inference.divergence import MMD, KDELogRatio
from probscene.inference.guides.base import Guide
from probscene.inference.guides.pcfg import PCFG
from probscene.inference.objective import BASELINES, ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.models.aerial2d import GRAMMAR, MODEL, TARGET
from probscene.relations import per_parent
from probscene.sampling import Scenes, seed_everything

GUIDES, OBJECTIVES = ("pcfg", "grammar-vae"), ("mmd", "witness", "js")
ROADS, REAL = 4, 5000
ROAD, CAR = GRAMMAR.kind("road"), GRAMMAR.kind("car")
SCORE = ("roads", "first", "others")
RATES, UPDATES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2), (1, 3)
SCENES, BATCH, VARIANCES = (30_000, 60_000, 120_000), (50, 150, 500), (1.0, 4.0, 20.0)


@dataclass(frozen=True)
class Settings:
    """What is searched; see ``StructureTraining`` and ``ScoreFunction``."""

    learning_rate: float
    updates: int
    baseline: str
    scenes: int  # in all batches together
    num_scenes: int  # a batch
    variance: float | None  # of the kernel


def config_of(fit: str) -> FitConfig:
    """The default preset with a guide or a divergence."""
    if fit in GUIDES:
        return DEFAULT.with_guide(fit)
    return DEFAULT.with_divergence(fit) if fit in DIVERGENCES else DEFAULT


def drawn(fit: str, num: int) -> list[Settings]:
    """The default's settings, then others, in one order for all fits."""
    training, kernel = config_of(fit).structure, config_of(fit).divergence
    assert isinstance(kernel, KDELogRatio | MMD)
    every = [Settings(*each) for each in product(RATES, UPDATES, BASELINES, SCENES, BATCH, VARIANCES)]
    order = np.random.default_rng(7).permutation(len(every))
    # All scenes share the cost of MMD: without each one's own, the others' mean is all of it.
    useful = [every[i] for i in order if (fit, every[i].baseline) != ("mmd", "leave_one_out")]
    scenes, N = training.batches * training.num_scenes, training.num_scenes
    own = Settings(training.learning_rate, training.updates, training.baseline, scenes, N, kernel.variance)
    return [own, *(each for each in useful if each != own)][:num]


def changed(settings: Settings, words: list[str]) -> Settings:
    """Settings with other values, such as ``variance=20``."""
    values = dict(word.split("=") for word in words)
    return replace(settings, **{key: type(getattr(settings, key))(value) for key, value in values.items()})


def search_target(seed: int) -> Truth:
    """Like the paper's target, with other numbers of roads and other means."""
    rng = np.random.default_rng([5, seed])
    return Truth((0.0, *rng.dirichlet(np.ones(ROADS))), *rng.uniform(1.0, 10.0, 2))


def seen(derivation: Derivation) -> Tensor:
    """``(N, 6)`` roads, cars, and cars on each road from the first on."""
    of = derivation.counts(len(GRAMMAR.kinds))[:, [ROAD, CAR]].float()
    found = per_parent(derivation, ROAD, CAR)
    each = torch.zeros(len(of), ROADS)
    each[found.scene, found.rank] = found.count.float()
    return torch.cat([of, each], 1)


def structures(num_scenes: int) -> Drawing:
    """The program, without anything to draw."""
    drawing = MODEL.program(num_scenes, MODEL.prior)
    return Drawing(drawing.kind, drawing.kinds, ())


def learnt(fit: str, settings: Settings, truth: Truth, seed: int) -> Guide:
    """A guide that has seen true counts of 5,000 structures."""
    config = config_of(fit)
    seed_everything(1000 + seed)
    real = seen(derive_complete(GRAMMAR, truth.policy, REAL, MODEL.max_steps)[0])
    seed_everything(seed)
    guide = config.guide_maker()(GRAMMAR, MODEL.max_steps)
    guide.bind(MODEL.support)
    pretrain(guide, MODEL.pretraining_policy, learning_rate=config.pretrain.learning_rate)

    def observe(scenes: Scenes) -> Tensor:
        return seen(scenes.derivation)

    assert isinstance(config.divergence, KDELogRatio | MMD)
    divergence = replace(config.divergence, variance=settings.variance)
    loss = ScoreFunction(observe, divergence, ScoreFunctionConfig(baseline=settings.baseline, updates=settings.updates))
    batches = max(1, settings.scenes // settings.num_scenes)
    rate, num_scenes = settings.learning_rate, settings.num_scenes
    StructureTraining(
        structures,
        guide,
        loss,
        real,
        StructureSchedule(batches=batches, num_scenes=num_scenes, learning_rate=rate),
        seed=seed,
    ).run()
    return guide


def best_pcfg() -> PCFG:
    """Each rule's share among the expansions of its nonterminal, in 20,000 structures of the target."""
    seed_everything(98)
    derivation, _ = derive_complete(GRAMMAR, TARGET, 20_000, MODEL.max_steps)
    guide = PCFG(GRAMMAR, MODEL.max_steps)
    used = torch.bincount(derivation.rules[derivation.rules >= 0].flatten(), minlength=len(GRAMMAR.rules))
    with torch.no_grad():
        guide.weights.copy_(used.double().clamp(min=1e-9).log())
    return guide


def best_bounded_pcfg() -> PCFG:
    """The weights of maximum likelihood within the model's support, by gradient on as many structures."""
    seed_everything(98)
    guide = PCFG(GRAMMAR, MODEL.max_steps)
    guide.bind(MODEL.support)
    pretrain(guide, TARGET, 20_000, epochs=150, batch_size=20_000, learning_rate=0.1)
    return guide


class Search:
    """Every fit that was made, kept in a file.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path):
        self.path = path
        self.rows: list[dict] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []

    def row(self, fit: str, settings: Settings, target: int | None, seed: int) -> dict:
        """The figures of a fit, which is made where it is not known; of the paper's target where that is None."""
        about = {"fit": fit, "target": target, "seed": seed, **asdict(settings)}
        for row in self.rows:
            if all(row[key] == value for key, value in about.items()):
                return row
        start, truth = time.process_time(), Truth() if target is None else search_target(target)
        guide = learnt(fit, settings, truth, seed)
        row = about | judged(guide, truth) | {"seconds": round(time.process_time() - start, 1)}
        self.rows.append(row)
        write_json(self.path, self.rows)
        print(json.dumps(row), flush=True)
        return row

    def best(self, fit: str, draws: int) -> Settings:
        """Successive halving on two targets."""

        def score(settings: Settings, target: int, share: float) -> float:
            short = replace(settings, scenes=round(share * settings.scenes))
            try:
                row = self.row(fit, short, target, 0)
            except ProbsceneError as error:
                print(f"{fit}: {short} fails: {error}", flush=True)
                return math.inf
            return sum(row[column] for column in SCORE)

        every = drawn(fit, draws)
        first = sorted(every, key=lambda each: score(each, 0, 0.5))[: -(-draws // 3)]
        return min(first, key=lambda each: score(each, 1, 1.0))


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--fits", nargs="+", default=["lstm", "pcfg"], choices=["lstm", *GUIDES, *OBJECTIVES])
    parser.add_argument("--draws", type=int, default=24, help="settings that are tried; 0 for no search")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="a row of the default but for these")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    search, table = Search(args.out / "results.json"), {}
    for fit in args.fits:
        named = {f"{fit}, default": drawn(fit, 1)[0]}
        if args.set:
            named[f"{fit}, {' '.join(args.set)}"] = changed(drawn(fit, 1)[0], args.set)
        if args.draws:
            named[f"{fit}, best"] = search.best(fit, args.draws)
            print(f"{fit}: {named[f'{fit}, best']}", flush=True)
        for name, settings in named.items():
            table[name] = [search.row(fit, settings, None, seed) for seed in args.seeds]
    others = {
        "prior": MODEL.prior,
        "start": MODEL.pretraining_policy,
        "best-pcfg": best_pcfg(),
        "best-pcfg, bounded": best_bounded_pcfg(),
        "target": TARGET,
    }
    table |= {name: [judged(policy, Truth())] for name, policy in others.items()}
    show(table)


if __name__ == "__main__":
    main()
