"""Runs the Python of a documentation page, in order and in one namespace, in an empty folder.

    python docs/run_page.py docs/tutorials/own_model.md            # writes output and pictures into the page
    python docs/run_page.py docs/tutorials/own_model.md --check    # compares all but numbers

A fence that opens with ``python`` is run; ``python NAME.py`` is written to that file instead. A ``text`` fence that
follows it holds what it printed. A picture of the page, ``docs/pictures/NAME.png``, is the ``NAME.png`` that the code
wrote, if it wrote one. Fences of other languages, ``py`` among them, are only shown.
"""

import argparse
import contextlib
import difflib
import io
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

FENCE = re.compile(
    r"^```python(?: (?P<file>\S+))?\n(?P<code>.*?)^```\n(?:\n```text\n(?P<shown>.*?)^```\n)?", re.M | re.S
)


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    args = parser.parse_args()
    path, before = args.page.resolve(), args.page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        os.environ["PROBSCENE_CACHE"] = f"{folder}/cache"
        after = run(before)
        pictures = [Path(name) for name in re.findall(r"pictures/([\w-]+\.png)\)", before) if Path(name).is_file()]
        if not args.check:
            for picture in pictures:
                shutil.copy(picture, Path(__file__).parent / "pictures" / picture)
            path.write_text(after, encoding="utf-8")
            return 0
    lines = difflib.unified_diff(without_numbers(before), without_numbers(after), "page", "run", lineterm="", n=0)
    found = list(lines)
    print("\n".join(found), file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
