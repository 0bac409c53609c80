"""Worlds of several scenarios in one batch are rendered as each scenario's own model draws them."""

import pyro
import torch

from probscene.app.loading import load_model, renderer_for
from probscene.derivation import Derivation
from probscene.sampling import run_program, sample


def test_a_joint_batch_shows_what_each_scenarios_own_model_shows():
    """Other parameters' shapes, numbers of strips and meshes a scenario, and the same pixels and labels."""
    joint = load_model("driving")
    pyro.set_rng_seed(7)
    scenes = sample(joint, joint.prior, 6)
    batch, seen = renderer_for(joint, 1)(scenes.drawing), set()
    for i, number in enumerate(joint.grammar.scenario(scenes.derivation).tolist()):
        name, model = joint.scenarios[number]
        own = Derivation.from_rules(model.grammar, joint.grammar.own(scenes.derivation[i : i + 1], number).rules)
        M = own.kind.shape[1]
        sites = {site: value for site, value in scenes.parameters.items() if site.startswith(f"{name}/")}
        values = {site.split("/")[1]: value[i : i + 1, :M] for site, value in sites.items()}
        alone = renderer_for(model, 1)(run_program(model, own, values).drawing)
        # Torch's sines round by the length of their vector, so that a pixel at an edge may differ.
        assert (alone.instance[0] != batch.instance[i]).float().mean() < 1e-3
        assert (alone.image[0] != batch.image[i]).any(0).float().mean() < 2e-3
        assert torch.allclose(alone.amodal_box[0], batch.amodal_box[i, :M], atol=1e-2)
        assert (~torch.isclose(alone.space.depth[0], batch.space.depth[i], rtol=1e-4)).float().mean() < 1e-3
        mine = [model.grammar.kinds[k] for k in alone.kind[0].tolist() if k >= 0]
        assert mine == [joint.grammar.kinds[k] for k in batch.kind[i].tolist() if k >= 0]
        seen.add(name)
    assert len(seen) > 1
