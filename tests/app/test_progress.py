"""What is shown while it works: a line a stage, or bars on a terminal that fit its width."""

import io
import re
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from probscene.app import progress
from probscene.app.fitting import pipeline
from probscene.app.fitting.store import OTHER, timing
from probscene.app.progress import EVERY, STAGES, Display


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


class Clock:
    """A clock that the test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def logged(reports) -> tuple[list[tuple[float, str]], Display]:
    """What a log file gets, with its times, from ``(seconds later, stage, done, total, note)``."""
    clock, out = Clock(), io.StringIO()
    display, lines = Display(Console(file=out, width=80), clock), []
    for later, *report in reports:
        clock.now += later
        display(*report)
        for line in out.getvalue().splitlines()[len(lines) :]:
            lines.append((clock.now - Clock.now, line))
    return lines, display


@given(st.lists(st.floats(0.01, 100), min_size=1, max_size=60))
def test_a_log_file_gets_a_line_every_half_minute(gaps):
    lines, _ = logged([(gap, "structure", i + 1, 1000, "") for i, gap in enumerate(gaps)])
    times = [0.0, *(at for at, _ in lines), sum(gaps)]
    rounded = 1e-6  # of the clock's sums
    assert all(later - at < EVERY + max(gaps) + rounded for at, later in pairwise(times))
    assert len(lines) <= (sum(gaps) + rounded) / EVERY  # and no more than that


def test_a_line_says_stage_done_of_total_rate_and_time_left():
    lines, _ = logged([(0, "features", 0, 600, ""), *((2, "features", i, 600, f"loss {i}") for i in range(1, 100))])
    assert lines[0] == (30.0, "Feature network: 15 of 600 steps, 0.5 steps/s, 19:30 left, loss 15")
    assert [at for at, _ in lines] == [30, 60, 90, 120, 150, 180]


def test_a_beat_between_reports_counts_the_time_down_and_before_all_stages_says_that_something_is_done():
    clock, out = Clock(), io.StringIO()
    display = Display(Console(file=out, width=80), clock)
    for later in (29, 1, 0, 29, 1):
        clock.now += later
        display.beat()
    assert out.getvalue().splitlines() == [f"Preparing the next stage, for {t}" for t in ("0:30", "1:00")]
    display("structure", 0, 10)
    for done in (1, 2):
        clock.now += 20
        display("structure", done, 10)
    clock.now += 31
    display.beat()
    assert out.getvalue().splitlines()[2:] == [
        "Structure: 2 of 10 batches, 0.05 batches/s, 2:40 left",
        "Structure: 2 of 10 batches, 0.05 batches/s, 2:09 left",
    ]


@given(st.floats(0, 1000), st.integers(1, 50), st.integers(1, 50), st.floats(0.1, 10))
def test_a_stages_clock_leaves_out_what_was_loaded_before_it(loading, first, more, each):
    """It first reports when ``first`` units are done, ``loading`` seconds later than they would take alone."""
    total = first + more
    reports = [(loading + first * each, "target", first, total, "")]
    reports += [(each, "target", first + i, total, "") for i in range(1, more + 1)]
    lines, display = logged(reports)
    assert display.seconds["target"] == pytest.approx(total * each, rel=1e-6)
    seconds = re.match(rf"Target's features: {total} images in (\d+\.\d) s, ", lines[-1][1])
    assert seconds is not None and float(seconds[1]) == pytest.approx(total * each, abs=0.051)


def test_a_thread_says_it_while_nothing_is_reported(monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.05)
    out = io.StringIO()
    with Display(Console(file=out, width=80)) as display:
        display("generating", 0, 10)
        deadline = time.monotonic() + 60
        while out.getvalue().count("Generating: 0 of 10 images") < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    said = out.getvalue()
    assert said.count("Generating: 0 of 10 images") >= 3
    time.sleep(0.1)
    assert out.getvalue() == said  # nothing after the end


def test_terminals_and_quiet_consoles_have_no_such_lines():
    for console in (Console(file=io.StringIO(), force_terminal=True), Console(file=io.StringIO(), quiet=True)):
        clock = Clock()
        display = Display(console, clock)
        clock.now += 100
        display.beat()
        assert console.file.getvalue() == ""


@given(
    st.lists(st.tuples(st.sampled_from(list(STAGES)), st.integers(0, 3), st.floats(0, 9)), max_size=12), st.booleans()
)
def test_the_times_of_a_fits_stages_and_of_what_is_none_add_up_to_the_whole(reports, again):
    """Also over two sittings; what is no stage of a fit, such as the drawing of a target, is none of its times."""
    now = 0.0

    def take_stages(begun, show, *_):
        nonlocal now
        for name, done, seconds in reports:
            now += seconds
            show(name, done, 3)
        now += 1.5

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "_take_stages", take_stages)
        run, beside = SimpleNamespace(path=Path(folder), is_finished=False, objects={}), 0.0
        for _ in range(1 + again):
            with Display(Console(quiet=True), lambda: now) as show:
                pipeline.carry_out(pipeline.Begun(run), show)
            beside += sum(seconds for name, seconds in show.seconds.items() if name not in pipeline.STAGES)
        assert sum(timing(run).values()) == pytest.approx(now - beside, abs=1e-6)
        assert timing(run)[OTHER] >= 1.5 * (1 + again) - 1e-6
