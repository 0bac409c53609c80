"""Charts for a page: matplotlib's SVG, inline, in the colours of the page's style sheet, for light and dark alike.

A colour here is a stand-in that becomes ``var(--name)``.
"""

import io
import math
from collections.abc import Sequence
from itertools import count
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from probscene.inference.statistics.count_metrics import Histogram

from ..evaluation.evaluate import Evaluation
from .tables import nested_counts

INK, FAINT = "#010203", "#010204"
SOURCES = {
    "prior": "#010205",
    "start": "#010209",
    "learnt": "#010206",
    "truth": "#010207",
    "estimate": "#010208",
    "read": "#01020a",
}
VARIABLES = {INK: "var(--ink)", FAINT: "var(--faint)"} | {c: f"var(--{name})" for name, c in SOURCES.items()}
SITE_COLOURS = {"prior": "prior", "learnt": "learnt", "target": "truth"}  # by what a site is read in
MAX_DENSITY = 6.0  # of a histogram over u, times the prior's density
MIN_SHARE = 1e-3  # that is a pixel high
WIDE, NARROW = (12.0, 3.0), (4.6, 2.5)  # inches
MAX_NARROW_BARS = 120  # of a chart; with more it is wide
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text, in the page's font
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
}


def numbers(evaluation: Evaluation) -> str:
    """The share of images by number of objects."""
    return _counts(
        {name: source.number() for name, source in evaluation.shown.items()},
        "objects in an image",
        "share of images",
        "number",
    )


def classes(evaluation: Evaluation) -> str:
    """The share of objects by class."""
    each = {name: source.classes() for name, source in evaluation.shown.items()}
    return _bars(each, list(evaluation.classes), "class", "share of objects", "class")


def nested(evaluation: Evaluation) -> list[str]:
    """Where kinds nest: images by the number of each class, then parents by the number of their children."""
    sources, charts = evaluation.shown, []
    if not sources["learnt"].nested:
        return charts
    for c, kind in enumerate(evaluation.classes):
        each = {name: source.kinds[c].histogram() for name, source in sources.items()}
        charts.append(_counts(each, f"{kind} per image", "share of images", kind))
    for what, tallies in nested_counts(sources, evaluation.classes).items():
        each = {name: found.histogram() for name, found in tallies.items()}
        if len(each) > 1:
            share = "share of images" if what.endswith("per image") else "share"
            charts.append(_counts(each, what, share, what))
    return charts


def site(name: str, read: dict[str, list[float]]) -> str:
    """What is read of a site in renders of the prior, in learnt ones and in the target: three histograms over u, 0 to
    1, of quantiles whose bins hold equal shares. A flat one is the prior's, were it read without error."""
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": f"site {name}", "font.size": 8}):
        figure, axes = _figure(2.6, 0.95)
        for row, (source, colour) in enumerate(SITE_COLOURS.items()):
            edges = np.asarray(read[source], float)
            width = np.maximum(np.diff(edges), 1e-3)
            height = np.minimum(1 / (len(width) * width), MAX_DENSITY) / MAX_DENSITY
            axes.bar(edges[:-1], 0.9 * height, width, len(SITE_COLOURS) - 1 - row, align="edge", color=SOURCES[colour])
        axes.set_xlim(0, 1)
        axes.set_ylim(0, len(SITE_COLOURS))
        axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.tick_params(length=0)
        return _svg(figure)


def curves(log: list[dict]) -> list[str]:
    """Learning curves, one chart each: the feature network's loss, and what each batch of structures was like."""
    features = [line for line in log if line["stage"] == "features"]
    structure = [line for line in log if line["stage"] == "structure"]
    charts = []
    if features:
        loss = _column(features, "loss")
        charts.append(_curve("Feature network: loss", "step", _column(features, "step"), loss, log=loss.min() > 0))
    if structure:
        batch = _column(structure, "batch")
        titles = {
            "cost": "Structure: mean cost, and its spread",
            "rejections": "Structure: rejected derivations a scene",
            "length": "Structure: rules a derivation",
        }
        for key, title in titles.items():
            spread = _column(structure, "cost_sd") if key == "cost" else None
            charts.append(_curve(title, "batch", batch, _column(structure, key), spread))
    return charts


