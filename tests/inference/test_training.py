"""The laws of ``Training``, for all of them."""

import json
import math

import pyro
import pytest
import torch
from pyro.infer import SVI
from pyro.optim.lr_scheduler import PyroLRScheduler
from torch.optim.lr_scheduler import LambdaLR

from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.errors import ProbsceneError
from probscene.inference.divergence import KDELogRatio
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.net import CountNet
from probscene.inference.features.counting.training import CountTraining
from probscene.inference.features.photographs.net import PretrainedCountNet
from probscene.inference.features.photographs.training import PretrainedCountTraining
from probscene.inference.features.presence import PresenceNet, PresenceTraining
from probscene.inference.features.projection import Projected, ProjectionTraining
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.inference.training import batch_seed
from probscene.sampling import seed_everything


class Means(torch.nn.Module):
    """A pretrained network of five features; of NaN where it is spoilt."""

    names = ("red", "green", "blue", "dark", "spread")

    def __init__(self):
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(()))

    @torch.no_grad()
    def embed(self, images):
        x = images.float() * self.unit
        return torch.cat([x.mean((2, 3)), torch.stack([x.amin(1).mean((1, 2)), x.std((1, 2, 3))], 1)], 1)


def counting(dots, small):
    net = CountNet(dots.classes, 3, dots.canvas, width=(4, 8, 8), blocks=(0, 0))
    schedule = CountSchedule(steps=20, images=2, crops=4, crop=32, window=2)
    return CountTraining(net, RenderedFeatures(dots, 1).draw, schedule, seed=1), net


def presence(dots, small):
    net = PresenceNet(dots.classes, 4, 8)
    return PresenceTraining(net, RenderedFeatures(dots, 1).draw, 40, 3, 20, accuracy=1.1, seed=1), net


def counts_one_hot(dots, small):
    net = PresenceNet(dots.classes, 4, 8, ways=5)
    return PresenceTraining(net, RenderedFeatures(dots, 1).draw, 40, 3, 20, accuracy=1.1, seed=1), net


def pretrained_counting(dots, small):
    net = PretrainedCountNet(dots.classes, dots.canvas, held=8, sizes=(160, 160))
    photographs = torch.randint(0, 256, (5, 3, *dots.canvas), dtype=torch.uint8)
    return PretrainedCountTraining(
        net, RenderedFeatures(dots, 1).draw_twice, 8, 2, 4, photographs=photographs, seed=1
    ), net


def projection(dots, small):
    net = Projected(Means(), 2)
    return ProjectionTraining(net, RenderedFeatures(dots, 1), 140, 2, 30, seed=1), net


def structure(dots, small, divergence=None, **options):
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    loss = ScoreFunction(
        lambda scenes: scenes.derivation.counts(len(small.grammar.kinds)).float(),
        divergence or KDELogRatio(),
        ScoreFunctionConfig(updates=2),
    )
    real = small.features[torch.multinomial(small.target, 200, replacement=True)]
    return StructureTraining(small.program, guide, loss, real, StructureSchedule(4, num_scenes=40, **options), 5), guide


ALL = {
    "count": (counting, "steps"),
    "presence": (presence, "epochs"),
    "counts one-hot": (counts_one_hot, "epochs"),
    "pretrained count": (pretrained_counting, "epochs"),
    "projection": (projection, "structures"),
    "structure": (structure, "batches"),
}


@pytest.fixture(params=ALL)
def made(request, dots, small):
    """Makes a training, the same whenever it is called, and its module."""

    def make():
        torch.manual_seed(0)
        return ALL[request.param][0](dots, small)

    make.unit = ALL[request.param][1]
    return make


class Interrupted(Exception):
    pass


def bits(module):
    return {key: value.clone() for key, value in module.state_dict().items()}


def same(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def test_done_grows_up_to_the_total(made):
    training, module = made()
    heard = []
    assert training.unit == made.unit and training.done == 0 < training.total
    training.run(lambda training, line: heard.append((training.done, dict(line))))
    done = [number for number, _ in heard]
    assert done == sorted(done) and done[-1] == training.done == training.total
    assert all(isinstance(value, int | float) for _, line in heard for value in line.values())
    json.dumps(training.summary())
    before, number = bits(module), len(heard)
    training.run(lambda training, line: heard.append((training.done, dict(line))))
    assert training.done == training.total and same(bits(module), before)
    assert all("loss" not in line for _, line in heard[number:])


def test_interrupted_anywhere_it_goes_on_to_the_same_bits(made):
    whole, module = made()
    reports = []
    whole.run(lambda training, line: reports.append(line))
    steps = len(reports)
    for stop in {0, steps // 2, steps - 1}:
        first, _ = made()
        kept, heard = {}, []

        def callback(training, line, stop=stop, kept=kept, heard=heard):
            if len(heard) == stop:
                kept.update({key: value.clone() for key, value in training.state().items()})
                raise Interrupted
            heard.append(line)

        with pytest.raises(Interrupted):
            first.run(callback)
        second, again = made()
        second.restore(kept)
        assert 0 <= second.done <= first.done
        second.run()
        assert second.done == whole.done and same(bits(again), bits(module)), stop
        assert json.dumps(second.summary()) == json.dumps(whole.summary())


@pytest.mark.parametrize("name", ALL)
def test_what_is_not_finite_ends_it(name, dots, small):
    torch.manual_seed(0)
    if name == "structure":
        training, _ = structure(dots, small, lambda generated, real: torch.full((len(generated),), math.nan))
    else:
        training, module = ALL[name][0](dots, small)
        spoilt = module.pretrained if name == "projection" else getattr(module, "heads", module)
        with torch.no_grad():
            next(p for p in spoilt.parameters()).fill_(math.nan)
    with pytest.raises(ProbsceneError, match=r"(^|: )expected .*finite .* got .*(nan|NaN).*; "):
        training.run()


@pytest.mark.parametrize("cosine", [True, False])
def test_pyros_own_loop_takes_the_same_steps(dots, small, cosine):
    """The loop of examples/multi_mnist.py, seeded as ``StructureTraining`` seeds its batches."""
    torch.manual_seed(0)
    trainer, learnt = structure(dots, small, cosine=cosine)
    trainer.run()
    torch.manual_seed(0)
    other, guide = structure(dots, small)
    loss, updates, batches = other.objective, other.objective.config.updates, other.total

    def rate(step):
        return 0.5 * (1 + math.cos(math.pi * step / (updates * batches))) if cosine else 1.0

    adam = PyroLRScheduler(LambdaLR, {"optimizer": torch.optim.Adam, "optim_args": {"lr": 1e-2}, "lr_lambda": rate})
    svi = SVI(small.program, guide, adam, loss=loss)
    before = bits(guide)
    with pyro.get_param_store().scope():
        for step in range(updates * batches):
            if step % updates == 0:
                seed_everything(batch_seed(5, step // updates))
            svi.step(40, real=other.real)
            adam.step()
    assert same(bits(guide), bits(learnt)) and not same(bits(guide), before)
