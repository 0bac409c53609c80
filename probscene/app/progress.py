"""What a long command says while it works, on stderr: a bar for each stage on a terminal, else a line for each."""

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
)
from rich.progress import (
    Progress as Bars,
)
from rich.table import Column
from rich.text import Text

STAGES = {
    "reading": ("Target's images", "images"),
    "looking": ("Looking at images", "images"),
    "features": ("Feature network", "steps"),
    "target": ("Target's features", "images"),
    "pretraining": ("Pretraining", "epochs"),
    "structure": ("Structure", "batches"),
    "drawing": ("Drawing a target", "images"),
    "generating": ("Generating", "images"),
    "counting": ("Counting", "scenes"),
    "comparing": ("Comparing", "images"),
    "judging": ("Judging", "images"),
}
"""By stage: what it does, and in what it counts."""


class Progress(Protocol):
    """Hears how far a stage is."""

    def __call__(self, name: str, done: int, total: int, note: str = "", unit: str = "") -> None:
        """``done`` of ``total`` of a stage.

        Args:
            name: of ``STAGES``.
            note: such as the loss.
            unit: in what it counts, where that is not the stage's own.
        """
        ...


def silent(name: str, done: int, total: int, note: str = "", unit: str = "") -> None:
    """A ``Progress`` that says nothing."""


@dataclass
class _Stage:
    name: str
    began: float
    first: int  # what was done at the first report
    first_at: float
    bar: TaskID
    done: int = 0
    total: int = 0
    note: str = ""
    ended: bool = False


class Display(AbstractContextManager):
    """Shows the progress of stages, one after the other; call it as a ``Progress``, inside ``with``.

    Args:
        console: where to show it.

    Attributes:
        units: by stage, in what it counts.
        seconds: by stage, how long it took.
    """

    def __init__(self, console: Console | None = None):
        self.console = console or Console(file=sys.stderr, highlight=False)
        self.units = {name: unit for name, (_, unit) in STAGES.items()}
        self.seconds: dict[str, float] = {}
        self._stage: _Stage | None = None
        self._last = time.monotonic()
        self._bars = Bars(
            TextColumn("{task.description}", table_column=_wide(17)),
            BarColumn(bar_width=8, table_column=_wide(8)),
            MofNCompleteColumn(table_column=_wide(9)),
            _Rate(table_column=_wide(13)),
            _Time(table_column=_wide(15)),
            TextColumn("{task.fields[note]}", style="dim", table_column=Column(no_wrap=True, overflow="ellipsis")),
            console=self.console,
        )

    def __enter__(self) -> "Display":
        if self.console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, kind, *_) -> None:
        if kind is None:
            self._end()
        if self.console.is_terminal:
            self._bars.stop()

    def __call__(self, name: str, done: int, total: int, note: str = "", unit: str = "") -> None:
        """See ``Progress``."""
        now = time.monotonic()
        if unit:
            self.units[name] = unit
        if self._stage is None or self._stage.name != name:
            self._end()
            bar = self._bars.add_task(STAGES[name][0], unit=self.units[name], note="", completed=done)
            # A stage that first reports when a part of it is done began when the one before it last reported.
            self._stage = _Stage(name, now if done == 0 else self._last, done, now, bar)
            self.seconds.setdefault(name, 0.0)
        stage = self._stage
        self.seconds[name] += now - max(stage.began, self._last)
        self._last, stage.done, stage.total, stage.note = now, done, total, note
        self._bars.update(stage.bar, total=total, completed=done, note=note)
        if done == total:
            self._end()

    def say(self, text: str) -> None:
        """A line of text above the bars."""
        self.console.print(text, markup=False, soft_wrap=True)

    def stage(self, name: str) -> Callable[[int, int], None]:
        """One stage's callback, for functions that report ``(done, total)``."""
        return lambda done, total: self(name, done, total)

    def _end(self) -> None:
        stage = self._stage
        if stage is None or stage.ended:
            return
        stage.ended = True
        if self.console.is_terminal:
            self._bars.stop_task(stage.bar)
            return
        unit, spent = self.units[stage.name], self._last - stage.first_at
        rate = f", {_short((stage.done - stage.first) / spent)} {unit}/s" if spent > 0.01 else ""
        note = f", {stage.note}" if stage.note else ""
        title = STAGES[stage.name][0]
        self.say(f"{title}: {stage.done} {unit} in {self._last - stage.began:.1f} s{rate}{note}")


def _short(rate: float) -> str:
    return f"{rate:,.0f}" if rate >= 100 else f"{rate:.2g}"


def _wide(least: int) -> Column:
    return Column(min_width=least, no_wrap=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{_short(speed)} {task.fields['unit']}/s" if speed else "", style="cyan")


class _Time(ProgressColumn):
    """The time that a stage has taken, and what is left of it."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        left = None if task.finished else task.time_remaining
        return Text(_clock(task.elapsed or 0.0) + (f", {_clock(left)} left" if left is not None else ""), style="green")
