"""The report: one page that needs nothing else, says what the run holds, and stands where the target is gone."""

import base64
import copy
import html
import io
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
from PIL import Image

from probscene.app.evaluation.labels import TargetLabels
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.app.progress import Display
from probscene.app.views import charts
from probscene.app.views.report import _sites, _sources, report, site_values
from probscene.errors import DataError, RunError
from probscene.model import SceneModel

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Checks that elements close in order; collects references, text, and the text that is not folded.

    ``tables`` has the class of the element that each table stands in.
    """

    def __init__(self, text: str):
        super().__init__()
        self.open, self.references, self.text, self.visible, self.tables = [], [], "", "", []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        if tag == "table":
            self.tables.append(self.parent)
        self.parent = dict(attributes).get("class", "")
        if tag not in VOID:
            self.open.append(tag)
        self.references += [value for key, value in attributes if key in ("src", "href", "xlink:href")]

    def handle_startendtag(self, tag, attributes):
        self.references += [value for key, value in attributes if key in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if "details" not in self.open and "style" not in self.open:
            self.visible += data


@pytest.fixture(scope="module")
def text(call, fitted, target) -> str:
    done = call("report", fitted, "--labels", target.labels, "--num", 300, "--scenes", 0)
    assert done.code == 0 and done.out.startswith(f"The report is {fitted / 'report.html'}\n")
    return (fitted / "report.html").read_text(encoding="utf-8")


def test_the_page_needs_nothing_else(text):
    page = Page(text)
    outside = [x for x in page.references if not x.startswith(("data:image/png;base64,", "#"))]
    assert not outside and "@import" not in text and "<script" not in text
    assert not re.findall(r"url\((?!#)", text)
    identifiers = re.findall(r'\bid="([^"]+)"', text)
    assert {x[1:] for x in page.references if x[0] == "#"} <= set(identifiers)


def test_the_page_shows_target_prior_and_learnt(text):
    pictures = re.findall(r'<img alt="([^"]+)" src="data:image/png;base64,([^"]+)"', text)
    assert [caption.split(":")[0] for caption, _ in pictures][:3] == ["Prior", "Learnt", "Target"]
    for _, data in pictures[:3]:
        with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as picture:
            assert picture.size == (3 * 66 + 2, 3 * 66 + 2)
            assert len(picture.convert("RGB").getcolors(1 << 16)) > 10


def test_images_come_first_then_the_verdict_then_histograms_and_the_rest_is_folded(text):
    visible = re.findall(r"<h2>(.*?)</h2>", text.split("<details>")[0])
    assert visible == ["Images", "Verdict", "Histograms", "Details"]
    titles = re.findall(r"<details><summary>(.*?)</summary>", text)
    assert text.count("<details") == len(titles) and "<details open" not in text  # none is open
    last = "Sites: where things stand and how they look", "Learning curves", "Grammar", "Times", "Configuration"
    assert titles[-7:] == ["Distances", "Objects by size", *last]
    page = Page(text)
    assert "There is no verdict" in page.visible and "truth (labels)" in page.visible
    assert not any(words in page.visible for words in ("structure.batches", "mean cost", "Parameters were not learnt"))


def test_tables_scroll_and_break_no_word(text):
    tables = Page(text).tables
    assert tables and all(parent.split()[0] == "scroll" for parent in tables)
    style = text[text.index("<style>") : text.index("</style>")]
    assert re.search(r"\.scroll \{[^}]*overflow-x: auto", style) and re.search(r"th, td \{[^}]*nowrap", style)
    assert not re.search(r"word-break|overflow-wrap: anywhere|hyphens", style)


def test_the_page_shows_figures_curves_grammar_time_and_configuration(text, fitted):
    run = RunFolder.at(fitted)
    words = Page(text).text
    assert str(run.model.grammar) in words
    assert text.count("<svg") == 2 + 4
    for what in (
        "truth (labels)",
        "without labels",
        "loss",
        "mean cost",
        "rejected",
        "objects in an image",
        "Pretraining",
    ):
        assert what in words, what
    for key in ("seed", "threads", "version", "target", "config.features.schedule.steps", "config.structure.batches"):
        assert f"<td>{key}</td>" in text
    assert f"<td>{html.escape(run.record['target'])}</td>" in text and f"version {run.record['version']}" in words
    assert len(re.findall(r"<b>\d\.\d{3} → \d\.\d{3}</b>", text)) == 4


def with_sites(fitted, folder, kept="learnt") -> RunFolder:
    """A copy of a run with what is read of two sites, and with one that cannot be read."""
    shutil.copytree(fitted, folder)
    flat = [i / 20 for i in range(21)]
    read = {"prior": flat, "learnt": [0.4 + x / 5 for x in flat], "target": [0.5] * 21}
    read["distance"] = {"prior": 0.25, "learnt": 0.125, "floor": 0.02}
    site = {"kinds": ["red", "blue"], "learnt": True, "skill": 0.9, "because": "", "read": read}
    unread = {"kinds": ["red"], "learnt": False, "skill": None, "because": "it cannot be read in <renders>"}
    sites = [site | {"name": "x"}, site | {"name": "y"}, unread | {"name": "light"}]
    record = {"kept": kept, "sites": sites, "learnt": 0.5, "prior": 0.25}
    (folder / "parameters.json").write_text(json.dumps(record))
    return RunFolder.at(folder)


@pytest.mark.parametrize("kept", ["learnt", "prior"])
def test_the_page_shows_every_site_and_what_is_read_of_it(kept, fitted, tmp_path):
    run = with_sites(fitted, tmp_path / "run", kept)
    made = report(run, Display(), num=100, judged_by=0).read_text(encoding="utf-8")
    page = Page(made)
    section = page.text[page.text.index("Sites: where things stand") : page.text.index("Learning curves")]
    assert made.count('<div class="site"><svg') == 2
    for what in ("0.900", "0.250", "0.125", "0.020", "red, blue", "keeps the prior: it cannot be read in <renders>"):
        assert what in section, what
    assert ("All sites keep the prior" in section) is (kept == "prior")
    assert ("learnt, and not kept" in section) is (kept == "prior")


def lit(low: float, high: float, model) -> SceneModel:
    """A model whose scenes have a light from ``low`` to ``high``, beside discs of as many places as there are."""

    def program(num_scenes, structure):
        with pyro.plate("lights", num_scenes, dim=-2):
            pyro.sample("light", dist.Uniform(low, high).expand((num_scenes, 1)))
        return model.program(num_scenes, structure)

    return replace(model, program=program)


@pytest.mark.parametrize("learnt", [True, False])
def test_sites_have_quantiles_of_what_they_were_and_what_they_became(learnt, discs):
    model = lit(0.0, 10.0, load_model(str(discs.file)))
    guide = copy.copy(model.prior)
    guide.with_parameters = (lambda model: lit(4.0, 5.0, load_model(str(discs.file)))) if learnt else None
    about = {"learnt": False, "skill": None, "because": "it is not learnt"}
    sites = [about | {"name": "light", "kinds": [], "learnt": learnt, "because": ""}]
    sites += [about | {"name": "x", "kinds": ["red"]}, about | {"name": "y", "kinds": []}]
    run = SimpleNamespace(model=model, guide=guide, parameters={"kept": "learnt", "sites": sites})
    found = site_values(run)
    before, after, one = found["light"]
    assert before == pytest.approx([0.5, 5.0, 9.5], abs=0.5) and one and found.keys() == {"light", "x", "y"}
    assert found["x"].prior == pytest.approx(found["x"].learnt or found["x"].prior, rel=0.1) and not found["x"].one
    if learnt:
        assert after == pytest.approx([4.05, 4.5, 4.95], abs=0.05)
    table = Page(_sites(run)).text
    assert "the scene" in table and f"{before[1]:.3g}" in table and "skill" not in table
    assert ("learnt: 5%" in table) and ((after is not None) is learnt)


def test_the_page_of_a_run_without_parameters_says_so(fitted, tmp_path):
    shutil.copytree(fitted, tmp_path / "run")
    assert not (tmp_path / "run" / "parameters.json").exists()
    made = report(RunFolder.at(tmp_path / "run"), Display(), num=100, judged_by=0).read_text(encoding="utf-8")
    assert "Parameters were not learnt" in made


def test_the_page_shows_structure_alone_beside_all_that_was_learnt(fitted, tmp_path):
    shutil.copytree(fitted, tmp_path / "run")
    run = RunFolder.at(tmp_path / "run")
    run.guide.with_parameters = lambda model: model
    made = report(run, Display(), num=100, judged_by=0).read_text(encoding="utf-8")
    captions = [caption.split(":")[0] for caption in re.findall(r'<img alt="([^"]+)"', made)]
    assert captions[:4] == ["Prior", "Structure alone", "Learnt", "Target"]


def test_the_page_shows_the_initialisation_and_a_prior_that_was_kept(discs):
    model = load_model(str(discs.file))
    run = SimpleNamespace(model=replace(model, pretraining=model.target(0).prior), guide=copy.copy(model.prior))
    assert [name.split(":")[0] for name in _sources(run)] == ["Prior", "Initialisation", "Learnt"]
    run = SimpleNamespace(model=model, guide=model.prior)
    assert list(_sources(run)) == ["Prior: kept by this fit"]


def test_colours_are_the_pages_own(text):
    assert not any(stand_in in text for stand_in in charts.VARIABLES)
    used = set(re.findall(r"var\((--\w+)\)", text))
    assert len(used) > 8
    light, dark = text.split("@media (prefers-color-scheme: dark)")
    for name in used:
        assert f"{name}: #" in light and f"{name}: #" in dark.split("</style>")[0], name


def test_the_same_run_gives_the_same_page(text, call, fitted, target, tmp_path):
    call("report", fitted, "--labels", target.labels, "--num", 300, "--scenes", 0, "--out", tmp_path / "new" / "r.html")
    assert (tmp_path / "new" / "r.html").read_text(encoding="utf-8") == text


def test_names_are_escaped_and_a_target_that_is_gone_leaves_a_gap(fitted, target, tmp_path):
    folder = tmp_path / "<b>&amp;"
    shutil.copytree(fitted, folder)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"target": str(tmp_path / "<i>gone")}))
    path = report(RunFolder.at(folder), Display(), num=100, judged_by=0)
    page = Page(path.read_text(encoding="utf-8"))
    assert "<i>gone, which is not there" in page.text and "<b>&amp;" in page.text
    assert page.text.count("before learning") == 1 and "Target: some" not in page.text
    with pytest.raises(DataError, match="not there"):
        report(RunFolder.at(folder), Display(), labels=TargetLabels(target.labels), num=100, judged_by=0)


def test_a_run_without_log_and_times_has_a_report_and_an_unfinished_one_has_none(fitted, tmp_path):
    shutil.copytree(fitted, tmp_path / "run")
    for name in ("log.jsonl", "timing.json"):
        (tmp_path / "run" / name).unlink()
    text = report(RunFolder.at(tmp_path / "run"), Display(), num=100, judged_by=0).read_text(encoding="utf-8")
    assert "No times were recorded." in text and text.count("<svg") == 2
    (tmp_path / "run" / "report.html").unlink()
    (tmp_path / "run" / "guide.safetensors").unlink()
    with pytest.raises(RunError, match="finished"):
        report(RunFolder.at(tmp_path / "run"), Display())
    assert not (tmp_path / "run" / "report.html").exists()
