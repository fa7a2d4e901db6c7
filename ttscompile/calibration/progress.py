"""How far a calibration is: told to whoever asks, or shown as a bar on standard error."""

from __future__ import annotations

from collections.abc import Callable

from rich import progress
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn

Progress = Callable[[str, int, int], None]
"""Told what is being done, how many parts are done, and of how many."""


class Bar:
    """One line: what is being done, how far it is, error, sparsity and time left. A context manager."""

    def __init__(self, shown: bool) -> None:
        columns = (
            TextColumn("{task.description:<22}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[best]}"),
        )
        self._shown, console = shown, Console(stderr=True)
        self._progress = progress.Progress(*columns, console=console, disable=not (shown and console.is_terminal))
        self._task = self._progress.add_task("", total=None, note="", left="", best="")

    def __enter__(self) -> Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def warn(self, what: str) -> None:
        """Say something beside the bar."""
        if self._shown:
            self._progress.console.print(f"warning: {what}", markup=False, soft_wrap=True)

    def stage(self, what: str, total: int, done: int = 0) -> None:
        """Begin something of ``total`` parts, ``done`` of which were done before."""
        if self._shown and self._progress.disable:  # a log has no bar
            self._progress.console.print(f"{what}: {total - done} to do", markup=False, soft_wrap=True)
        self._progress.update(self._task, description=what, total=total, completed=done, note="", left="")

    def tell(self, what: str, done: int, total: int) -> None:
        """Say what is being done, how many parts are done, and of how many; see ``Progress``."""
        if what != self._progress.tasks[self._task].description:
            self.stage(what, total, done)
        self._progress.update(self._task, completed=done, total=total)

    def best(self, what: str) -> None:
        """Say what the best so far is."""
        if self._shown and self._progress.disable:
            self._progress.console.print(f"best so far: {what}", markup=False, soft_wrap=True)
        self._progress.update(self._task, best=f"best so far: {what}")

    def update(self, done: int, note: str, seconds_left: float) -> None:
        """Say how far it is."""
        left = f"at most {max(seconds_left, 0) / 60:.1f} min left"
        self._progress.update(self._task, completed=done, note=note, left=left)
