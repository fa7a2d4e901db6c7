"""How every command ends: its exit status, and one message where something went wrong.

| status | meaning |
| --- | --- |
| 0 | done |
| 1 | a check failed: the command ran, and what it looked at is not as it should be |
| 2 | bad usage or bad input, or something that the machine lacks: memory, space, a package |
| 70 | a defect of ttscompile, which nobody foresaw; ``--traceback`` shows where |
| 130 | interrupted (SIGINT) |
| 141 | nobody reads the results any more (``| head``) |
| 143 | ended from outside (SIGTERM) |
"""

import errno
import io
import os
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import Any

import click

import ttscompile
from ttscompile.cli.output import plain_warnings
from ttscompile.errors import CalibrationFailedError, TtscompileError

TRACEBACK = "--traceback"
_RESUMED = ("build", "calibrate")
_WORDS = "ttscompile.words"
_FULL = (errno.ENOSPC, errno.EDQUOT)
_HOME = Path(ttscompile.__file__).parent


class Status(IntEnum):
    """What the shell is told; see above."""

    DONE = 0
    FAILED = 1
    REFUSED = 2
    DEFECT = 70  # EX_SOFTWARE of sysexits.h
    INTERRUPTED = 128 + signal.SIGINT
    UNREAD = 128 + signal.SIGPIPE
    ENDED = 128 + signal.SIGTERM


class _EndedError(BaseException):
    """SIGTERM came; like ``KeyboardInterrupt`` no ``Exception``, so that it passes whatever handles those."""


class Commands(click.Group):
    """Lists its commands as they follow each other; tells every error in one message, without a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)

    def main(self, *args: Any, **extra: Any) -> Any:
        """As click does, with standard streams that are there, and can write every name.

        From 1.31 on onnxruntime sends what it was used for to its makers, and leaves a file in the temporary folder,
        unless it was told not to before it is imported. Whoever has said so himself is heard.
        """
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
        _open_standard_streams()
        return super().main(*args, **extra)

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> click.Context:
        """As click does; ``--help`` is written here."""
        words = (info_name or "ttscompile", *args)
        with _told_at_the_end(words):
            context = super().make_context(info_name, args, *more, **extra)
        context.meta[_WORDS] = words
        return context

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        with _told_at_the_end(ctx.meta[_WORDS]), _ended_by_sigterm(), plain_warnings():
            _require_folder()
            return super().invoke(ctx)


@contextmanager
def _told_at_the_end(words: Sequence[str]) -> Iterator[None]:
    """Say what went wrong in the block, and end the process with its status."""
    try:
        try:
            yield
        finally:
            _flush()
    except (click.ClickException, click.exceptions.Exit):
        raise  # bad usage, which click tells itself, and an end that is meant
    except (KeyboardInterrupt, _EndedError, Exception) as error:
        told, status = _judged(_signal_behind(error) or error, words)
    else:
        return
    with suppress(OSError):  # standard error may be full, or nobody's
        if told:
            click.echo(told, err=True)
    raise click.exceptions.Exit(status)


def _signal_behind(error: BaseException) -> BaseException | None:
    """The signal that came in a library: pybind11 makes an ImportError of it as it loads, Python a SystemError in C."""
    while isinstance(error, ImportError | SystemError) and error.__cause__ is not None:
        error = error.__cause__
    return error if isinstance(error, KeyboardInterrupt | _EndedError) else None


def _judged(error: BaseException, words: Sequence[str]) -> tuple[str, Status]:
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted{_resumes(words)}", Status.INTERRUPTED
    if isinstance(error, _EndedError):
        return f"ended by SIGTERM{_resumes(words)}", Status.ENDED
    if isinstance(error, CalibrationFailedError):
        return f"failed: {error}", Status.FAILED
    if isinstance(error, TtscompileError):
        return f"error: {error}", Status.REFUSED
    if isinstance(error, OSError) and error.errno == errno.EPIPE:
        return "", Status.UNREAD
    if isinstance(error, OSError):  # a full disk, which names no file; a file that may not be read
        remedy = ". Make space where the results go, and run this again." if error.errno in _FULL else ""
        return f"error: {error}{remedy}", Status.REFUSED
    if isinstance(error, MemoryError):
        return f"error: there is too little memory: {error or 'no more is given'}.", Status.REFUSED
    if isinstance(error, ImportError) and (error.name or "").partition(".")[0] != ttscompile.__name__:
        remedy = "Run: ttscompile doctor, which says what is missing or broken."
        return f"error: a package cannot be imported: {error}. {remedy}", Status.REFUSED
    return _defect(error, words), Status.DEFECT


def _defect(error: BaseException, words: Sequence[str]) -> str:
    """What was run, where it ended, and what to do: two lines, below the traceback if that was asked for."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).is_relative_to(_HOME)]
    where = f" at {Path(own[-1].filename).name}:{own[-1].lineno} in {own[-1].name}" if own else ""
    first = f"{type(error).__name__}: {error}".split("\n")[0]
    told = f"defect: {shlex.join(words)[:300]}: {first[:300]}{where}."
    asked = f"This is a defect of ttscompile {ttscompile.__version__}, not of what it was given. Please report it with"
    if TRACEBACK in words[1:2]:
        return "".join(traceback.format_exception(error)) + f"{told}\n{asked} the traceback above."
    return f"{told}\n{asked} the traceback: {shlex.join((words[0], TRACEBACK, *words[1:]))[:300]}"


def _require_folder() -> None:
    """MKL ends the process in a folder that is gone, with a message about another file."""
    try:
        Path.cwd()
    except FileNotFoundError as error:
        raise TtscompileError("the folder that this is run in is gone. Run it in another.") from error


def _resumes(words: Sequence[str]) -> str:
    command = next((word for word in words[1:] if word != TRACEBACK), "")
    return "; the same command with --resume goes on" if command in _RESUMED else ""


def _open_standard_streams() -> None:
    r"""Give closed descriptors back, or the next file that is opened gets what libraries print.

    Names that are no text are written as ``\udcff``, and not refused.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _flush() -> None:
    """Write what was printed, to know now whether that can be done: ``BrokenPipeError`` where nobody reads on."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):  # Python would try once more when it ends, and complain in its own words
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
        raise


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """End as after an error, so that nothing is left behind; unless somebody else has asked for the signal."""

    def end(_: int, __: FrameType | None) -> None:
        raise _EndedError

    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
