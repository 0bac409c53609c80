"""Datasets, checks and fits of a model with a generator."""

import json
import re
import shutil
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from probscene.app.api.fit import fit
from probscene.app.checking.generator_check import check_generator, cost
from probscene.app.datasets.generate import DatasetOptions, generate, generate_scenes
from probscene.app.datasets.provenance import remake
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import PRESETS, images_drawn, preset
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.errors import DataError, GeneratorError, ModelError, ProbsceneError, RunError
from probscene.generator import Command
from probscene.renderers.generator.pool import pool_for
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.sampling import sample

HERE = Path(__file__).parent
GUIDE = {"hidden": 8}


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def copied(tmp_path):
    """The model and its program in a folder of their own, where they can be changed."""
    for name in ("boxes.py", "draw_boxes.py"):
        shutil.copy(HERE / name, tmp_path / name)
    return tmp_path / "boxes.py"


@pytest.fixture
def run(copied, tmp_path):
    model = load_model(str(copied))
    run = RunFolder.create(tmp_path / "run", str(copied), {"guide": GUIDE})
    torch.manual_seed(0)
    run.write_tensors("guide", run.new_guide().state_dict())
    assert model.name == "boxes"
    return run


def test_datasets_are_the_same_by_any_number_of_processes(run, tmp_path, fault, fresh, ready_workers):
    generate(run, 140, tmp_path / "one", seed=3, format=("coco", "kitti"))
    fresh()
    fault("crash")
    generate(run, 140, tmp_path / "three", seed=3, format=("coco", "kitti"), workers=3)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")


def test_what_the_generator_does_not_know_is_not_in_the_labels(model, tmp_path, fault, fresh):
    generate_scenes(model, model.prior, 20, tmp_path / "plain", format=("coco", "kitti"))
    fresh()
    fault("boxes")
    generate_scenes(model, model.prior, 20, tmp_path / "boxes", format=("coco", "kitti"))
    plain, boxed = (
        json.loads((tmp_path / name / "annotations.json").read_text())["annotations"] for name in ("plain", "boxes")
    )
    assert plain and not any(key in one for one in plain for key in ("visible_fraction", "amodal_bbox"))
    assert all("amodal_bbox" in one and "visible_fraction" not in one for one in boxed)
    assert [one["bbox"] for one in plain] == [one["bbox"] for one in boxed]
    for one in boxed:  # which ends between pixels, and holds all that it touches
        (x, y, w, h), (X, Y, W, H) = one["bbox"], one["amodal_bbox"]
        assert X < x and Y < y and X + W > x + w and Y + H > y + h
    for name in ("plain", "boxes"):
        files = sorted((tmp_path / name).rglob("label_2/*"))
        lines = [line.split() for file in files for line in file.read_text().splitlines()]
        assert len(lines) == len(plain) and all(line[2] == "3" for line in lines)
        assert all(line[1] == "-1" if name == "plain" else 0 <= float(line[1]) <= 1 for line in lines)
    with pytest.raises(ProbsceneError, match="no min_visible with model 'boxes'"):
        generate_scenes(model, model.prior, 20, tmp_path / "least", options=DatasetOptions(min_visible=0.25))


def test_a_dataset_in_memory_leaves_them_out_too(model):
    _, target = next(iter(SceneDataset(model, num=4)))
    assert "boxes" in target and not {"visible", "amodal_boxes"} & set(target)


def test_an_image_is_made_again_from_its_line(run, tmp_path):
    generate(run, 5, tmp_path / "out", seed=1)
    for i, line in enumerate((tmp_path / "out" / "provenance.jsonl").read_text().splitlines()):
        image, _ = remake(run.model, json.loads(line))
        file = cv2.imread(str(tmp_path / "out" / "images" / f"{i:06d}.png"))
        assert np.array_equal(image.permute(1, 2, 0).numpy()[..., ::-1], file)


def test_a_run_is_bound_to_the_files_of_its_generator(run, copied):
    assert RunFolder.at(run.path).model.name == "boxes"
    script = copied.with_name("draw_boxes.py")
    script.write_text(script.read_text() + "# changed\n")
    with pytest.raises(RunError, match="to draw with generator draw_boxes.py, .*, as when the run .* was begun"):
        _ = RunFolder.at(run.path).model


