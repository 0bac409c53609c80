"""How much of an object has to be found is what renders say."""

from types import SimpleNamespace

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.inference.features.base import Examples
from probscene.inference.parameters.calibration import MAX_MATCH_DISTANCE, CalibratedReader
from probscene.inference.parameters.reader import SCORE_THRESHOLDS, Detections, find_objects
from probscene.inference.parameters.reader_training import MIN_VISIBLE, SupervisedBatch
from probscene.inference.parameters.sites import Site
from probscene.inference.parameters.skill import Skill

seeds = st.integers(0, 2**31)


@given(seeds, st.floats(0.1, 0.5), st.floats(0.0, 0.5))
def test_blocks_that_hold_more_are_among_those_that_hold_less(seed, least, more):
    rng = np.random.default_rng(seed)
    score = torch.from_numpy(rng.uniform(0, 1, (3, 9, 7)) ** 4).float()
    n, y, x, inside = find_objects(score, least)
    enough = inside > least + more
    again = find_objects(score, least + more)
    for part, other in zip((n, y, x, inside), again, strict=True):
        assert torch.equal(part[enough], other)


@given(seeds, st.integers(0, 60))
def test_the_threshold_makes_the_fewest_mistakes_up_to_chance(seed, number):
    """As a loop over images, objects and nodes counts them."""
    rng = np.random.default_rng(seed)
    N, M = 4, 5
    label = torch.from_numpy(rng.integers(-1, 2, (N, M)))
    centre = torch.from_numpy(rng.uniform(0, 60, (N, M, 2))).float()
    seen = torch.from_numpy(rng.uniform(0, 1, (N, M))).float()
    nothing = torch.zeros(N, M, 0)
    drawn = Examples(*(torch.zeros(N),) * len(Examples._fields))._replace(label=label, centre=centre, visible=seen)
    valued = SupervisedBatch(drawn, label, label, label, nothing, torch.zeros(N, 0))
    image = torch.from_numpy(np.sort(rng.integers(0, N, number)))
    place = torch.from_numpy(rng.uniform(0, 60, (number, 2))).float()
    score = torch.from_numpy(rng.uniform(0.2, 1, number))
    found = Detections(image, score, image, place, place, torch.zeros(number, 0, 6), torch.zeros(N, 0, 6))
    reader = SimpleNamespace(
        detect_all=lambda images: found, thresholds=SCORE_THRESHOLDS, score_threshold=torch.tensor(0.0)
    )
    CalibratedReader.choose_threshold(SimpleNamespace(reader=reader), valued)

    def mistakes(least: float) -> int:
        hit, spare = set(), 0
        for k in range(number):
            if score[k] > least:
                away = {
                    m: float((centre[image[k], m] - place[k]).norm())
                    for m in range(M)
                    if label[image[k], m] >= 0 and seen[image[k], m] >= MIN_VISIBLE
                }
                node = min(away, key=away.get, default=None)
                near = node is not None and away[node] < MAX_MATCH_DISTANCE and (int(image[k]), node) not in hit
                spare += not near
                hit |= {(int(image[k]), node)} if near else set()
        return int(((label >= 0) & (seen >= MIN_VISIBLE)).sum()) - len(hit) + spare

    fewest = min(map(mistakes, SCORE_THRESHOLDS))
    wanted = min(least for least in SCORE_THRESHOLDS if mistakes(least) <= fewest + fewest**0.5)
    assert float(reader.score_threshold) == np.float32(wanted)


def test_sites_that_are_read_often_enough_are_learnt(smeared):
    """Of nodes and of scenes."""
    of_nodes = tuple(Site(name, ("cell",)) for name in ("sharp", "poor", "never", "turn"))
    tried = CalibratedReader(smeared, SimpleNamespace(), of_nodes, (Site("sun", ()), Site("cloud", ())))
    tried.skill = Skill(torch.zeros(6, dtype=torch.int64), torch.tensor([0.95, 0.1, 0.5, 0.6, 0.5, 0.95]))
    tried.num_readings = torch.tensor([100, 100, 3, 100, 100, 100])
    assert tried.good.tolist() == [True, False, False, True, True, True]
