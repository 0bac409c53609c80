"""Which learnt sites keep their prior, by what is read of them in images that nothing was learnt from."""

from types import SimpleNamespace

import pytest
import torch

from probscene.app.fitting import site_selection as select_sites


def rows(mean, number):
    """What is read of a site, three times in each image."""
    return mean + torch.randn(number, 2), torch.arange(number) // 3


def test_sites_keep_the_prior_by_what_is_read_of_them():
    """Of ``x`` learnt renders are nearer, of ``w`` farther; of ``z`` nothing is read in the target."""

    class Learning:
        calibrated = SimpleNamespace(low_skill_sites=frozenset("u"))

        def site_rows(self, images):
            assert set(images) == {"learnt", "prior", "target"}
            torch.manual_seed(0)
            where = {
                "learnt": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0, "u": 9.0},
                "prior": {"x": 1.0, "y": 0.0, "z": 0.0, "w": -2.0, "u": 1.0},
                "target": {"x": 0.2, "y": 0.0, "z": 0.0, "w": -1.5, "u": 0.2},
            }
            return {
                site: {name: rows(where[name][site], 0 if (name, site) == ("target", "z") else 120) for name in images}
                for site in "xyzwu"
            }

    images = dict.fromkeys(("learnt", "prior", "target"), torch.zeros(0))
    assert select_sites.sites_to_reset(Learning(), Learning().site_rows(images), careful=True) == {"y", "z", "w"}
    assert select_sites.sites_to_reset(Learning(), Learning().site_rows(images), careful=False) == {"w"}


class Renders:
    """What is read of a site is moved by its own value, and by what ``v`` has and ``w`` is said to have. Of the scenes'
    sites u is a tenth of that farther than where the prior has it; there are scenes that lack them."""

    def __init__(self, learnt: dict[str, float], moves: dict[str, float], of_scenes: tuple[str, ...] = ()):
        self.learnt, self.moves, self.seed = learnt, moves, 0
        self.calibrated = SimpleNamespace(
            low_skill_sites=frozenset(learnt), unidentifiable_sites=lambda renders: {"lost": 0.1}
        )
        self.scene_sites = [SimpleNamespace(name=name) for name in of_scenes]
        self.asked = []

    def guide_scenes(self, kept):
        self.asked.append(kept)
        values = {name: value * (name not in kept) for name, value in self.learnt.items()}
        u = torch.linspace(0, 0.5, 50)[:, None] + torch.tensor([0.1 * values[s.name] for s in self.scene_sites])
        u[::7] = torch.nan
        return SimpleNamespace(drawn=SimpleNamespace(image=values), overall=u)

    def site_rows(self, images):
        self.seed += 1
        torch.manual_seed(self.seed)

        def read(of, name):
            if isinstance(of, torch.Tensor):
                return rows(1.0, 3 * len(of))
            return rows(of[name] + sum(of[other] * by for other, by in self.moves.items() if other != name), 600)

        return {name: {source: read(of, name) for source, of in images.items()} for name in self.learnt}


def test_unclear_sites_are_learnt_where_renders_without_them_are_farther():
    """``u`` and ``v`` are as the target has them; ``w`` is not, nor ``lost``, which would be nearer."""
    learning = Renders({"u": 1.0, "v": 1.0, "w": -1.0, "lost": 1.0}, {})
    kept, because = select_sites.reset_low_skill_sites(learning, torch.zeros(400), frozenset("k"))
    assert kept == {"w", "lost"}
    assert because == {"lost": "in renders that look like the target 10% of its variance can be read"}
    assert all("k" in each for each in learning.asked) and len(learning.asked) == 5
    nothing = Renders({"w": -1.0, "lost": 1.0}, {})
    assert (
        select_sites.reset_low_skill_sites(nothing, torch.zeros(400), frozenset())[0] == {"w", "lost"}
        and len(nothing.asked) == 2
    )


def test_an_unclear_site_of_scenes_that_hardly_moves_keeps_its_prior():
    """As ``u`` does, and as ``v`` does not; ``w`` moves as little, but is of objects."""
    learning = Renders({"u": 0.9, "v": 1.1, "w": 0.9}, {}, of_scenes=("v", "u"))
    kept, because = select_sites.reset_low_skill_sites(learning, torch.zeros(400), frozenset())
    assert kept == {"u"} and because["u"] == "it would be 0.09 of u from its prior, no farther than it may be misread"


def test_what_is_learnt_wrongly_is_not_in_the_way_of_the_others():
    """What is read of ``u`` is moved by ``w``, which is learnt wrongly: with it ``u`` comes hardly nearer."""
    learning = Renders({"u": 1.0, "w": -1.0}, {"w": 0.4})
    assert select_sites.reset_low_skill_sites(learning, torch.zeros(400), frozenset())[0] == {"w"}
    assert learning.asked[-1] == {"w"}


