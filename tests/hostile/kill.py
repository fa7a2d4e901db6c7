"""Kill convert and calibrate, and look at what is on disk: ``python -m tests.hostile.kill --kills 56``.

Each kill is a SIGKILL to a forked process, at a moment drawn at random: of time, or at the beginning of one of the
process's operations on files. What is there afterwards is the old artifact, the new one,
or a state from which calibration goes on; and when nobody kills it, the same is made again and nothing is left over.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Operation = Callable[[Path], None]

PREFIX = "ttscompile-kill-"
_BELOW = frozenset({"os.remove", "os.rmdir"})
_EVENTS = _BELOW | {"os.mkdir", "os.rename"}
_WRITING = os.O_WRONLY | os.O_RDWR


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill; print a JSON line for each scenario. Exit status 1 if anything was found halfway."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=56, help="of all scenarios together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", choices=["all", *SCENARIOS], default="all")
    options = parser.parse_args(arguments)
    names = list(SCENARIOS) if options.scenario == "all" else [options.scenario]
    failures = 0
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder:
        prepared = Prepared(Path(folder))
        for name in names:
            began = time.monotonic()
            found = SCENARIOS[name](prepared, random.Random(f"{options.seed}/{name}"), options.kills // len(names))
            print(json.dumps({"scenario": name, **found, "seconds": round(time.monotonic() - began, 1)}), flush=True)
            failures += len(found["failures"])
    return 1 if failures else 0


class Prepared:
    """A small policy, compiled in two versions and calibrated once, by processes that nobody killed.

    Attributes:
        folder: for everything.
        old: an artifact with other weights than ``new``.
        new: what ``convert`` makes.
        calibrated: ``new`` after ``calibrate``.
    """

    def __init__(self, folder: Path) -> None:
        import torch

        from tests.calibration import policies

        torch.set_num_threads(1)
        self.folder = folder
        self._recording = policies.record(folder / "calls.npz")
        self._modules = {name: policies.Mixer(seed).eval() for seed, name in enumerate(("new", "old"))}
        self.old, self.new, self.calibrated = (folder / name for name in ("old", "new", "calibrated"))
        self._written: tuple[Any, ...] = ()
        # Here and not in a forked process, so that those find everything imported.
        self.convert(self.old, "old")
        self._remember(lambda: self.convert(self.new))
        shutil.copytree(self.new, self.calibrated)
        finish(lambda: self.calibrate(self.calibrated))

    def convert(self, path: Path, which: str = "new") -> None:
        """Compile one of the policies."""
        from tests.calibration import policies
        from ttscompile import compile_denoiser

        compile_denoiser(self._modules[which], policies.spec(), path)

    def write(self, path: Path) -> None:
        """The end of ``convert``: all that it does on disk."""
        from ttscompile.artifact.write import write_artifact

        program, models, _, *rest = self._written
        write_artifact(program, models, path, *rest)

    def _remember(self, convert: Callable[[], None]) -> None:
        """Keep what ``convert`` gives to ``write_artifact``."""
        from unittest.mock import patch

        from ttscompile import driver
        from ttscompile.artifact.write import write_artifact

        with patch.object(driver, "write_artifact", wraps=write_artifact) as write:
            convert()
        assert write.call_count == 1
        assert not write.call_args.kwargs
        self._written = write.call_args.args

    def calibrate(self, path: Path, resume: bool = False) -> None:
        """Calibrate an artifact; the end depends on a number of intervals, not on time."""
        from ttscompile.calibration import tts
        from ttscompile.calibration.pipeline import calibrate

        setattr(tts, "DISTANCES", (1,))  # noqa: B010  # a constant; this process is forked, and ends with it
        arguments: dict[str, Any] = {"target_sparsity": 0.7, "max_intervals": 4, "progress": False, "max_minutes": 60}
        calibrate(path, [self._recording], resume=resume, **arguments)


def convert_fresh(prepared: Prepared, rng: random.Random, kills: int) -> dict[str, Any]:
    """There was nothing; there is nothing, or the new artifact."""
    return _convert(prepared, rng, kills, None)


def convert_again(prepared: Prepared, rng: random.Random, kills: int) -> dict[str, Any]:
    """There was an artifact; there is this or the new one."""
    return _convert(prepared, rng, kills, prepared.old)


def _convert(prepared: Prepared, rng: random.Random, kills: int, before: Path | None) -> dict[str, Any]:
    allowed = [None if before is None else contents(before), contents(prepared.new)]
    work = Path(tempfile.mkdtemp(dir=prepared.folder))
    target = work / "compiled"

    def start() -> None:
        shutil.rmtree(target, ignore_errors=True)
        if before is not None:
            shutil.copytree(before, target)

    def check() -> list[str]:
        found = contents(target) if target.exists() else None
        return [] if found in allowed else [f"neither the old nor the new: {sorted(found or ())}"]

    def afterwards() -> list[str]:
        finish(lambda: prepared.write(target))
        wrong = [] if contents(target) == allowed[1] else ["the next run did not make the same bytes"]
        return wrong + [f"left over: {path.name}" for path in work.iterdir() if path != target]

    return _kill(prepared.convert, prepared.write, target, start, check, afterwards, rng, kills)


def calibrate_fresh(prepared: Prepared, rng: random.Random, kills: int) -> dict[str, Any]:
    """There is the artifact as it was, with a state or without, or the calibrated one."""
    return _calibrate(prepared, rng, kills, False)


def calibrate_resumed(prepared: Prepared, rng: random.Random, kills: int) -> dict[str, Any]:
    """The same, where every run goes on from what the killed one before it left."""
    return _calibrate(prepared, rng, kills, True)


def _calibrate(prepared: Prepared, rng: random.Random, kills: int, resume: bool) -> dict[str, Any]:
    from ttscompile.artifact.load import load_artifact
    from ttscompile.artifact.manifest import MANIFEST
    from ttscompile.calibration.state import FILE

    allowed = {(path / MANIFEST).read_bytes() for path in (prepared.new, prepared.calibrated)}
    final = contents(prepared.calibrated)
    target = Path(tempfile.mkdtemp(dir=prepared.folder)) / "compiled"

    def start() -> None:
        if not (resume and target.exists() and (target / FILE).exists()):
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(prepared.new, target)

    def check() -> list[str]:
        load_artifact(target)
        return [] if (target / MANIFEST).read_bytes() in allowed else ["neither the old nor the new manifest"]

    def afterwards() -> list[str]:
        finish(lambda: prepared.calibrate(target, resume=True))
        return [] if contents(target) == final else ["resumed, it did not end where it would have ended"]

    def operation(path: Path) -> None:
        prepared.calibrate(path, resume)

    return _kill(operation, operation, target, start, check, afterwards, rng, kills)


SCENARIOS: dict[str, Callable[[Prepared, random.Random, int], dict[str, Any]]] = {
    "convert_fresh": convert_fresh,
    "convert_again": convert_again,
    "calibrate_fresh": calibrate_fresh,
    "calibrate_resumed": calibrate_resumed,
}


def _kill(
    operation: Operation,
    on_disk: Operation,
    target: Path,
    start: Callable[[], None],
    check: Callable[[], list[str]],
    afterwards: Callable[[], list[str]],
    rng: random.Random,
    kills: int,
) -> dict[str, Any]:
    start()
    began = time.monotonic()
    finish(lambda: operation(target))
    duration = time.monotonic() - began
    start()
    count = events(lambda: on_disk(target))
    failures, killed, survived = [], 0, 0
    for number in range(kills):
        start()
        if number % 3 == 2:
            seconds = rng.uniform(0, duration)
            moment, died = f"after {seconds:.2f} s", _killed_after(lambda: operation(target), seconds)
        else:
            event = rng.randrange(1, count + 1)
            moment, died = f"at operation {event} of {count}", killed_at(lambda: on_disk(target), event)
        killed, survived = killed + died, survived + (not died)
        failures += [f"{moment}: {what}" for what in check()]
        if number in (0, kills // 2, kills - 1):
            failures += [f"{moment}, then a whole run: {what}" for what in afterwards()]
    return {"kills": killed, "too late": survived, "operations": count, "failures": failures}


def finish(operation: Callable[[], None]) -> None:
    """Run in a forked process, to its end."""
    _, status = os.waitpid(fork(operation), 0)
    assert status == 0, f"a process that nobody killed ended with {status}"


def _killed_after(operation: Callable[[], None], seconds: float) -> bool:
    child = fork(operation)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def killed_at(operation: Callable[[], None], event: int) -> bool:
    """Kill a process when it begins its operation number ``event`` on files."""

    def watched() -> None:
        left = [event]

        def count(name: str, arguments: tuple[Any, ...]) -> None:
            if changes_files(name, arguments):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        operation()

    return os.WIFSIGNALED(os.waitpid(fork(watched), 0)[1])


def events(operation: Callable[[], None]) -> int:
    """How many operations on files a process has that nobody kills."""
    read, write = os.pipe()

    def counted() -> None:
        events = [0]

        def count(name: str, arguments: tuple[Any, ...]) -> None:
            events[0] += changes_files(name, arguments)

        sys.addaudithook(count)
        operation()
        os.write(write, str(events[0]).encode())

    finish(counted)
    os.close(write)
    with os.fdopen(read) as pipe:
        return int(pipe.read())


def changes_files(name: str, arguments: tuple[Any, ...]) -> bool:
    """Whether an audit event is a change of the files of this test; between two of them nothing changes on disk."""
    if name == "ctypes.dlsym":
        return arguments[1] == "renameat2"
    if name in _BELOW and arguments[1] != -1:  # a name below a folder that is held open, as when a tree is removed
        return True
    writes = name in _EVENTS or (name == "open" and arguments[2] & _WRITING)
    return bool(writes) and any(PREFIX in str(each) for each in arguments[:2])


def fork(operation: Callable[[], None]) -> int:
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            operation()
            status = 0
        except BaseException as error:
            print(repr(error), file=sys.stderr, flush=True)
        finally:
            os._exit(status)
    return child


def contents(folder: Path) -> dict[str, bytes]:
    """What is in a folder, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


if __name__ == "__main__":
    raise SystemExit(main())
