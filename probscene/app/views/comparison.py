"""A comparison as one picture: a column for each source, a row for each kind of count, the reference as an outline."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from probscene.errors import DataError

from ..evaluation.compare import TRUTH, Comparison, Row
from ..evaluation.sources import ESTIMATE, PRIOR, START
from ..evaluation.structure_counts import ALL, OTHERS, group_label
from ..files import make_folder, write_whole
from ..style import LIGHT
from .charts import label_bins

COLOURS = {name: LIGHT[name] for name in (PRIOR, START, TRUTH, ESTIMATE)}
RUNS = (LIGHT["learnt"], "#b04f9e", "#0f8b8d", "#c9a227", "#8c564b", "#6b8e23")
INK, FAINT = LIGHT["ink"], LIGHT["faint"]
CLASSES = "class of an object"  # the row of ``Comparison.shares_of_classes``
MAX_CLASS_ROWS = 4  # more classes share one row
MIN_SHARE = 2e-3  # that is a pixel high
CELL_SIZE = (2.15, 1.25)  # inches


def make_folder_of(out: Path) -> None:
    """Make the folder that a picture is written to, before the work is done that it shows.

    Raises:
        DataError: ``out`` is a folder.
        MachineError: its folder cannot be made.
    """
    if out.is_dir():
        raise DataError(f"expected a file to write the picture to, got the folder {out}; name a file in it.")
    make_folder(out.parent)


def draw(comparison: Comparison, out: Path) -> None:
    """Write the picture, a PNG, whole or not at all.

    Raises:
        MachineError: it cannot be written.
    """
    figure = picture(comparison)
    write_whole(out, lambda temporary: figure.savefig(temporary, format="png", dpi=130, metadata={"Software": None}))


def picture(comparison: Comparison) -> Figure:
    """The figure: column heads are the sources' names, row heads say what is counted; every row has one scale."""
    names, rows = list(comparison.sources), picture_rows(comparison)
    figure = Figure(
        (1.5 + CELL_SIZE[0] * len(names), 0.7 + CELL_SIZE[1] * len(rows)), layout="constrained", facecolor="white"
    )
    grid = figure.subplots(len(rows), len(names), squeeze=False)
    run_colours = dict(zip(comparison.runs, (RUNS[i % len(RUNS)] for i in range(len(comparison.runs))), strict=True))
    labels: dict[Axes, Sequence[int | str]] = {}
    for i, row in enumerate(rows):
        bins = 1 + max(int(np.flatnonzero(share >= MIN_SHARE).max(initial=0)) for share in row.shares.values())
        highest = max(share.max() for share in row.shares.values())
        for j, name in enumerate(names):
            axes = grid[i, j]
            _cell(axes, row, name, comparison.reference, {**COLOURS, **run_colours}[name], bins, highest)
            labels[axes] = comparison.classes[:bins] if row.label == CLASSES else range(bins)
            if i == 0:
                axes.annotate(
                    textwrap.fill(_head(name), 22), (0.5, 1), (0, 18), "axes fraction", "offset points",
                    ha="center", va="bottom", fontsize=10, fontweight="bold", color=INK,
                )  # fmt: skip
        grid[i, 0].set_ylabel(
            textwrap.fill(row.label, 16), rotation=0, ha="right", va="center", fontsize=9, labelpad=8, color=INK
        )
    figure.draw_without_rendering()  # which lays it out
    for axes, names in labels.items():
        label_bins(axes, names)
    return figure


def picture_rows(comparison: Comparison) -> list[Row]:
    """The rows of the picture: parents by rank, not pooled, and only ranks that the reference has; where there are many
    classes, their shares alone."""
    pooled = {group_label(relation, g) for relation in comparison.sources[PRIOR].nested for g in (ALL, OTHERS)}
    reference, C = comparison.reference, len(comparison.classes)
    unique = {row.label: row for row in comparison.rows()}.values()  # how many parents there are, once
    rows = [row for row in unique if row.label not in pooled and (not reference or reference in row.shares)]
    return rows if C <= MAX_CLASS_ROWS else [rows[0], comparison.shares_of_classes(), *rows[1 + C :]]


def _head(name: str) -> str:
    return {ESTIMATE: "estimate, no labels", START: "initialisation"}.get(name, name)


def _cell(axes: Axes, row: Row, name: str, reference: str | None, colour: str, bins: int, highest: float) -> None:
    known = None if reference is None else row.shares.get(reference)
    if name in row.shares:
        share = row.shares[name][:bins]
        axes.bar(np.arange(len(share)), share, 0.86, color=colour)
        figures = [f"mean {row.means[name]:.2f}"] if name in row.means else []
        figures += [f"TV {row.total_variation[name]:.3f}"] if name in row.total_variation else []
        axes.set_title("   ".join(figures), loc="right", fontsize=7.5, color=INK, pad=3)
    else:
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", va="center", fontsize=8, color=INK)
    if known is not None and reference is not None and name != reference:
        outline = np.pad(known, (0, max(0, bins - len(known))))[:bins]
        axes.stairs(outline, np.arange(bins + 1) - 0.5, color=INK, linewidth=1.0)
    axes.set_xlim(-0.7, bins - 0.3)
    axes.set_ylim(0, 1.05 * highest)
    axes.set_yticks([])
    axes.tick_params(length=2, labelsize=7.5, color=FAINT, labelcolor=INK)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