def test_the_fingerprint_goes_by_bytes_words_and_version(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for folder in ("a", "b"):
        (tmp_path / folder / "draw.py").write_text("serve(render)")
        (tmp_path / folder / "cup.obj").write_text("v 0 0 0")

    def of(folder, *words, **more):
        return Command([sys.executable, tmp_path / folder / "draw.py", *words], **more).fingerprint()

    assert of("a") == of("b") and of("a").startswith("generator draw.py, ")
    mesh = (tmp_path / "a" / "cup.obj",)
    others = [of("a", "--fast"), of("a", version="2"), of("a", files=mesh)]
    assert len({of("a"), *others}) == 4
    (tmp_path / "a" / "cup.obj").write_text("v 1 0 0")
    assert of("a", files=mesh) != others[-1]
    with pytest.raises(ProbsceneError, match="expected to read .*gone.obj, of which the generator draw.py is made"):
        of("a", files=(tmp_path / "gone.obj",))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"argv": "python draw.py"}, "argv of a Command as a list of words"),
        ({"argv": []}, "argv of a Command as a list"),
        ({"timeout": 0}, "timeout of a Command above 0"),
        ({"attempts": 0}, "attempts of a Command above 0"),
        ({"workers": -1}, "workers of a Command above 0"),
    ],
)
def test_a_command_is_checked(settings, said):
    with pytest.raises(ModelError, match=said):
        Command(**({"argv": ["draw"]} | settings))


def test_the_check_draws_again_in_another_order(model, call):
    report = check_generator(model, images_drawn())
    assert report.differs == () and not report.fault and report.seconds > 0
    told = call("check", HERE / "boxes.py", "--render")
    assert told.code == 0 and "by fresh processes and in another order: the same bytes" in told.out
    drawn = []

    def counting(scene):
        drawn.append(scene)
        return {"image": np.full((32, 40, 3), len(drawn), np.uint8), "instance": np.zeros((32, 40), int)}

    assert "another image" in check_generator(replace(model, generator=counting), images_drawn()).fault
    with pytest.raises(ModelError, match="expected a model with a generator, got 'multi_mnist'"):
        check_generator(load_model("multi_mnist"), images_drawn())
    assert all(f"{name} " in str(report) for name in PRESETS)
    command = replace(model.generator, files=(HERE / "none.png",))
    with pytest.raises(DataError, match="none.png.*take it out of files="):
        check_generator(replace(model, generator=command), images_drawn())


def test_the_page_says_what_a_fit_has_drawn():
    page = (HERE.parents[2] / "docs" / "how_to" / "generators.md").read_text(encoding="utf-8")
    quick = preset("quick")
    for chosen in (quick, quick.set("parameters=none"), quick.for_photographs()):
        features, training = chosen.make_features().images, chosen.structure
        structure = training.batches * training.num_scenes * training.draws_per_structure
        row = re.search(rf"\| {features:,} \| {structure:,} \|([^|]*)\|([^|]*)\|", page[page.index(_called(chosen)) :])
        assert row is not None
        rest = sum(int(number.replace(",", "")) for number in row.groups() if number.strip())
        assert features + structure + rest == chosen.images


def _called(chosen):
    if chosen.parameters is None:
        return "the same, `--learn structure`"
    renders = chosen.make_features().name == "count"
    return "`--preset quick`" if renders else "`--preset quick --features count=efficientnet`"


def test_a_generator_may_say_that_it_is_not_reproducible(copied, model, tmp_path):
    script = copied.with_name("draw_boxes.py")
    script.write_text(script.read_text().replace("random.Random(scene.seed)", "random.Random()"))
    command = Command([sys.executable, str(script)])
    assert "another image" in check_generator(replace(model, generator=command), images_drawn()).fault
    kept = replace(command, keep=tmp_path / "kept")
    GeneratedRenderer(kept, model.canvas)(sample(model, model.prior, 2).drawing)
    assert (
        "another image" in check_generator(replace(model, generator=kept), images_drawn()).fault
    )  # not those that are kept
    open_ = check_generator(replace(model, generator=replace(command, reproducible=False)), images_drawn())
    assert not open_.fault and "no image can be made again" in str(open_)


