"""What a long command says while it works, on stderr: a bar for each stage on a terminal; else a line for each, and
one every half minute, so that a log file says how far a long stage is."""

import sys
import threading
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
    "likeness": ("Domain shift", "images"),
    "looking": ("Image features", "images"),
    "features": ("Feature network", "steps"),
    "readings": ("Readings", "images"),
    "target": ("Target's features", "images"),
    "pretraining": ("Pretraining", "epochs"),
    "structure": ("Structure", "batches"),
    "parameters": ("Parameters", "steps"),
    "refinement": ("Refinement", "batches"),
    "outcome": ("Outcome", "scenes"),
    "drawing": ("Drawing a target", "images"),
    "generating": ("Generating", "images"),
    "counting": ("Counting", "scenes"),
    "comparing": ("Comparing", "images"),
    "judging": ("Judging", "images"),
    "labels": ("Labelled images", "images"),
    "training": ("Detectors", "images"),
    "scoring": ("Scoring", "sets"),
    "cutting": ("Cutting out", "images"),
    "detector": ("Training", "images"),
    "detecting": ("Detecting", "images"),
}
"""By stage: what it does, and in what it counts."""
EVERY = 30.0  # seconds without a line, at most, where there is no terminal


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
    first: int  # what was done at the first report
    first_at: float
    gap: float  # seconds before it in which that was done, or other things, such as a model was loaded
    before: float  # seconds of the same stage earlier
    bar: TaskID
    last_at: float = 0.0
    done: int = 0
    total: int = 0
    note: str = ""
    ended: bool = False

    @property
    def pace(self) -> float | None:
        """Units a second, as far as it is known."""
        since = self.last_at - self.first_at
        return (self.done - self.first) / since if since > 0.01 and self.done > self.first else None

    @property
    def seconds(self) -> float:
        """How long it has taken: what was done before the first report, at the pace of the rest if that is less."""
        gap = self.gap if self.pace is None else min(self.gap, self.first / self.pace)
        return self.last_at - self.first_at + gap


class Display(AbstractContextManager):
    """Shows the progress of stages, one after the other; call it as a ``Progress``, inside ``with``.

    Args:
        console: where to show it.
        clock: seconds, which never go back.

    Attributes:
        units: by stage, in what it counts.
        seconds: by stage, how long it took.
    """

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic):
        self.console = console or Console(file=sys.stderr, highlight=False)
        self.units = {name: unit for name, (_, unit) in STAGES.items()}
        self.seconds: dict[str, float] = {}
        self._stage: _Stage | None = None
        self._clock, self._lock = clock, threading.RLock()
        self._start = self._last = self._said = clock()
        self._over = threading.Event()
        self._beats: threading.Thread | None = None
        self._bars = Bars(
            TextColumn("{task.description}", table_column=_wide(17)),
            BarColumn(bar_width=8, table_column=_wide(8)),
            MofNCompleteColumn(table_column=_wide(9)),
            _Rate(table_column=_wide(13)),
            _Time(table_column=_wide(15)),
            TextColumn("{task.fields[note]}", style="dim", table_column=Column(no_wrap=True, overflow="ellipsis")),
            console=self.console,
        )

    @property
    def elapsed(self) -> float:
        """Seconds since it was made, of stages and of what is none."""
        return self._clock() - self._start

    def __enter__(self) -> "Display":
        if self.console.is_terminal:
            self._bars.start()
        elif not self.console.quiet:
            self._beats = threading.Thread(target=self._keep_beating, daemon=True)
            self._beats.start()
        return self

    def __exit__(self, kind, *_) -> None:
        self._over.set()
        if self._beats is not None:
            self._beats.join()
        if kind is None:
            self._end()
        if self.console.is_terminal:
            self._bars.stop()

    def __call__(self, name: str, done: int, total: int, note: str = "", unit: str = "") -> None:
        """See ``Progress``."""
        with self._lock:
            now = self._clock()
            if unit:
                self.units[name] = unit
            if self._stage is None or self._stage.name != name:
                self._end()
                bar = self._bars.add_task(STAGES[name][0], unit=self.units[name], note="", completed=done)
                gap = 0.0 if done == 0 else now - self._last
                self._stage = _Stage(name, done, now, gap, self.seconds.get(name, 0.0), bar)
            stage = self._stage
            stage.last_at, stage.done, stage.total, stage.note = now, done, total, note
            self._last, self.seconds[name] = now, stage.before + stage.seconds
            self._bars.update(stage.bar, total=total, completed=done, note=note)
            if done == total:
                self._end()
            self.beat()

    def beat(self) -> None:
        """Without a terminal, say how far the work is if nothing was said for ``EVERY`` seconds."""
        with self._lock:
            stage, now = self._stage, self._clock()
            if self.console.is_terminal or now - self._said < EVERY:
                return
            if stage is None or stage.ended:
                self.say(f"Preparing the next stage, for {_clock(now - self._last)}")
                return
            unit = self.units[stage.name]
            parts = [f"{STAGES[stage.name][0]}: {stage.done} of {stage.total} {unit}"]
            if stage.pace is not None:
                left = max(0.0, (stage.total - stage.done) / stage.pace - (now - stage.last_at))
                parts += [f"{_short(stage.pace)} {unit}/s", f"{_clock(left)} left"]
            self.say(", ".join(parts + ([stage.note] if stage.note else [])))

    def say(self, text: str) -> None:
        """A line of text above the bars."""
        with self._lock:
            self.console.print(text, markup=False, soft_wrap=True)
            self.console.file.flush()
            self._said = self._clock()

    def _keep_beating(self) -> None:
        while not self._over.wait(EVERY / 30):
            self.beat()

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
        unit = self.units[stage.name]
        rate = "" if stage.pace is None else f", {_short(stage.pace)} {unit}/s"
        note = f", {stage.note}" if stage.note else ""
        self.say(f"{STAGES[stage.name][0]}: {stage.done} {unit} in {stage.seconds:.1f} s{rate}{note}")


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
