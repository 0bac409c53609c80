"""Options that several commands have."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder that 'probscene fit' wrote.")]
Model = Annotated[str, typer.Argument(metavar="MODEL", help="Built-in model, such as driving, or .py file.")]
Seed = Annotated[int, typer.Option(metavar="N", help="Random seed.")]
Assets = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder of meshes (driving) or pictures (aerial2d) to draw with.",
        rich_help_panel="Images",
    ),
]
Cache = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder that keeps trained feature networks; the user's cache if not given.",
        rich_help_panel="Computing",
    ),
]
NoCache = Annotated[
    bool,
    typer.Option("--no-cache", help="Neither use nor keep trained feature networks.", rich_help_panel="Computing"),
]
Device = Annotated[
    str,
    typer.Option(
        metavar="DEVICE", help="Where networks compute: cpu, cuda, cuda:1, mps or auto.", rich_help_panel="Computing"
    ),
]
MinHeight = Annotated[
    float,
    typer.Option(
        min=0, metavar="PIXELS", help="Count only objects whose boxes are at least this high.", rich_help_panel="Labels"
    ),
]
SomeLabels = Annotated[
    bool, typer.Option("--some-labels", help="Accept labels of only some images.", rich_help_panel="Labels")
]
Visible = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[CLASS=]SHARE",
        help="Count only objects at least this visible, 0 to 1; repeat for classes.",
        rich_help_panel="Labels",
    ),
]
JudgedScenes = Annotated[
    int | None,
    typer.Option(metavar="N", help="Scenes to render for the verdict; 1000 if not given, 0 for no verdict."),
]
BoxMargin = Annotated[
    str,
    typer.Option(
        metavar="PIXELS",
        help="Widen generated boxes on each side; by class: plate=2,mug=4.",
        rich_help_panel="Labels",
    ),
]
MinVisible = Annotated[
    float,
    typer.Option(
        metavar="SHARE",
        help="Label only objects at least this visible, 0 to 1.",
        rich_help_panel="Labels",
    ),
]
Detector = Annotated[
    str, typer.Option(metavar="NET", help="efficientnet or maskrcnn=FILE.", rich_help_panel="Detector")
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="WIDTHxHEIGHT", help="Size of its input; about 256x192 if not given.", rich_help_panel="Detector"
    ),
]
Iterations = Annotated[
    int | None,
    typer.Option(metavar="N", help="Training steps; 600, or 5000 of maskrcnn.", rich_help_panel="Detector"),
]
Batch = Annotated[
    int | None, typer.Option(metavar="N", help="Images a step; 4, or 2 of maskrcnn.", rich_help_panel="Detector")
]
Rate = Annotated[
    float | None,
    typer.Option(metavar="X", help="Highest learning rate; 0.002, or 0.001 of maskrcnn.", rich_help_panel="Detector"),
]
FinetuneFraction = Annotated[
    float,
    typer.Option(metavar="SHARE", help="Share of training images for fine-tuning.", rich_help_panel="Detector"),
]
ValueRange = Annotated[
    str | None,
    typer.Option(
        "--range",
        metavar="LOW,HIGH",
        help="Range of 16-bit values; the run's, or found in the images, if not given.",
        rich_help_panel="Images",
    ),
]
PresetName = StrEnum("PresetName", ["quick", "default", "street", "paper", "paper-aerial", "paper-driving"])
ClusterAddress = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Ray cluster that shares the work: HOST:6379, or auto to start one here.",
        rich_help_panel="Computing",
    ),
]