def test_hours_are_told_before_a_fit(model, monkeypatch):
    measured = "probscene.app.checking.generator_check._drawn"
    monkeypatch.setattr(measured, lambda *args: (0.001, []))
    assert not cost(model, preset("quick").images)
    monkeypatch.setattr(measured, lambda *args: (1.2, []))
    told = cost(replace(model, generator=replace(model.generator, workers=2)), preset("quick").images)
    assert "needs" in told and " h (1.2e+03 ms an image, 2 at once)" in told
    assert not cost(load_model("multi_mnist"), preset("quick").images)


def test_telling_the_hours_leaves_the_workers_at_work(model):
    GeneratedRenderer(model.generator, model.canvas)(sample(model, model.prior, 4).drawing)
    before = pool_for(model.generator, 1).processes()
    cost(model, preset("quick").images)
    assert before and set(before) <= set(pool_for(model.generator, 1).processes())


def test_a_fit_looks_at_what_the_generator_draws(copied, tmp_path):
    model = load_model(str(copied))
    generate_scenes(model, model.prior, 60, tmp_path / "target", format="images")
    settings = {
        "features.schedule.steps": 20,
        "features.schedule.images": 8,
        "features.width": "8,16,32",
        "structure.batches": 2,
        "structure.num_scenes": 30,
    }
    settings |= {"pretrain.derivations": 200, "structure.draws_per_structure": 1}
    config = preset("quick").set("features=count", "parameters=none", settings)
    execution = Execution(1, cache=False, progress=False)
    run = fit(str(copied), tmp_path / "target" / "images", config, out=tmp_path / "run", execution=execution)
    assert run.record["assets"].startswith("generator draw_boxes.py, ")
    run.generate(10, tmp_path / "out")
    assert len(list((tmp_path / "out" / "images").iterdir())) == 10


def test_a_fit_whose_generator_fails_says_so_and_leaves_nothing(copied, tmp_path, fault, fresh):
    model = load_model(str(copied))
    generate_scenes(model, model.prior, 10, tmp_path / "target", format="images")
    fresh()
    fault("always")
    with pytest.raises((GeneratorError, ModelError), match="never any mesh"):
        fit(
            str(copied),
            tmp_path / "target" / "images",
            "quick",
            out=tmp_path / "run",
            execution=Execution(progress=False),
        )
    assert not (tmp_path / "run").exists()


def test_what_a_program_printed_stands_below_the_message_line_by_line(copied, call, tmp_path):
    script = copied.with_name("draw_boxes.py")
    script.write_text("import sys\n\nprint('no licence:', 3, 'seats')\nsys.exit('ask Ann')\n")
    told = call("preview", copied, "--num", 1, "--out", tmp_path / "prior.png")
    message, *printed = told.err.strip().splitlines()
    assert told.code == 2 and message.startswith("probscene: expected the generator draw_boxes.py to draw the scene")
    assert printed[0] == "The end of what it printed:" and set(printed[1:]) == {"no licence: 3 seats", "ask Ann"}


def test_the_tutorial_on_generators_is_a_model_and_its_program(tmp_path, call):
    page = (HERE.parents[2] / "docs" / "tutorials" / "own_generator.md").read_text(encoding="utf-8")
    for name, code in re.findall(r"^```python (\S+)\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        (tmp_path / name).write_text(code)
    told = call("check", tmp_path / "harbour.py", "--render")
    assert told.code == 0 and "Nothing to fix" in told.out and "the same bytes" in told.out


def test_the_page_on_generators_has_programs_that_compile():
    page = (HERE.parents[2] / "docs" / "how_to" / "generators.md").read_text(encoding="utf-8")
    programs = re.findall(r"(?:^    .*\n|^\n)+", page, re.MULTILINE)
    programs = [block for block in programs if "probscene_worker" in block]  # written for programs that are not here
    assert len(programs) == 3
    for block in programs:
        compile(textwrap.dedent(block), "page", "exec")
        assert len(block.strip().splitlines()) < 60
