"""Which sites of a program can be learnt."""

from contextlib import nullcontext

import pyro
import pyro.distributions as dist
import torch

from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.inference.parameters.sites import (
    OPTED_OUT,
    Site,
    find_sites,
    occurs_once,
    of_scenes,
    quantiles_of,
    site_mask,
    site_name,
)
from probscene.model import scene_model
from probscene.sampling import sample
from probscene.scenarios import join
from probscene.structure import StructurePrior


def test_every_site_says_whether_it_can_be_learnt(trays):
    balls = ("red", "blue")
    found = {site.name: site for site in find_sites(trays)}
    assert list(found) == list(sample(trays, trays.prior, 3).parameters)
    assert found["scene.bright"] == Site("scene.bright", ()) and found["scene.bright"].of_scene
    assert found["tray.x"] == Site("tray.x", ("tray",))
    assert found["ball.shade"] == Site("ball.shade", balls)
    assert found["tray.wood"].keeps == "it is discrete"
    assert found["ball.fixed"].keeps == OPTED_OUT
    assert found["ball.odd"].keeps == "Beta has no inverse CDF"
    assert found["decoration.x"].keeps == "it belongs to no node of the scene"
    assert found["hidden.depth"].keeps == "it belongs to no node that has a class"
    assert found["ball.capped"].keeps == "its prior has a point mass"


def test_a_node_that_each_scene_has_one_of_is_the_scenes(trays):
    """Whatever the kind is called, and only if the grammar allows no other number."""
    found = {site.name: site for site in find_sites(trays)}
    assert found["floor.turn"] == Site("floor.turn", ()) and not found["floor.turn"].keeps
    grammar = Grammar("""
        Scene -> sky Light Extra
        Light -> sun | lamp
        Extra -> cat | ε
    """)
    assert occurs_once(grammar, ["sky"]) and occurs_once(grammar, ["sun", "lamp"])
    assert not any(occurs_once(grammar, kinds) for kinds in (["sun"], ["cat"], ["sky", "cat"], ["sky", "sun"]))


def test_sites_of_one_name_are_one_of_all_scenarios(rooms):
    found = {site.name: site for site in find_sites(rooms)}
    programs = [*sample(rooms, rooms.prior, 20).parameters]
    assert set(found) == {site_name(rooms.grammar, name) for name in programs}
    assert found["ball.away"] == Site("ball.away", ("red", "blue")) and found["tray.x"] == Site("tray.x", ("tray",))
    assert found["scene.bright"] == Site("scene.bright", ()) and found["floor.turn"] == Site("floor.turn", ())
    assert found["ball.fixed"].keeps == OPTED_OUT
    assert found["lamp.height"].keeps == "scenario 'trays' does not have it"
    assert [name for name in found if name.startswith("ball")] == [
        f"ball.{x}" for x in ("away", "size", "shade", "fixed", "odd", "capped")
    ]


def test_scenarios_whose_sites_do_not_go_together_keep_their_prior():
    grammar = Grammar("Scene -> ball ball")

    def scenario(*sites, nodes=True):
        def draw(scene):
            for name in sites:
                with scene.nodes("ball") if nodes else nullcontext():
                    pyro.sample(name, dist.Uniform(0.0, 1.0))
            return scene.draw(Sprites.disc("ball", 8.0, 8.0, radius=2.0))

        prior = StructurePrior(grammar)
        return scene_model(grammar, prior, canvas=(16, 16), max_steps=4, classes=("ball",), name="one")(draw)

    turned = find_sites(join("turned", {"a": scenario("x", "y", "z"), "b": scenario("x", "z", "y")}))
    assert [site.name for site in turned if not site.keeps] == ["x", "z"]
    assert turned[1] == Site("y", ("ball",), "scenarios sample it in different orders")
    for_scene = find_sites(join("other", {"a": scenario("x"), "b": scenario("x", nodes=False)}))
    assert for_scene[0].keeps == "it belongs to nodes in one scenario and to the scene in another"
    lacking = find_sites(join("lacking", {"a": scenario("x", "y"), "b": scenario("x")}))
    assert [site.keeps for site in lacking] == ["", "scenario 'b' does not have it"]
    nested = find_sites(join("nested", {"c": join("inner", {"a": scenario("x")}), "b": scenario("x")}))
    assert (
        nested == (Site("x", ("ball",)),)
        and site_name(join("n", {"c": join("i", {"a": scenario("x")})}).grammar, "c/a/x") == "x"
    )


def test_under_the_prior_quantiles_are_uniform_whatever_the_unit(model):
    torch.manual_seed(0)
    found = quantiles_of(model, sample(model, model.prior, 1200))
    for name in ("scene.bright", "tray.x", "ball.shade", "floor.turn"):
        u = found[name][~found[name].isnan()]
        assert len(u) > 500 and abs(float(u.mean()) - 0.5) < 0.03 and abs(float(u.var()) - 1 / 12) < 0.01, name


def test_quantiles_are_nan_where_a_node_has_no_such_site(model):
    scenes = sample(model, model.prior, 50)
    found, kind = quantiles_of(model, scenes), scenes.derivation.trimmed().kind
    sites = tuple(site for site in find_sites(model) if site.kinds and not site.keeps)
    has = site_mask(model.grammar, sites, kind)
    for s, site in enumerate(sites):
        assert torch.equal(~found[site.name].isnan(), has[..., s]), site.name
    assert not of_scenes(found["floor.turn"]).isnan().any() and of_scenes(found["floor.turn"]).shape == (50, 1)
    assert of_scenes(torch.full((2, 3), torch.nan)).isnan().all()


def test_a_photos_sites_are_the_scenes_own(smeared):
    found = {site.name: site for site in find_sites(smeared)}
    assert set(found) == {"photo.exposure", "photo.blur", "photo.noise", "photo.seed", "disc.x"}
    for name in ("photo.exposure", "photo.blur", "photo.noise"):
        assert found[name] == Site(name, ()) and found[name].of_scene
    assert found["photo.seed"].keeps == OPTED_OUT
    u = quantiles_of(smeared, sample(smeared, smeared.prior, 400))["photo.blur"]
    assert u.shape == (400, 1) and abs(float(u.mean()) - 0.5) < 0.05
