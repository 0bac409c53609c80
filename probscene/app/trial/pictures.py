"""A trial's results as a picture: a panel for each class and their mean, a line for each set."""

import textwrap
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..files import write_whole
from ..style import LIGHT
from .results import Column, Results
from .tables import shown

REAL, OTHER = LIGHT["ink"], LIGHT["learnt"]  # of rows that are shown labelled photographs alone, and of the others
INK, FAINT = LIGHT["ink"], LIGHT["faint"]
MAX_PANELS, MIN_PANEL_SPAN = 6, 2.0  # panels; percent that a panel spans
PANEL, LINE, NAMES = 2.1, 0.3, 2.0  # inches
CHARACTERS_AN_INCH = 14  # of the words below, at most


def draw(results: Results, out: Path) -> None:
    """Write the picture, a PNG, whole or not at all.

    Raises:
        MachineError: it cannot be written.
    """
    figure = picture(results)
    write_whole(out, lambda temporary: figure.savefig(temporary, format="png", dpi=130, metadata={"Software": None}))


def picture(results: Results) -> Figure:
    """The figure: a dot is the mean of the seeds, a line its 95 % interval, a small mark each seed."""
    columns = shown(results)[:MAX_PANELS]
    size = (NAMES + PANEL * len(columns), 1.1 + LINE * len(results.rows))
    figure = Figure(size, layout="constrained", facecolor="white")
    panels = figure.subplots(1, len(columns), squeeze=False, sharey=True)[0]
    for axes, column in zip(panels, columns, strict=True):
        _panel(axes, results, column)
    panels[0].set_yticks(range(len(results.rows)), [textwrap.fill(row, 26) for row in results.rows], fontsize=9)
    images, seeds = results.counts["test_images"], results.counts["seeds"]
    words = (
        f"average precision in %, {images} test images, {seeds} seed{'s' * (seeds != 1)}; "
        "lines: 95\N{NO-BREAK SPACE}% of resamples; dark: photographs alone"
    )
    figure.supxlabel(textwrap.fill(words, int(CHARACTERS_AN_INCH * size[0])), fontsize=8, color=INK)
    return figure


def _panel(axes: Axes, results: Results, column: Column) -> None:
    name, measure = column
    axes.set_title(textwrap.fill(f"{name}, {measure}", 26), fontsize=9, color=INK)
    for y, row in enumerate(results.rows):
        found = results.precision(row, column)
        colour = REAL if row in results.photographs else OTHER
        axes.plot([100 * found.low, 100 * found.high], [y, y], color=colour, linewidth=1.6, solid_capstyle="butt")
        axes.plot(100 * results.by_seed[row, column], [y] * results.counts["seeds"], "|", color=colour, markersize=5)
        axes.plot([100 * found.value], [y], "o", color=colour, markersize=5, clip_on=False)
    axes.set_ylim(len(results.rows) - 0.5, -0.5)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=8, colors=INK, pad=6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
    axes.margins(x=0.06)
    low, high = axes.get_xlim()
    if high - low < MIN_PANEL_SPAN:  # one value, or nearly
        middle = min(max((low + high) / 2, MIN_PANEL_SPAN / 2), 100 - MIN_PANEL_SPAN / 2)
        axes.set_xlim(middle - MIN_PANEL_SPAN / 2, middle + MIN_PANEL_SPAN / 2)