def test_of_many_sites_none_is_learnt_by_chance():
    """Of forty learnt renders are as far away as the prior's; of one they are nearer, which is seen all the same."""

    class Learning:
        calibrated = SimpleNamespace(low_skill_sites=frozenset())

        def site_rows(self, images):
            torch.manual_seed(0)
            means = {"learnt": -0.5, "prior": 0.5, "target": 0.0}
            nothing = {f"n{i}": {name: rows(means[name], 120) for name in images} for i in range(40)}
            return nothing | {"x": {name: rows(float(name == "prior"), 120) for name in images}}

    images = {name: torch.zeros(0) for name in ("learnt", "prior", "target")}
    assert select_sites.sites_to_reset(Learning(), Learning().site_rows(images), careful=True) == {
        f"n{i}" for i in range(40)
    }


@pytest.mark.parametrize(
    ("sure", "learnt", "needed", "kept"),
    [
        (False, 0.1, "", {"w"}),
        (False, 3.0, "", {"y", "w"}),
        (False, 3.0, "w", {"y"}),
        (True, 0.1, "", {"y", "w"}),
        (True, 0.1, "w", {"y", "w"}),
    ],
)
def test_sites_are_settled_by_how_renders_look_and_by_what_is_read(sure, learnt, needed, kept, monkeypatch):
    """Renders look as the target where ``learnt`` is 0. Of ``x`` they are nearer than the prior's, which look 1 off, of
    ``w`` farther, of ``y`` as near; only who has to be sure, or whose renders look farther, lets ``y`` go. Without what
    is ``needed`` they look farther, which keeps it where one has not to be sure."""

    torch.manual_seed(0)
    real = torch.randn(140, 4).numpy()
    ways = torch.randn(140, 4).numpy()

    def looks(guide, without):
        return real + learnt * ways + 2.0 * (needed in without)

    class Learning:
        calibrated = SimpleNamespace(low_skill_sites=frozenset("u"), state=lambda: {"reader": read_by})
        guide = SimpleNamespace(with_parameters=lambda model: "learnt", net=torch.nn.Linear(2, 2))
        best = SimpleNamespace(held=SimpleNamespace(looks=looks, real=real))

        def site_rows(self, images):
            assert set(images) == {"prior", "learnt", "target"}
            torch.manual_seed(0)
            where = {"x": (1.0, 0.0, 0.0), "y": (0.0, 0.0, 0.0), "w": (0.0, 1.0, 0.0), "u": (9.0, 0.0, 9.0)}
            return {
                site: {name: rows(mean, 120) for name, mean in zip(("prior", "learnt", "target"), means, strict=True)}
                for site, means in where.items()
            }

    drawn, read_by = [], torch.zeros(2)

    def renders(run, model, guide, number):
        drawn.append((model, number))
        return torch.randn(number, 4) + {"prior": 1.0, "learnt": learnt}[model]

    monkeypatch.setattr(select_sites, "_renders", renders)
    monkeypatch.setattr(select_sites, "_embed", lambda: lambda images: images.double().numpy())
    run = SimpleNamespace(record={"seed": 0}, model="prior")
    torch.manual_seed(0)
    target = torch.randn(150, 4)
    settle = select_sites.prior_site_selector(run, None, lambda many: target[: 150 if many else 140], sure)
    learning, found = Learning(), []
    first = learning.guide.net.weight.data
    for last in (False, False, True):
        found.append(settle(learning, last))
        found.append(settle(learning, False))  # nothing is drawn anew for a guide that has not changed
        learning.guide.net.weight.data = learning.guide.net.weight.data + 1
    learning.guide.net.weight.data = first
    found.append(settle(learning, False))  # nor for one that is gone back to
    read_by += 1
    found.append(settle(learning, False))
    assert found == [kept] * 8
    looked_at = [140, 140, *([150] if sure else []), 140, 140]
    assert [number for model, number in drawn if model == "learnt"] == looked_at
    assert [number for model, number in drawn if model == "prior"] == [*dict.fromkeys(looked_at)]  # which do not change


def test_what_a_guide_looks_like_is_drawn_once_until_its_weights_change(monkeypatch):
    drawn = []

    def renders(run, model, guide, number):
        drawn.append(model)
        return torch.rand(number, 2)

    monkeypatch.setattr(select_sites, "_renders", renders)
    monkeypatch.setattr(select_sites, "_embed", lambda: lambda images: images.double().numpy())
    held = select_sites.held_out(SimpleNamespace(record={"seed": 0}, model=None), None, torch.zeros(5, 2))
    guide = SimpleNamespace(net=torch.nn.Linear(2, 2), prior_sites=frozenset())
    guide.with_parameters = lambda model: (float(guide.net.weight.data.sum()), guide.prior_sites)
    sets = [frozenset(), frozenset("a"), frozenset(), frozenset("a")]
    looks = [held.looks(guide, passed) for passed in sets]
    assert [passed for _, passed in drawn] == sets[:2]
    assert all((looks[i] == looks[i + 2]).all() for i in (0, 1))
    guide.net.weight.data += 1
    held.looks(guide, frozenset())
    assert len(drawn) == 3 and drawn[2] != drawn[0]
