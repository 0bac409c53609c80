"""Which sites of a program can be learnt."""

import torch

from probscene.inference.parameters.sites import Site, find_sites, quantiles_of
from probscene.sampling import sample


def test_every_site_says_whether_it_can_be_learnt(trays):
    balls = ("red", "blue")
    found = {site.name: site for site in find_sites(trays)}
    assert list(found) == list(sample(trays, trays.prior, 3).parameters)
    assert found["scene.bright"] == Site("scene.bright", ()) and found["scene.bright"].of_scene
    assert found["tray.x"] == Site("tray.x", ("tray",))
    assert found["ball.shade"] == Site("ball.shade", balls)
    assert found["tray.wood"].keeps == "it is discrete"
    assert found["ball.fixed"].keeps == "the program says so"
    assert found["ball.odd"].keeps == "Beta has no inverse CDF"
    assert found["decoration.x"].keeps == "it belongs to no node of the scene"
    assert found["floor.turn"].keeps == "it belongs to no node that has a class"


def test_under_the_prior_quantiles_are_uniform_whatever_the_unit(trays):
    torch.manual_seed(0)
    found = quantiles_of(trays, sample(trays, trays.prior, 800))
    for name in ("scene.bright", "tray.x", "ball.shade"):
        u = found[name][~found[name].isnan()]
        assert len(u) > 500 and abs(float(u.mean()) - 0.5) < 0.03 and abs(float(u.var()) - 1 / 12) < 0.01, name


def test_quantiles_are_nan_where_a_node_has_no_such_site(trays):
    scenes = sample(trays, trays.prior, 50)
    found = quantiles_of(trays, scenes)
    tray = scenes.derivation.kind == trays.grammar.kind("tray")
    assert torch.equal(~found["tray.x"].isnan(), tray[:, : found["tray.x"].shape[1]])


def test_a_photos_sites_are_the_scenes_own(smeared):
    found = {site.name: site for site in find_sites(smeared)}
    assert set(found) == {"photo.exposure", "photo.blur", "photo.noise", "photo.seed", "disc.x"}
    for name in ("photo.exposure", "photo.blur", "photo.noise"):
        assert found[name] == Site(name, ()) and found[name].of_scene
    assert found["photo.seed"].keeps == "the program says so"
    u = quantiles_of(smeared, sample(smeared, smeared.prior, 400))["photo.blur"]
    assert u.shape == (400, 1) and abs(float(u.mean()) - 0.5) < 0.05
