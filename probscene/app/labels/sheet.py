"""The sheet in which a person counts: ``sheet.html``, and ``counts.csv`` with the pictures beside for a spreadsheet.

Both ask for the number of objects of each class in each picture. The page keeps what is typed in the browser and gives
the CSV that ``fit --labels`` takes; no server is needed, and nothing leaves the machine.
"""

import base64
import hashlib
import html
import io
import json
import os
import tempfile
from importlib import resources
from pathlib import Path
from string import Template
from typing import NamedTuple

from PIL import Image

from probscene.dataset import Images
from probscene.decoding import read_rgb
from probscene.errors import DataError

from ..files import make_folder, write_text, write_whole
from ..style import style_sheet
from .counts import write_cells
from .naming import printable

MAX_PICTURE_SIDE = 1280  # pixels of a picture's longer side


class Sheet(NamedTuple):
    """What was written.

    Attributes:
        page: the HTML.
        table: the CSV.
        names: of the images to count in, in their order, as they are written there.
    """

    page: Path
    table: Path
    names: tuple[str, ...]


def write_sheet(
    out: Path,
    target: Images,
    rows: list[int],
    classes: tuple[str, ...],
    model: str,
    before: dict[str, list[str]] | None = None,
) -> Sheet:
    """A folder with the sheet, whole or not at all.

    Args:
        out: a folder that is new or empty.
        rows: the numbers of the target's images to count in.
        classes: to count.
        model: its name, for the title.
        before: by name, the cells of images that are labelled already: they stand in the CSV, too.

    Raises:
        DataError: the folder holds files already.
        MachineError: it cannot be written.
    """
    check_empty(out)
    names = tuple(printable(target.paths[row].name) for row in rows)
    cells = [[printable(name), *done] for name, done in (before or {}).items()]
    table = [*cells, *([name, *[""] * len(classes)] for name in names)]
    make_folder(out.parent)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as aside:
        folder = make_folder(Path(aside) / "sheet")
        make_folder(folder / "images")
        pictures = []
        for row, name in zip(rows, names, strict=True):
            data = _picture(target, row)
            pictures.append(data)
            beside = name if Path(name).suffix.lower() in (".jpg", ".jpeg") else f"{name}.jpg"
            write_whole(folder / "images" / beside, lambda file, data=data: file.write_bytes(data))
        write_cells(folder / "counts.csv", table, classes)
        write_text(folder / "sheet.html", page(names, pictures, classes, model, cells))
        if out.is_dir():
            out.rmdir()
        os.replace(folder, out)
    return Sheet(out / "sheet.html", out / "counts.csv", names)


def check_empty(out: Path) -> None:
    """See that a folder can become a sheet's: one that somebody has filled in is never written over.

    Raises:
        DataError: it holds files already, or is none.
    """
    if out.exists() and not out.is_dir():
        raise DataError(f"expected a folder for the sheet, got {out} is a file; name another.")
    if out.is_dir() and any(out.iterdir()):
        raise DataError(f"expected a new or empty folder for the sheet, got {out} holds files; name another.")


def page(
    names: tuple[str, ...],
    pictures: list[bytes],
    classes: tuple[str, ...],
    model: str,
    before: list[list[str]],
) -> str:
    """The HTML of a sheet.

    Args:
        pictures: of each name a JPEG.
        before: rows of the CSV that are known.
    """
    items = "".join(
        f'<section data-image="{html.escape(name)}"><a class="picture"><img alt="{html.escape(name)}" '
        f'src="data:image/jpeg;base64,{base64.b64encode(data).decode("ascii")}"></a><div class="counts">'
        f"<h2>{number}. {_broken_at_underscores(name)}</h2>{_inputs(name, classes)}</div></section>\n"
        for number, (name, data) in enumerate(zip(names, pictures, strict=True), 1)
    )
    about = {"classes": classes, "before": before}
    digest = hashlib.sha256(json.dumps([model, about, names]).encode()).hexdigest()[:16]
    return Template(
        resources.files("probscene.app.labels").joinpath("sheet.html").read_text(encoding="utf-8")
    ).substitute(
        style=style_sheet(),
        title=html.escape(f"Count in {len(names)} pictures: {model}"),
        classes=html.escape(", ".join(classes)),
        before=_labelled_before(len(before)) if before else "",
        items=items,
        about=json.dumps(about | {"key": f"probscene-{digest}"}).replace("<", "\\u003c"),
    )


def _labelled_before(number: int) -> str:
    pictures = f"{number} pictures that were" if number > 1 else "1 picture that was"
    return f"The file also holds {pictures} labelled before."


def _broken_at_underscores(text: str) -> str:
    """Markup of a name whose line may break after any underscore."""
    return html.escape(text).replace("_", "_<wbr>")


def _inputs(name: str, classes: tuple[str, ...]) -> str:
    label = html.escape(name)
    return "".join(
        f"<label><span>{_broken_at_underscores(c)}</span>"
        f'<input type="text" inputmode="numeric" autocomplete="off" data-class="{number}" '
        f'aria-label="{html.escape(c)} in {label}"></label>'
        for number, c in enumerate(classes)
    )


def _picture(target: Images, row: int) -> bytes:
    """What a model sees of an image, as sharp as its file is, as JPEG."""
    file, seen = target.paths[row], target.windows[row]
    if file.is_file():
        picture = Image.fromarray(read_rgb(file, target.value_range))
    else:
        picture, seen = Image.fromarray(target.load(row).permute(1, 2, 0).squeeze(2).numpy()), None
    if seen is not None:
        picture = picture.crop((seen.left, seen.top, seen.left + seen.width, seen.top + seen.height))
    picture.thumbnail((MAX_PICTURE_SIDE, MAX_PICTURE_SIDE), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.convert("RGB").save(data, "JPEG", quality=92)
    return data.getvalue()
