"""Runs the Python of a documentation page, in order and in one namespace, in an empty folder.

    python docs/run_page.py docs/tutorials/own_model.md            # writes output and pictures into the page
    python docs/run_page.py docs/tutorials/own_model.md --check    # compares all but numbers
    python docs/run_page.py docs/tutorials/own_model.md --notebook # writes own_model.ipynb, from the page as it is

A fence that opens with ``python`` is run; ``python NAME.py`` is written to that file instead. A ``text`` fence that
follows it holds what it printed. A picture of the page, ``docs/pictures/NAME.png``, is the ``NAME.png`` that the code
wrote, if it wrote one. Fences of other languages are only shown. A notebook beside the page is written with it.
"""

import argparse
import base64
import contextlib
import difflib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

FENCE = re.compile(
    r"^```python(?: (?P<file>\S+))?\n(?P<code>.*?)^```\n(?:\n```text\n(?P<shown>.*?)^```\n)?", re.M | re.S
)
PICTURE = re.compile(r"^!\[(?P<caption>[^\]]*)\]\((?P<path>\S*pictures/(?P<name>[\w-]+\.png))\)\n", re.M)
LINK = re.compile(r"\[\]\((?P<path>[^)#]+\.md)(?P<place>#[^)]*)?\)")  # whose text is the title of the page


def run(page: str) -> str:
    """The page with the output of its code, which runs in the working directory."""
    names: dict[str, object] = {"__name__": "__page__"}

    def ran(fence: re.Match[str]) -> str:
        if fence["file"]:
            Path(fence["file"]).write_text(fence["code"], encoding="utf-8")
            return fence[0]
        printed = io.StringIO()
        line = page[: fence.start("code")].count("\n")
        with contextlib.redirect_stdout(printed):
            exec(compile("\n" * line + fence["code"], "the page", "exec"), names)
        if fence["shown"] is None:
            return fence[0]
        return fence[0].removesuffix(f"{fence['shown']}```\n") + f"{printed.getvalue()}```\n"

    return FENCE.sub(ran, page)


def without_numbers(text: str) -> list[str]:
    """Its lines, every number and the blanks that align it replaced."""
    return [re.sub(r"\s*-?\d+(\.\d+)?", " #", line) for line in text.splitlines()]


def notebook(path: Path) -> dict[str, Any]:
    """The page as a Jupyter notebook, with the outputs and pictures that it shows."""
    page, cells, at = path.read_text(encoding="utf-8"), [], 0
    for found in sorted([*FENCE.finditer(page), *PICTURE.finditer(page)], key=lambda found: found.start()):
        cells += _markdown(page[at : found.start()], path.parent)
        at, groups = found.end(), found.groupdict()
        if "caption" in groups:
            image = base64.b64encode((path.parent / groups["path"]).read_bytes()).decode()
            shown = {"output_type": "execute_result", "metadata": {}, "data": {"image/png": image}}
            cells += _code(f'from PIL import Image\n\nImage.open("{groups["name"]}")', shown)
            cells += _markdown(f"*{groups['caption']}.*", path.parent)
        else:
            magic = f"%%writefile {groups['file']}\n" if groups["file"] else ""
            printed = groups["shown"] and {"output_type": "stream", "name": "stdout", "text": _lines(groups["shown"])}
            cells += _code(magic + groups["code"].rstrip("\n"), printed)
    cells += _markdown(page[at:], path.parent)
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, 1):
        cell["execution_count"] = number
        for output in cell["outputs"]:
            if output["output_type"] == "execute_result":
                output["execution_count"] = number
    about = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {
        "cells": cells,
        "metadata": about | {"language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def _markdown(text: str, folder: Path) -> list[dict[str, Any]]:
    def titled(link: re.Match[str]) -> str:
        title = (folder / link["path"]).read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")
        return f"[{title}]({link['path']}{link['place'] or ''})"

    text = LINK.sub(titled, text).strip("\n")
    return [{"cell_type": "markdown", "metadata": {}, "source": _lines(text)}] if text else []


def _code(source: str, output: dict[str, Any] | None) -> list[dict[str, Any]]:
    return [{"cell_type": "code", "metadata": {}, "source": _lines(source), "outputs": [output] if output else []}]


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def write_notebook(path: Path) -> None:
    """Beside the page."""
    text = json.dumps(notebook(path), ensure_ascii=False, indent=1)
    path.with_suffix(".ipynb").write_text(text + "\n", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    parser.add_argument("--notebook", action="store_true", help="write the page as a notebook, run nothing")
    args = parser.parse_args()
    path, before = args.page.resolve(), args.page.read_text(encoding="utf-8")
    if args.notebook:
        write_notebook(path)
        return 0
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        os.environ["PROBSCENE_CACHE"] = f"{folder}/cache"
        after = run(before)
        pictures = [Path(name) for name in re.findall(r"pictures/([\w-]+\.png)\)", before) if Path(name).is_file()]
        if not args.check:
            for picture in pictures:
                # Of 64 colours, so that the repository stays small.
                Image.open(picture).convert("RGB").quantize(64).save(Path(__file__).parent / "pictures" / picture)
            path.write_text(after, encoding="utf-8")
            if path.with_suffix(".ipynb").exists():
                write_notebook(path)
            return 0
    lines = difflib.unified_diff(without_numbers(before), without_numbers(after), "page", "run", lineterm="", n=0)
    found = list(lines)
    print("\n".join(found), file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
