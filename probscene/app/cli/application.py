"""The application that commands are added to: their help, the next step that each names, and errors in one line."""

import functools
import os
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperCommand, TyperGroup

from probscene.errors import GeneratorError, ProbsceneError
from probscene.program_errors import useful_text


@dataclass
class Call:
    """What was asked for, for the message when it ends early."""

    words: list[str]
    debug: bool = field(default_factory=lambda: bool(os.environ.get("PROBSCENE_DEBUG")))


ORDER = (
    "begin", "check", "preview", "view", "label", "fit", "generate", "evaluate", "report", "compare", "trial", "train",
    "predict", "demo", "version",
)  # fmt: skip


MAX_UNGROUPED = 10  # options of a command under one heading


class Command(TyperCommand):
    """A command whose function returns what to do next, or None, and whose options, if many, stand under the headings
    that they name as ``rich_help_panel``."""

    def format_options(self, ctx, formatter):
        sections: dict[str, list[tuple[str, str]]] = {}
        grouped = sum(parameter.param_type_name == "option" for parameter in self.params) > MAX_UNGROUPED
        for parameter in self.get_params(ctx):
            heading = "Arguments" if parameter.param_type_name == "argument" else "Options"
            if grouped:
                heading = getattr(parameter, "rich_help_panel", None) or heading
            if (record := parameter.get_help_record(ctx)) is not None:
                sections.setdefault(heading, []).append(record)
        width = max(len(name) for rows in sections.values() for name, _ in rows)
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), text) for name, text in rows])

    def invoke(self, ctx):
        then = super().invoke(ctx)
        if then is not None:
            print(f"Next: {then}")


def command_line(*words: object) -> str:
    """A command of probscene, to paste into a shell."""
    return shlex.join(["probscene", *map(str, words)])


class Commands(TyperGroup):
    """Lists commands in the order of the work, and turns an error of any into one line on stderr and an exit code."""

    def list_commands(self, ctx):
        return [name for name in ORDER if name in self.commands]

    def parse_args(self, ctx, args):
        ctx.obj = Call(list(args))
        return super().parse_args(ctx, args)

    def invoke(self, ctx):
        try:
            return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as error:
            its_own = type(error).__module__.startswith(("typer.", "click."))  # wrong usage, --help, an exit code
            if its_own or isinstance(error, BrokenPipeError) or ctx.obj.debug:
                raise
            code, text = explained(error, ctx.obj.words)
            print(text, file=sys.stderr)
        raise typer.Exit(code)


def explained(error: BaseException, words: list[str]) -> tuple[int, str]:
    """The exit code and the one line that an error comes to, with what a generator printed below it; ``words`` are what
    was typed after ``probscene``."""
    again = command_line(*words)
    if isinstance(error, KeyboardInterrupt):
        return 1, f"Interrupted; continue with: {again}"
    if isinstance(error, OSError):
        from ..files import machine_error

        error = machine_error(error, Path(error.filename or "the output"))
    if isinstance(error, GeneratorError):
        return error.exit_code, f"probscene: {error}"
    if isinstance(error, ProbsceneError):
        return error.exit_code, f"probscene: {' '.join(str(error).split())}"
    if isinstance(error, MemoryError):
        return 1, "probscene: The machine is out of memory; close other programs and run the command again."
    debug = command_line("--debug", *words)
    from ..modules import line_of_user

    kind, text, own = type(error).__name__, useful_text(error), line_of_user(error)
    if own is not None:
        return 2, f"probscene: {kind} in {own}: {text}. The whole traceback: {debug}"
    return 1, f"probscene: A bug in probscene: {kind}: {text}. Please report what this prints: {debug}"


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Next: probscene demo, the whole method on handwritten digits; or probscene COMMAND --help.",
)
command = functools.partial(app.command, cls=Command)


@app.callback()
def _everywhere(
    ctx: typer.Context, debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False
) -> None:
    """Learn the distribution of scenes from unlabelled images, then generate labelled ones."""
    ctx.obj.debug |= debug
