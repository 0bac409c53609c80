"""Faults in a user's own code: one clear error each, with the user's line; a bug of probscene stays one."""

import inspect
import re
import sys
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.drawing import Atlas, Sprites, disc, resolve
from probscene.errors import GrammarError, ModelError
from probscene.grammar import Grammar
from probscene.model import SceneModel, SceneProgram, scene_model
from probscene.program_errors import MAX_MESSAGE_LENGTH, useful_text
from probscene.sampling import run_program, sample
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts, ranked, weights

GRAMMAR = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
PRIOR = StructurePrior(GRAMMAR, Discs=counts(0, 1, 1))
ABOUT = {"canvas": (64, 64), "max_steps": 9, "classes": ("disc",)}


def negative(scene):
    with scene.nodes("disc"):
        x = pyro.sample("x", dist.Normal(3.0, -1.0))  # here
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


def inverted(scene):
    with scene.nodes("disc"):
        x = pyro.sample("x", dist.Uniform(56.0, 8.0))  # here
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


def repeated(scene):
    with scene.nodes("disc"):
        pyro.sample("x", dist.Uniform(8.0, 56.0))
        y = pyro.sample("x", dist.Uniform(8.0, 56.0))  # here
    return scene.draw(Sprites.disc("disc", 3.0, y, 6.0))


def own_plate(scene):
    with pyro.plate("mine", 7, dim=-2):  # here
        x = pyro.sample("x", dist.Uniform(8.0, 56.0))
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


def wrong_shape(scene):
    with scene.nodes("disc"):
        x = pyro.sample("x", dist.Uniform(torch.zeros(3), 56.0))  # here
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


def mistyped(scene):
    x = scene.gap + 1  # here
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


def unfitting(scene):
    x = torch.ones(3) + torch.ones(4)  # here
    return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))


FAULTS = {
    negative: ("parameter scale .* GreaterThan", "but found -1.0;", "in range"),
    inverted: ("parameter low .* LessThan", "but found 56.0;", "low is below high"),
    repeated: ("Multiple sample sites named '(one/)?x'", "a name of its own"),
    own_plate: ('plates "mine" and "scenes", collide at dim=-2', "no plate of your own"),
    wrong_shape: ("Shape mismatch inside plate.'nodes'. at site (one/)?x dim -1", "broadcast to that"),
    mistyped: ("AttributeError", "no attribute 'gap'", "fix that line"),
    unfitting: ("RuntimeError", "size of tensor a .3. must match the size of tensor b .4.", "fix that line"),
}


def model_of(draw):
    return scene_model(GRAMMAR, PRIOR, **ABOUT)(draw)


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "a scenario"])
@pytest.mark.parametrize("draw", FAULTS, ids=lambda draw: draw.__name__)
def test_an_error_of_the_users_is_told_with_the_users_line(draw, joined):
    model = join("both", {"one": model_of(draw)}) if joined else model_of(draw)
    with pytest.raises(ModelError) as raised:
        sample(model, model.prior, 4)
    text = str(raised.value)
    lines, first = inspect.getsourcelines(draw)
    (at,) = [i for i, line in enumerate(lines) if line.endswith("# here\n")]
    assert f"test_program_errors.py, line {first + at}, '{lines[at].strip()}'" in text
    for part in FAULTS[draw]:
        assert re.search(part, text), text
    assert "\n" not in text and "Trace Shapes" not in text and raised.value.__cause__ is not None


def test_values_outside_the_support_name_their_site():
    def outside(scene):
        with scene.nodes("disc"):
            x = pyro.sample("x", dist.Uniform(8.0, 56.0), obs=torch.full(scene.kind.shape, 70.0))
        return scene.draw(Sprites.disc("disc", x, 3.0, 6.0))

    with pytest.raises(ModelError, match=r"site 'x' of model 'outside', .* within the support .* but found .*70"):
        sample(model_of(outside), PRIOR, 4)


