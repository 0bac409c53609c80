"""Options that several commands have."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder, made by 'probscene fit'.")]
Model = Annotated[str, typer.Argument(metavar="MODEL", help="multi_mnist, aerial2d, driving, or a .py file.")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same result.")]
Assets = Annotated[
    Path | None, typer.Option(metavar="DIR", help="A folder of meshes (driving) or pictures (aerial2d) to draw with.")
]
Cache = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Where trained feature networks are kept; the user's cache if not given."),
]
NoCache = Annotated[bool, typer.Option("--no-cache", help="Train the feature network anew, and keep it nowhere else.")]
MinHeight = Annotated[float, typer.Option(min=0, help="Of objects that KITTI's labels count, pixels of their boxes.")]
SomeLabels = Annotated[bool, typer.Option("--some-labels", help="Labels need not cover all images.")]
Visible = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[CLASS=]SHARE",
        help="Count objects of rendered scenes of which at least this is visible, 0 to 1; many.",
    ),
]
JudgedScenes = Annotated[
    int | None,
    typer.Option(
        help="Rendered of prior and guide for the verdict, 1000 if not given as at the end of fit; 0 for none."
    ),
]
BoxMargin = Annotated[
    int, typer.Option(min=0, metavar="PIXELS", help="By which labelled boxes are wider on each side.")
]
ValueRange = Annotated[
    str | None,
    typer.Option(
        "--range",
        metavar="LOW,HIGH",
        help="Values of 16-bit images that are black and white; if not given, the run's, or as found in the images.",
    ),
]
PresetName = StrEnum("PresetName", ["quick", "default", "street", "paper", "paper-aerial", "paper-driving"])
ClusterAddress = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Of a Ray cluster whose nodes share the work, HOST:6379; auto for one on this machine.",
    ),
]
