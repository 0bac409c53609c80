"""Parts of a page: HTML of tables, pictures, and what is folded."""

import base64
import html
import io
from collections.abc import Iterable

from PIL import Image

from ..pictures import Pixels, grid, shrunk

THUMBNAIL_SIZE = 192  # pixels


def folded(title: str, content: str) -> str:
    """What is shown when its title is clicked; nothing where there is no content."""
    return f"<details><summary>{html.escape(title)}</summary>\n{content}\n</details>\n" if content else ""


def paragraphs(texts: Iterable[str]) -> str:
    return "".join(f"<p>{html.escape(text)}</p>" for text in texts)


def table(head: Iterable[str], rows: Iterable[Iterable[str]], sort: str = "") -> str:
    """A table that scrolls in its own container where the page is narrow.

    Args:
        rows: of markup.
        sort: a further class of the container.
    """
    first = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>\n" for row in rows)
    return f'<div class="scroll {sort}"><table>\n<tr>{first}</tr>\n{body}</table></div>'


def text_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """The same of text."""
    return table(head, ([html.escape(cell) for cell in row] for row in rows))


def picture(images: list[Pixels], caption: str, columns: int | None = None) -> str:
    """A grid of images."""
    data = io.BytesIO()
    Image.fromarray(grid([shrunk(image, THUMBNAIL_SIZE) for image in images], columns)).save(data, "PNG", optimize=True)
    source = base64.b64encode(data.getvalue()).decode("ascii")
    caption = html.escape(caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{source}"><figcaption>{caption}</figcaption></figure>'
    )
