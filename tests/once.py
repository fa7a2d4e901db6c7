"""What is made once a run and then read by every module of every worker: compiled artifacts, above all."""

from __future__ import annotations

import fcntl
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

from ttscompile.ir.program import Program


class Once:
    """Folders by name, each made by whoever asks first; the others wait for it. What is in them is never changed.

    Args:
        directory: common to the workers of a run, and to no other run.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._programs: dict[str, Program] = {}
        directory.mkdir(exist_ok=True)

    def folder(self, name: str, make: Callable[[Path], object]) -> Path:
        """The folder of a name; ``make`` is given a path where nothing is, and leaves a folder there."""
        made, unfinished = self.directory / name, self.directory / name / "unfinished"
        made.mkdir(exist_ok=True)
        with (made / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (made / "compiled").exists():
                shutil.rmtree(unfinished, ignore_errors=True)
                make(unfinished)
                unfinished.rename(made / "compiled")
        return made / "compiled"

    def compiled(self, name: str, make: Callable[[Path], Program]) -> tuple[Path, Program]:
        """An artifact and the program that it holds; ``make`` is ``convert`` or ``compile_denoiser`` into a path."""

        def both(directory: Path) -> None:
            directory.mkdir()
            (directory / "program.pickle").write_bytes(pickle.dumps(make(directory / "artifact")))

        folder = self.folder(name, both)
        if name not in self._programs:
            stored = (folder / "program.pickle").read_bytes()  # by this run, in a folder of its own
            self._programs[name] = pickle.loads(stored)
        return folder / "artifact", self._programs[name]
