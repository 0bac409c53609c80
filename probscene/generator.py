"""Generators: programs that draw the scenes of a model, where no renderer of probscene does.

A model names one in ``SceneModel.generator``: a function ``render(scene)`` in this process, or a ``Command``, a program
in a process, and most often an environment, of its own. What a function or program is given and returns:
``serve`` in probscene.worker.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import DataError, ModelError


@dataclass(frozen=True)
class Command:
    """A program that calls ``serve``, and how it is kept at work.

    Args:
        argv: the program and its arguments. Give files by absolute paths, such as
            ``str(Path(__file__).with_name("draw.py"))``.
        workers: how many of it run at once; as many as whoever draws asks for where None, a fit one for each core.
        start_timeout: seconds in which it has to have called ``serve``.
        timeout: seconds for an image; then the program and all that it has started are killed.
        restart_after: images after which a worker is replaced by a fresh one; never where None.
        memory: megabytes, after which a worker is; never where None.
        attempts: how often a scene is tried, each time by a fresh worker, before it is an error.
        files: what the program is made of, beside the files among its arguments. A run is bound to their bytes.
        version: of the program, which it has to say to ``serve``; any where empty.
        keep: a folder in which pictures are kept and taken again for the same scene, as when a fit goes on, begins anew
            with the same seed, or has another target; it grows by each image. None for nothing.
        reproducible: whether one scene always gives the same bytes. Where not, no image is promised again.

    Raises:
        ModelError: no program, or a number out of range.
    """

    argv: Sequence[str]
    workers: int | None = None
    start_timeout: float = 60.0
    timeout: float = 120.0
    restart_after: int | None = None
    memory: float | None = None
    attempts: int = 3
    files: Sequence[str | Path] = ()
    version: str = ""
    keep: str | Path | None = None
    reproducible: bool = True

    def __post_init__(self):
        if isinstance(self.argv, str) or not self.argv:
            raise ModelError(
                f"expected the argv of a Command as a list of words, got {self.argv!r}; write "
                "Command([sys.executable, str(Path(__file__).with_name('draw.py'))])."
            )
        object.__setattr__(self, "argv", tuple(str(word) for word in self.argv))
        object.__setattr__(self, "files", tuple(str(file) for file in self.files))
        numbers = {key: getattr(self, key) for key in ("workers", "restart_after", "memory", "attempts")}
        numbers |= {"start_timeout": self.start_timeout, "timeout": self.timeout}
        for key, number in numbers.items():
            if number is not None and number <= 0:
                raise ModelError(f"expected {key} of a Command above 0, got {number}.")

    @property
    def name(self) -> str:
        """The program in a word, for messages."""
        scripts = [word for word in self.argv[1:] if Path(word).suffix]
        return Path(scripts[-1] if scripts else self.argv[0]).name

    def fingerprint(self) -> str:
        """What a run is bound to, in words: the program's arguments, version and the bytes of its files.

        Raises:
            DataError: a file cannot be read.
        """
        digest = hashlib.sha256(self.version.encode())
        for word in self.argv[1:]:
            digest.update(f"\n{Path(word).name if Path(word).is_file() else word}".encode())
        for file in (*(word for word in self.argv[1:] if Path(word).is_file()), *self.files):
            try:
                digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
            except OSError as error:
                raise DataError(
                    f"expected to read {file}, of which the generator {self.name} is made, got {error.strerror}; "
                    "put it back, or take it out of files=."
                ) from error
        return f"generator {self.name}, {digest.hexdigest()[:16]}"


Generator = Callable[[Any], Any] | Command
"""What draws the scenes of a model: a function of a scene in this process, or a program."""
