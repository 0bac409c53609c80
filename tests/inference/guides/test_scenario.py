"""Guides of several scenarios learn together from pooled densities, each from its own scenes."""

import pyro
import torch

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.inference.divergence import KDELogRatio
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.scenarios import JointGrammar
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

LISTS = Grammar("Scene -> Items\nItems -> item Items | ε")
PAIRS = Grammar("Scene -> wall Items Doors\nItems -> item Items | ε\nDoors -> door Doors | ε")
JOINT = JointGrammar({"lists": LISTS, "pairs": PAIRS})
TRUTH = StructurePrior.joined(
    JOINT,
    [
        StructurePrior(LISTS, Items=counts(0.1, 0.1, 0.7, 0.1)),
        StructurePrior(PAIRS, Items=counts(0.7, 0.2, 0.1), Doors=counts(0.1, 0.2, 0.7)),
    ],
    JOINT.first_symbol,
    JOINT.first_rule,
    [1.0, 1.0],
)


def program(num_scenes, structure=TRUTH):
    with pyro.plate("scenes", num_scenes, dim=-2):
        return SceneGraph(JOINT, derive(JOINT, structure, num_scenes, 12)).draw()


def counted(derivation: Derivation):
    return derivation.counts(len(JOINT.kinds)).float()


def test_guides_of_two_scenarios_come_to_the_truth_together():
    torch.manual_seed(0)
    pyro.set_rng_seed(0)
    guide = ScenarioGuide(JOINT, 12, hidden=12)
    every = enumerate_derivations(JOINT, 12)
    truth = TRUTH.log_prob(every).exp()

    def distance():
        with torch.no_grad():
            return 0.5 * (guide.log_prob(every).exp() - truth).abs().sum().item()

    drawn, _ = torch.sort(torch.multinomial(truth, 3000, replacement=True))
    real, before = counted(every[drawn]), distance()
    objective = ScoreFunction(
        lambda scenes: counted(scenes.derivation),
        KDELogRatio(0.2, None),
        ScoreFunctionConfig(updates=3),
        strata=guide.strata,
    )
    StructureTraining(program, guide, objective, real, StructureSchedule(batches=60, num_scenes=300)).run()
    assert distance() < 0.15 < 0.5 < before


def test_each_stratum_has_its_own_baseline():
    """Costs of two strata that lie apart: an advantage is a cost less the mean of the others in its stratum."""
    guide = ScenarioGuide(JOINT, 12, hidden=4)
    objective = ScoreFunction(
        lambda scenes: counted(scenes.derivation),
        lambda generated, real: generated[:, JOINT.kind("item")] + 100 * generated[:, JOINT.kind("wall")],
        strata=guide.strata,
    )
    objective(program, guide, 80, real=None)
    batch, strata = objective.batch, guide.strata(objective.batch.derivation)
    for stratum in (0, 1):
        cost = batch.cost[strata == stratum]
        others = (cost.sum() - cost) / (len(cost) - 1)
        assert torch.allclose(batch.advantage[strata == stratum], cost - others, atol=1e-4)
    moving = ScoreFunction(
        objective.observe,
        objective.divergence,
        ScoreFunctionConfig(baseline="moving_average", decay=0.5),
        strata=guide.strata,
    )
    means = []
    for _ in range(2):
        moving(program, guide, 80, real=None)
        strata = guide.strata(moving.batch.derivation)
        means.append([moving.batch.cost[strata == s].mean().item() for s in (0, 1)])
    expected = {s: 0.5 * means[0][s] + 0.5 * means[1][s] for s in (0, 1)}
    assert all(abs(moving.averages[s] - expected[s]) < 1e-3 for s in (0, 1))
