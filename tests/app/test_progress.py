"""What is shown while it works: a line a stage, or bars on a terminal that fit its width."""

import io
import re

import pytest
from rich.console import Console

from probscene.app.progress import STAGES, Display


def shown(terminal: bool, reports, error: bool = False) -> tuple[str, Display]:
    out = io.StringIO()
    display = Display(Console(file=out, force_terminal=terminal, width=80))
    try:
        with display:
            for report in reports:
                display(*report)
            if error:
                raise KeyError
    except KeyError:
        pass
    return out.getvalue(), display


def whole(stage: str, total: int):
    return [(stage, done, total, f"loss {done}") for done in range(total + 1)]


def test_a_line_for_each_stage_in_order():
    text, display = shown(False, [*whole("reading", 3), *whole("features", 5), *whole("structure", 2)])
    lines = text.splitlines()
    assert [line.split(":")[0] for line in lines] == [STAGES[s][0] for s in ("reading", "features", "structure")]
    assert re.fullmatch(r".*: 5 steps in \d+\.\d s(, [\d,.e+]+ steps/s)?, loss 5", lines[1])
    assert list(display.seconds) == ["reading", "features", "structure"]


def test_a_stage_that_ends_early_is_said_when_the_next_begins_or_all_is_well():
    text, _ = shown(False, [("features", 0, 9, ""), ("features", 4, 9, ""), *whole("structure", 2)[:2]])
    assert [line.split(" in ")[0] for line in text.splitlines()] == ["Feature network: 4 steps", "Structure: 1 batches"]
    text, display = shown(False, whole("structure", 9)[:4], error=True)
    assert text == "" and "structure" in display.seconds


def test_units_can_be_others():
    out = io.StringIO()
    with Display(Console(file=out)) as display:
        display.units["features"] = "epochs"
        display.stage("features")(1, 1)
        display.say("[note] as it is")
    assert "1 epochs" in out.getvalue() and "[note] as it is" in out.getvalue()


@pytest.mark.parametrize("stage", STAGES)
def test_bars_fit_a_terminal_of_80_columns(stage):
    text, _ = shown(True, [(stage, 9990 + done, 10000, "cost -0.123") for done in range(11)])
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
    title, unit = STAGES[stage]
    assert title in plain and "10000/10000" in plain and unit[:4] in plain
    assert all(len(row.split("\r")[-1]) <= 80 for row in plain.splitlines())
