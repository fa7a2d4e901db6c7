"""The process that something was made in.

A forked child has a copy of everything but the threads, of which only the one that forked goes on. Whoever waits for
another one waits for ever, and so for a lock that another one held at that moment. No session of onnxruntime can be
relied on there, even one without threads of its own: calls report to a thread of onnxruntime's, with its locks.
"""

import os

LONGEST_WAIT = 10.0
"""Seconds that the end of the interpreter waits for a call under way."""


class Process:
    """The process that this was made in.

    To ask whether it was left costs no system call: that takes 50 ns on some machines, and 800 on others.
    """

    __slots__ = ("_depth", "_number")

    depth = 0
    """Forks that lead to this process."""

    def __init__(self) -> None:
        self._depth, self._number = Process.depth, os.getpid()

    @property
    def left(self) -> bool:
        """Whether this process is a fork of that one."""
        return self._depth != Process.depth

    def __str__(self) -> str:
        """Which is which, for an error."""
        return f"process {self._number}; this is process {os.getpid()}, a fork of it"


def _forked() -> None:
    Process.depth += 1


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_forked)
