"""Tables and axes that a person reads: a row a count, none twice, and labels that never touch."""

import io
import json
import re
from itertools import pairwise
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import ImageFont
from rich.console import Console

from probscene.app.evaluation.compare import Comparison
from probscene.app.evaluation.evaluate import Evaluation
from probscene.app.evaluation.sources import Source
from probscene.app.evaluation.structure_counts import group_label
from probscene.app.pictures import LINE, side_by_side
from probscene.app.trial import pictures
from probscene.app.trial.results import MEAN, Results
from probscene.app.views import charts, comparison, tables
from probscene.relations import PerParent

NAMES = ("prior", "learnt", "truth")

RUN = SimpleNamespace(unread=(), readings={}, outcome={})


def streets(seed: int, num: int = 80) -> Source:
    """Scenes with one street of one or two lanes, and up to three cars on each lane."""
    rng = np.random.default_rng(seed)
    lanes = rng.integers(1, 3, num)
    scene = np.repeat(np.arange(num), lanes)
    rank = np.concatenate([np.arange(n) for n in lanes])
    cars = rng.integers(0, 4, len(scene))
    one = np.zeros(num, int)
    children = {
        ("street", "lane"): PerParent(*map(torch.as_tensor, (np.arange(num), one, lanes))),
        ("street", "tree"): PerParent(*map(torch.as_tensor, (np.arange(num), one, rng.integers(0, 30, num)))),
        ("lane", "car"): PerParent(*map(torch.as_tensor, (scene, rank, cars))),
    }
    counts = np.stack([np.bincount(scene, cars, num).astype(int), rng.integers(0, 30, num)], 1)
    return Source.from_counts(counts, children, seed)


@pytest.fixture(scope="module")
def found() -> Evaluation:
    sources = {name: streets(i) for i, name in enumerate(NAMES)}
    return Evaluation(RUN, "images", ("car", "tree"), sources)


def printed(found: Evaluation, width: int = 80) -> str:
    out = io.StringIO()
    tables.show(found, Console(file=out, width=width, highlight=False))
    return out.getvalue()


def cells(text: str) -> dict[str, list[str]]:
    """The rows of all tables by their first cell; one that is there twice fails."""
    rows: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("│"):
            first, *rest = (cell.strip() for cell in line.strip("│").split("│"))
            assert first not in rows or rows[first] == [], first
            rows[first] = rest
    return rows


def test_there_is_a_row_of_distances_and_means_for_every_class(found):
    table = printed(found, 120).split("Images by number")[0]
    rows, measured = cells(table), found.distances()["truth"]
    assert set(rows) == {"all objects", "car", "tree", "class shares"}
    for c, name in enumerate(found.classes):
        kinds = [measured[a]["kinds"][name] for a in ("prior", "learnt")]
        expected = [f"{one[key]['value']:.3f}" for key in ("total_variation", "wasserstein") for one in kinds]
        assert rows[name] == expected + [f"{found.sources[a].counts[:, c].mean():.2f}" for a in NAMES]
    total = [f"{measured[a][key]:.3f}" for key in ("number", "number_wasserstein") for a in ("prior", "learnt")]
    assert rows["all objects"][:4] == total
    assert rows["class shares"][:2] == [f"{measured[a]['classes']:.3f}" for a in ("prior", "learnt")]


def test_what_depends_on_context_is_one_table_that_says_nothing_twice(found):
    (table,) = tables.nested(found)
    (words, *rest) = (list(column.cells) for column in table.columns)
    assert words == [
        "street per image", "lane per street", "tree per street", "car per lane", "car per first lane",
        "car per second lane",
    ]  # fmt: skip
    children = found.distance("learnt", "truth")["children"]
    for relation, group in ((("street", "lane"), "all"), (("lane", "car"), "first"), (("lane", "car"), "second")):
        row = [column[words.index(group_label(relation, group))] for column in rest]
        figures = children[f"{relation[1]} per {relation[0]}"][group]
        assert row[1] == f"{figures['total_variation']['value']:.3f}"
        assert row[3] == f"{figures['wasserstein']['value']:.3f}"
        assert row[6] == f"{found.sources['truth'].nested[relation][group].mean().value:.2f}"


def test_what_is_left_out_is_what_another_row_says(found):
    kept = tables.nested_counts(found.sources, found.classes)
    for relation, groups in found.sources["learnt"].nested.items():
        for group, tally in groups.items():
            if not tally.empty and group_label(relation, group) not in kept:
                assert any(np.array_equal(tally.total, other["learnt"].total) for other in kept.values())


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_no_figure_is_cut_off_and_no_row_is_there_twice(found, width):
    text = printed(found, width)
    assert "…" not in text
    if width >= 120:
        for part in re.split(r"\n\n", text):
            cells(part)


