"""A verdict in a terminal and in the report."""

import html

from rich.console import Console
from rich.table import Table

from probscene.inference.judging.trust import Trust
from probscene.inference.judging.two_sample import Apart
from probscene.inference.judging.verdict import Gap

from ..evaluation.judge import Judged

Row = tuple[str, str, str]
HEAD = ("", "this fit", "the floor")
FLOOR = "The floor is what chance alone leaves between two halves of the real images."


def show(judged: Judged, console: Console) -> None:
    """Print the verdict, why, what to do, what the labels say, and the figures."""
    if judged.trust is None:
        console.print(f"No verdict. {judged.absent}", soft_wrap=True)
        console.print()
        return
    console.print(f"Verdict: {judged.trust.verdict}.", style="bold", soft_wrap=True)
    for text in _sentences(judged):
        console.print(text, soft_wrap=True)
    table = Table(title="Can this fit be trusted? Without labels", title_justify="left", title_style="bold")
    for name in HEAD:
        table.add_column(name, justify="right" if name else "left")
    for row in rows(judged.trust):
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(FLOOR, style="dim", soft_wrap=True)
    if judged.names:
        console.print(f"Least like any generated scene: {', '.join(judged.names)}.", style="dim", soft_wrap=True)
    console.print()


def section(judged: Judged, real: str, generated: str) -> str:
    """HTML for the report; ``real`` and ``generated`` are its pictures."""
    if judged.trust is None:
        return f"<p>No verdict. {html.escape(judged.absent)}</p>"
    found = judged.trust
    head = "".join(f"<th>{name}</th>" for name in HEAD)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows(found))
    text = "".join(f"<p>{html.escape(text)}</p>" for text in _sentences(judged))
    return (
        f'<div class="card">Verdict<b>{html.escape(str(found.verdict))}</b></div>{text}'
        f'<div class="row two">{real}{generated}</div>'
        f'<div class="chart"><table><tr>{head}</tr>{body}</table></div><p class="soft">{FLOOR}</p>'
    )


def rows(found: Trust) -> list[Row]:
    """The figures: what, of this fit, and the floor."""
    x = found.figures
    lost = x.modes.lost
    shares = f"{int(lost.sum())} of {len(lost)}, {_percent(float(x.modes.real[lost].sum()))} of real"
    looks = "looks" if x.by_appearance else "features"
    out = [
        ("energy distance, all features", *_apart(x.joint)),
        (f"energy distance, {x.names[x.single.worst]} (the farthest)", *_apart(x.single.largest, 1.0)),
    ]
    if x.from_prior is not None:
        out.append(("energy distance of generated and prior", *_apart(x.from_prior)))
    out += [
        ("p-value, all images", f"{x.p_value:.3f}", ""),
        ("real like no generated", *_gap(x.real_unmatched)),
        ("real like no generated or prior", *_gap(x.real_out_of_support)),
        ("generated like no real", *_gap(x.generated_unmatched)),
        ("clusters lost", shares, "0"),
        (f"real of another domain, by {looks}", _percent(x.foreign), "50.0 %"),
        ("effective sample size / N", f"{x.effective:.2f}", f"{x.effective_floor:.2f}"),
    ]
    for name in ("precision", "recall", "density", "coverage"):
        out.append((name, f"{getattr(x.fidelity, name):.2f}", f"{getattr(x.fidelity_floor, name):.2f}"))
    return out


def _sentences(judged: Judged) -> list[str]:
    found = judged.trust
    if found is None:
        return [judged.absent]
    out = [found.because, found.remedy, *([judged.usable] if judged.usable else [])]
    out += [] if judged.agreement is None else [judged.agreement.sentence(found.verdict)]
    return [*out, judged.walls] if judged.walls else out


def _apart(found: Apart, unit: float | None = None) -> tuple[str, str]:
    unit = unit or found.floor or 1.0
    return f"{found.distance / unit:.2f} floors", f"{found.low / unit:.2f} to {found.high / unit:.2f}"


def _gap(found: Gap) -> tuple[str, str]:
    spread = 50 * (found.high - found.low)
    return f"{100 * found.share:.1f} ± {spread:.1f} %", f"up to {_percent(found.floor)}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