def test_a_helper_of_the_users_is_told_by_the_programs_own_line(tmp_path, monkeypatch):
    """Where the program has no file of its own, by the user's last line, wherever that is."""
    (tmp_path / "my_helper.py").write_text("def place(scene):\n    return 1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    import my_helper

    def helped(scene):
        return my_helper.place(scene)

    with pytest.raises(ModelError, match=r"test_program_errors.py, line \d+, 'return my_helper.place\(scene\)'"):
        sample(model_of(helped), PRIOR, 4)
    joint = join("both", {"one": model_of(helped)})
    with pytest.raises(ModelError, match=r"my_helper.py, line 2, 'return 1 / 0': division by zero"):
        sample(joint, joint.prior, 4)
    del sys.modules["my_helper"]


def test_a_bug_of_probscene_stays_one(monkeypatch):
    """No line of the user's is in the traceback."""
    model = model_of(lambda scene: scene.draw())  # the name of a lambda is one
    derivation = sample(model, PRIOR, 3).derivation
    monkeypatch.setattr(SceneProgram, "__call__", lambda *args: 1 / 0, raising=True)
    monkeypatch.setitem(globals(), "__name__", "probscene.somewhere")
    with pytest.raises(ZeroDivisionError):
        run_program(model, derivation)


@given(st.text(max_size=1000))
def test_useful_text_is_one_short_line(text):
    told = useful_text(ValueError(f"{text}\nTrace Shapes:\n  x | 4 5"))
    assert told and len(told.splitlines()) == 1 and len(told) <= MAX_MESSAGE_LENGTH + 3 and "4 5" not in told


SPRITE = disc(8)
WRONG = {
    "a bare array": (
        lambda: Atlas(SPRITE),
        ModelError,
        r"got ndarray uint8 \(8, 8, 4\); write Atlas\(\(sprite,\)\)",
    ),
    "an array for an atlas": (
        lambda: Sprites("disc", SPRITE, 0, 1.0, 1.0),
        ModelError,
        r"an Atlas in Sprites\('disc'\), got ndarray .* write Atlas\(\(sprite,\)\)",
    ),
    "no array": (lambda: Atlas((SPRITE, "disc.png")), ModelError, "sprite 1 as a numpy array, .* got str"),
    "a list for numbers": (lambda: counts([1, 2]), GrammarError, r"got counts\(\[1, 2\]\); write counts\(1, 2\)"),
    "a word for numbers": (lambda: weights("ab"), GrammarError, r"numbers in weights\(...\), got weights\('ab'\)"),
    "a number for weights": (lambda: counts(1, 2, weights=3), GrammarError, r"got counts\(..., weights=3\)"),
    "a text for a grammar": (lambda: StructurePrior("Scene -> a"), GrammarError, r"got str; .*\(Grammar\(text\)"),
    "a list for counts": (
        lambda: StructurePrior(GRAMMAR, Discs=[1, 2]),
        GrammarError,
        r"got \[1, 2\]; .* Discs=counts",
    ),
    "a list in ranked": (lambda: StructurePrior(GRAMMAR, Discs=ranked([1, 2])), GrammarError, "write Discs=counts"),
    "three for a canvas": (
        lambda: replace(model_of(mistyped), canvas=(64, 64, 3)),
        ModelError,
        r"got canvas \(64, 64, 3\) .*=\(height, width\), .* without the channels",
    ),
    "words for a canvas": (lambda: replace(model_of(mistyped), canvas=("64", 64)), ModelError, "positive canvas"),
    "half a step": (lambda: replace(model_of(mistyped), max_steps=9.5), ModelError, "max_steps 9.5; .* whole number"),
    "a string for classes": (
        lambda: SceneModel("m", GRAMMAR, PRIOR, mistyped, (64, 64), 9, "disc"),
        ModelError,
        r"a tuple of names, got 'disc'; write classes=\('disc',\)",
    ),
    "a number for classes": (
        lambda: scene_model(GRAMMAR, PRIOR, canvas=(64, 64), max_steps=9, classes=3)(mistyped),
        ModelError,
        "a tuple of names, got 3",
    ),
    "a text for the model's grammar": (
        lambda: SceneModel("m", "Scene -> a", PRIOR, mistyped, (64, 64), 9, ("a",)),
        ModelError,
        "expected a Grammar in model 'm', got str",
    ),
    "a word for a place": (
        lambda: sample(model_of(lambda scene: scene.draw(Sprites.disc("disc", "left", 3.0, 6.0))), PRIOR, 3),
        ModelError,
        r"Sprites\('disc'\).x as a number or a tensor, got 'left'",
    ),
    "a word for the background": (
        lambda: sample(model_of(lambda scene: scene.draw(background="red")), PRIOR, 3),
        ModelError,
        "three numbers in 0..1, .* got 'red'",
    ),
    "a background of 0 to 255": (
        lambda: sample(model_of(lambda scene: scene.draw(background=(0.0, 90, 40))), PRIOR, 3),
        ModelError,
        r"^expected background in 0..1, got 90; divide by 255.$",
    ),
    "a background below black": (
        lambda: sample(model_of(lambda scene: scene.draw(background=(0.0, -5, 0.4))), PRIOR, 3),
        ModelError,
        "expected background in 0..1, got -5; .* clamp it",
    ),
    "a tint of 0 to 255": (
        lambda: sample(
            model_of(lambda scene: scene.draw(Sprites.disc("disc", 3.0, 3.0, 6.0, tint=(255, 0, 0)))), PRIOR, 3
        ),
        ModelError,
        r"^expected Sprites\('disc'\).tint in 0..1, got 255; divide by 255.$",
    ),
    "a tint beyond every scale": (
        lambda: sample(
            model_of(lambda scene: scene.draw(Sprites.disc("disc", 3.0, 3.0, 6.0, torch.full((3, 1, 3), 1300.0)))),
            PRIOR,
            3,
        ),
        ModelError,
        r"tint in 0..1, got 1300; .* clamp it",
    ),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_kind_of_value_is_one_clear_error(fault):
    make, error, message = WRONG[fault]
    with pytest.raises(error, match=message):
        make()


@given(st.floats(-0.5, 1.5), st.integers(0, 2**32))
def test_colours_about_0_to_1_pass(channel, seed):
    """A little beyond they are clipped, as distributions draw them; nodes that are not drawn may have any."""
    present = torch.rand(3, 4, generator=torch.Generator().manual_seed(seed)) < 0.5
    tint = torch.where(present[..., None], channel, 255.0)
    assert resolve(Sprites.disc("disc", 0.0, 0.0, 1.0, tint=tint), present).tint.shape == (3, 4, 3)


def test_right_values_of_other_types_pass():
    assert len(Atlas([SPRITE, np.zeros((2, 3, 4), np.uint8)])) == 2
    assert counts(np.float32(1), torch.tensor(2.0)).probs == (1.0, 2.0) and counts(1, weights=[1, 3]).weights == (1, 3)
    assert replace(model_of(mistyped), canvas=[np.int64(64), 32]).canvas == [64, 32]
