"""What a benchmark is given at the command line: a folder for its runs, and data that the project may not ship."""

import argparse
import os
import shlex
import sys
from pathlib import Path

RUNS = Path("runs", "benchmarks")
MNIST = "MNIST"
FOLDERS = ("--out", "--mnist")


def out_option(parser: argparse.ArgumentParser, benchmark: str) -> None:
    """``--out FOLDER``, of targets, runs and results; one of the benchmark's name where it is not given."""
    parser.add_argument(
        "--out",
        type=Path,
        default=RUNS / Path(benchmark).stem,
        help="folder for targets, runs and results (%(default)s)",
    )


def mnist_option(parser: argparse.ArgumentParser) -> None:
    """``--mnist FOLDER``, or the environment's ``MNIST``."""
    parser.add_argument("--mnist", type=Path, default=os.environ.get(MNIST), help="folder of the original IDX files")


def needed(given: Path | None, what: str) -> Path:
    """A path that was given; else the benchmark says what it lacks and ends with 0, so that those after it run.

    Args:
        given: the path, or None.
        what: that it is, and how it is given.
    """
    if given is None:
        print(f"Skipped: expected {what}, got none.")
        sys.exit(0)
    return Path(given)


def needed_mnist(given: Path | None) -> Path:
    """The folder of MNIST, whose digits draw targets that the model does not have."""
    return needed(given, f"the folder of MNIST's original IDX files by --mnist FOLDER or {MNIST}=FOLDER")


def command(benchmark: str) -> str:
    """How a benchmark was called, as its results say it; without its folders, which differ from machine to machine."""
    given, said = iter(sys.argv[1:]), ["python", f"benchmarks/{Path(benchmark).name}"]
    for word in given:
        if word.partition("=")[0] in FOLDERS:
            if "=" not in word:
                next(given, None)
        else:
            said.append(word)
    return shlex.join(said)