def test_a_long_histogram_has_few_rows_that_hold_every_image(found):
    rows = cells(printed(found).split("Images by number")[1].split("Objects by class")[0])
    rows.pop("mean")
    shares = np.array([[float(cell.split(" ")[0]) for cell in row] for row in rows.values()])
    assert len(rows) <= 15 and np.allclose(shares.sum(0), 100, atol=0.05 * len(rows))
    assert any(" to " in words for words in rows)


def test_figures_for_json_do_not_depend_on_what_is_shown(found):
    before = json.dumps(found.distances())
    printed(found)
    assert json.dumps(found.distances()) == before


def labels_apart(axes) -> None:
    axes.get_figure(root=True).draw_without_rendering()
    boxes = [text.get_window_extent() for text in axes.get_xticklabels() if text.get_text()]
    assert boxes and all(one.x1 <= other.x0 for one, other in pairwise(boxes))


bins = st.integers(1, 400).map(range) | st.lists(st.text("abwmi", min_size=1, max_size=10), min_size=1, max_size=60)


@settings(max_examples=20)
@given(bins, st.sampled_from([charts.WIDE, charts.NARROW, (2.6, 2.6)]), st.sampled_from([7.5, 10, 14]))
def test_labels_of_bins_never_touch_and_are_those_of_their_bins(bins, size, points):
    with matplotlib.rc_context({"xtick.labelsize": points}):
        figure = Figure(size, layout="constrained")
        axes = figure.add_subplot()
        axes.set_xlim(-0.6, len(bins) - 0.4)
        figure.draw_without_rendering()
        charts.label_bins(axes, bins)
        labels_apart(axes)
    at = axes.get_xticks().astype(int)
    assert [text.get_text() for text in axes.get_xticklabels()] == [str(bins[k]) for k in at]
    assert at[0] == 0 and len(set(np.diff(at))) <= 1


def test_a_comparisons_labels_never_touch():
    classes = ("car", "pedestrian", "cyclist", "traffic sign", "vegetation", "building", "pole")
    rng = np.random.default_rng(0)
    sources = {n: Source.from_counts(rng.poisson(9, (60, len(classes)))) for n in ("prior", "one", "two", "truth")}
    run = RUN
    figure = comparison.picture(Comparison(run, "images", classes, sources, runs={"one": run, "two": run}))
    for axes in figure.axes:
        labels_apart(axes)
    assert [text.get_text() for text in figure.axes[-1].get_xticklabels()] == list(classes)


def inside(figure) -> None:
    """No text of a figure is cut off."""
    figure.draw_without_rendering()
    width, height = figure.bbox.width, figure.bbox.height
    found = figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible() and artist.get_text())
    for text in found:
        box = text.get_window_extent()
        assert box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1, text.get_text()


@pytest.mark.parametrize("classes", [("car",), ("car", "a class with a rather long name", "c", "d", "e", "f", "g")])
@pytest.mark.parametrize(
    "rows", [("real",), ("real 20", "prior, with a name that takes more than one line"), "abcdefg"]
)
def test_nothing_of_a_trials_picture_is_cut_off(classes, rows):
    columns = tuple((name, "AP50") for name in (*classes, MEAN))
    samples = {(row, column): np.zeros(4) for row in rows for column in columns}
    by_seed = {key: np.zeros(1) for key in samples}
    counts = {"test_images": 2, "seeds": 1, "resamples": 3}
    found = Results(tuple(rows), columns, samples, by_seed, {rows[0]: 20}, (), {}, counts, "")
    figure = pictures.picture(found)
    inside(figure)
    titles = [axes.title.get_window_extent() for axes in figure.axes]
    assert all(one.x1 <= other.x0 for one, other in pairwise(titles))
    assert "2 test images, 1 seed;" in " ".join(figure.get_supxlabel().split())
    assert all(0 <= axes.get_xlim()[0] and axes.get_xlim()[1] <= 100 for axes in figure.axes)


def test_nothing_of_a_comparison_is_cut_off():
    names = ("prior", "a_run_with_a_name_longer_than_its_column", "truth")
    sources = {name: streets(i) for i, name in enumerate(names)}
    run = RUN
    inside(comparison.picture(Comparison(run, "images", ("car", "tree"), sources, runs={names[1]: run})))


def test_captions_of_grids_side_by_side_do_not_touch():
    tiny = np.zeros((8, 8, 3), np.uint8)
    caption = "a caption wider than its grid"
    room = ImageFont.load_default(20).getlength(caption)
    sheet = side_by_side({caption: [tiny], "other": [tiny]})
    (starts,) = np.nonzero((sheet[40] == LINE).all(1) & ~(np.roll(sheet[40], 1, 0) == LINE).all(1))
    assert len(starts) == 2 and starts[1] - starts[0] >= room