def _counts(each: dict[str, Histogram], x: str, y: str, salt: str) -> str:
    """Shares by count, up to the last that can be seen."""
    bins = 1 + max(int(np.flatnonzero(found.share >= MIN_SHARE).max(initial=0)) for found in each.values())
    each = {name: Histogram(*(x[:bins] for x in found)) for name, found in each.items()}
    return _bars(each, range(bins), x, y, salt)


def _bars(each: dict[str, Histogram], bins: Sequence[int | str], x: str, y: str, salt: str) -> str:
    wide = len(each) * len(bins) > MAX_NARROW_BARS
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": salt, "axes.grid": True}):
        figure, axes = _figure(*(WIDE if wide else NARROW))
        width = 0.82 / len(each)
        for i, (name, found) in enumerate(each.items()):
            at = np.arange(len(found.share)) + (i - (len(each) - 1) / 2) * width
            axes.bar(at, found.share, width * 0.92, color=SOURCES[name])
            error = np.clip([found.share - found.low, found.high - found.share], 0, None)
            axes.errorbar(at, found.share, error, fmt="none", ecolor=INK, elinewidth=0.8)
        axes.set_xlim(-0.6, len(bins) - 0.4)
        axes.set_ylim(bottom=0)
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        axes.tick_params(length=0)
        figure.draw_without_rendering()  # which lays it out
        label_bins(axes, bins)
        return _chart(figure, wide)


def label_bins(axes: Axes, bins: Sequence[int | str]) -> None:
    """Label the bins at 0, 1, ... of an x axis so that no label touches another.

    Of counts, every first, second, fifth, tenth ... is labelled. Names stand upright where they have no room side by
    side; of more than have room even then, some are left out.

    Args:
        axes: of a figure that is laid out, with the limits that it keeps.
    """
    size = axes.get_xticklabels()[0].get_fontproperties().get_size_in_points()
    low, high = axes.get_xlim()
    room = axes.get_window_extent().width / axes.figure.dpi * 72 / (high - low)  # points for a bin
    widest = max(TextPath((0, 0), str(name), size=size).get_extents().width for name in bins) + size / 2
    upright = 0
    if all(isinstance(k, int) for k in bins):
        step = next(s * 10**power for power in count() for s in (1, 2, 5) if s * 10**power * room >= widest)
    elif widest <= room:
        step = 1
    else:
        step, upright = math.ceil(1.2 * size / room), 90
    axes.set_xticks(range(0, len(bins), step), [str(name) for name in bins[::step]], rotation=upright)


def _curve(
    title: str, x: str, at: np.ndarray, value: np.ndarray, spread: np.ndarray | None = None, log: bool = False
) -> str:
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": title, "axes.grid": True}):
        figure, axes = _figure(*NARROW)
        if spread is not None:
            axes.fill_between(at, value - spread, value + spread, color=SOURCES["learnt"], alpha=0.15, linewidth=0)
        axes.plot(at, value, color=SOURCES["learnt"], linewidth=1.6)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(10, (1, 2, 5) if value.max() < 100 * value.min() else (1,)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())
        elif value.min() >= 0 and spread is None:
            axes.set_ylim(0, 1.05 * value.max() or 1.0)
        axes.set_title(title)
        axes.set_xlabel(x)
        axes.tick_params(length=0)
        return _chart(figure)


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure((width, height), layout="constrained")
    return figure, figure.add_subplot()


def _chart(figure: Figure, wide: bool = False) -> str:
    return f'<div class="chart{" wide scroll" * wide}">{_svg(figure)}</div>'


def _svg(figure: Figure) -> str:
    out = io.StringIO()
    figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    for stand_in, variable in VARIABLES.items():
        text = text.replace(stand_in, variable)
    return text


def _column(lines: list[dict], key: str) -> np.ndarray:
    return np.array([line[key] for line in lines], float)
