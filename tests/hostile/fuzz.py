"""Fuzz everything that reads what strangers send: ``python -m tests.hostile.fuzz --cases 20000 --target zip``.

``--target structured --cases 50000`` is the long run of artifacts that somebody forged who knows the format.
Each case is one bad file (or message), made from a good one with random numbers that depend on seed, target and number
of the case alone: ``--first N --cases 1`` repeats one. What may come out is an error of ttscompile's own, or a result;
within ``LIMIT`` seconds and ``guard.MORE_BYTES`` of memory, with nothing executed and nothing written outside. Cases
run in processes of their own: one that crashes or hangs is a defect that is told, and the next goes on after it.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.hostile.guard import Guard

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 5.0
"""Seconds that a case may take of the processor, so that it does not matter what else the machine does."""
STUCK = 240.0
"""Seconds after which a case that is not done is killed: more than ``LIMIT``, so that slow and stuck are told apart."""
PORTION = 2500
"""Cases of one process."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases; print one JSON line for each target, and one for each defect. Exit status 1 if there is any."""
    from tests.hostile.targets import MIXES, TARGETS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", choices=[*TARGETS, *MIXES, "all"], default="all")
    parser.add_argument("--cases", type=int, default=1000, help="of each target")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--corpus", type=Path, help="made already; by default it is made anew")
    options = parser.parse_args(arguments)
    defects = 0
    with tempfile.TemporaryDirectory(dir=memory(), prefix="ttscompile-fuzz-") as folder:
        corpus = options.corpus or Path(folder) / "corpus"
        if options.corpus is None:
            subprocess.run([sys.executable, "-m", "tests.hostile.corpus", str(corpus)], cwd=ROOT, check=True)
        for target in TARGETS if options.target == "all" else [options.target]:
            began = time.monotonic()
            reports = run(target, options, corpus, Path(folder))
            for defect in (d for report in reports for d in report["defects"]):
                print(json.dumps({"defect": target, **defect}), flush=True)
                defects += 1
            summary = {
                "target": target,
                "cases": options.cases,
                "refused": sum(report["refused"] for report in reports),
                "accepted": sum(report["accepted"] for report in reports),
                "stopped": sum(report["stopped"] for report in reports),
                "defects": sum(len(report["defects"]) for report in reports),
                "slowest_s": round(max((report["slowest"] for report in reports), default=0.0), 2),
                "peak_mib": max((report["peak_mib"] for report in reports), default=0),
                "seconds": round(time.monotonic() - began, 1),
            }
            print(json.dumps(summary), flush=True)
    return 1 if defects else 0


def run(target: str, options: argparse.Namespace, corpus: Path, folder: Path) -> list[dict[str, Any]]:
    """All cases of a target, in portions, each in a process."""
    stop = options.first + options.cases
    size = max(1, min(PORTION, -(-options.cases // options.processes)))
    portions = [(first, min(first + size, stop)) for first in range(options.first, stop, size)]
    with ThreadPoolExecutor(options.processes) as pool:
        found = pool.map(lambda each: _portion(target, options.seed, each, corpus, folder), portions)
        return [report for reports in found for report in reports]


def _portion(target: str, seed: int, cases: tuple[int, int], corpus: Path, folder: Path) -> list[dict[str, Any]]:
    """Cases of one process, and of further ones after each that died."""
    reports, (first, stop) = list[dict[str, Any]](), cases
    while first < stop:
        with tempfile.TemporaryDirectory(dir=folder) as work:
            report = _process(target, seed, first, stop, corpus, Path(work))
        reports.append(report)
        first = report["next"]
    return reports


def _process(target: str, seed: int, first: int, stop: int, corpus: Path, work: Path) -> dict[str, Any]:
    command = [
        sys.executable,
        "-m",
        "tests.hostile.fuzz",
        "worker",
        target,
        *map(str, (seed, first, stop, corpus, work)),
    ]
    quiet = {
        "MALLOC_ARENA_MAX": "1",
        "OMP_NUM_THREADS": "1",
        "PYTHONFAULTHANDLER": "1",
        "ARROW_DEFAULT_MEMORY_POOL": "system",
    }
    with (work / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **quiet}, stdout=log, stderr=log)
        changed = time.monotonic()
        last: bytes | None = None
        while process.poll() is None:
            time.sleep(0.02)
            at = _read(work / "case")
            if at != last:
                last, changed = at, time.monotonic()
            elif time.monotonic() - changed > STUCK + 60 * (last is None):
                process.send_signal(signal.SIGABRT)  # tells where it is
                process.wait()
    report: dict[str, Any] = json.loads(_read(work / "report") or "null") or {
        "refused": 0,
        "accepted": 0,
        "stopped": 0,
        "slowest": 0.0,
        "peak_mib": 0,
        "defects": [],
        "next": stop,
    }
    if process.returncode != 0:
        case = int(last or first)
        what = "stuck" if process.returncode == -signal.SIGABRT else f"the process ended with {process.returncode}"
        tail = (_read(work / "log") or b"").decode(errors="replace")[-1500:]
        report["defects"].append({"case": case, "what": what, "log": tail})
        report["next"] = case + 1
    return report


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def memory() -> str | None:
    """A folder in memory, where files cost nothing."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def worker(target: str, seed: int, first: int, stop: int, corpus: Path, work: Path) -> None:
    """Run cases in this process; tells in ``case`` which one it is at, and in ``report`` what came out."""
    from tests.hostile.guard import Guard, Violation
    from tests.hostile.targets import MIXES, READ_APART, TARGETS, outcome

    make = (TARGETS | MIXES)[target]
    inside = work / "inside"
    (inside / "tmp").mkdir(parents=True)
    tempfile.tempdir = str(inside / "tmp")
    _warm_up(target, make, corpus, inside)
    guard = Guard(inside)
    report: dict[str, Any] = {"refused": 0, "accepted": 0, "stopped": 0, "slowest": 0.0, "defects": [], "next": stop}
    seconds_apart = 0.0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    descriptor = os.open(work / "case", os.O_WRONLY | os.O_CREAT)
    for case in range(first, stop):
        os.pwrite(descriptor, f"{case:>12}".encode(), 0)
        rng, folder = random.Random(f"{seed}/{target}/{case}"), inside / "case"
        folder.mkdir()
        run_case = make(rng, corpus, folder)
        begun = time.process_time()
        try:
            if target in READ_APART:
                result, seconds_apart = _forked(guard, run_case, inside / "told")
                report[result] += 1
            else:
                with guard.watching():
                    report[outcome(run_case)] += 1
        except (Exception, Violation) as error:
            told = "".join(traceback.format_exception(error, limit=-4))
            report["defects"].append(
                {"case": case, "what": f"{type(error).__name__}: {error}"[:300], "log": told[-1500:]}
            )
        seconds = seconds_apart if target in READ_APART else time.process_time() - begun
        report["slowest"] = max(report["slowest"], seconds)
        if seconds > LIMIT:
            report["defects"].append({"case": case, "what": f"took {seconds:.1f} s", "log": ""})
        _remove(folder)
        report["peak_mib"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
        if case % 50 == 49 or case == stop - 1 or seconds > 1:
            (work / "report.new").write_text(json.dumps(report))
            (work / "report.new").replace(work / "report")
    (work / "report").write_text(json.dumps(report))
    sys.stdout.flush()
    os._exit(0)  # threads of a runtime that a case left need not be waited for


def _forked(guard: Guard, run_case: Callable[[], None], told: Path) -> tuple[str, float]:
    """A case in a process of its own, as the product reads data sets; ``stopped`` if it crashed or met its limits.

    Returns:
        What came out, and seconds of the processor.

    Raises:
        RuntimeError: whatever came out is a defect.
    """
    from tests.hostile.guard import Violation
    from tests.hostile.targets import outcome
    from ttscompile.trajectories.sandbox import MORE_SECONDS

    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (MORE_SECONDS, MORE_SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            with guard.watching():
                result = outcome(run_case)
        except (Exception, Violation) as error:
            result = "".join(traceback.format_exception(error, limit=-4))[-1500:]
        told.write_text(result)
        os._exit(0)
    _, status, usage = os.wait4(child, 0)
    seconds = usage.ru_utime + usage.ru_stime
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) != signal.SIGABRT:
        print("stopped by", signal.Signals(os.WTERMSIG(status)).name, run_case, flush=True)
        return "stopped", seconds
    result = (_read(told) or b"nothing was told").decode()
    told.unlink(missing_ok=True)
    if result not in ("refused", "accepted"):
        raise RuntimeError(result)
    return result, seconds


def _warm_up(target: str, make: Callable[..., Callable[[], None]], corpus: Path, inside: Path) -> None:
    """Import what cases import, and run some: what a first call loads and allocates is not a case's."""
    from tests.hostile import messages
    from tests.hostile.targets import READ_APART, outcome

    if target in ("checkpoint", "lerobot", "artifact", "swollen", "mixed", "structured"):
        import torch

        torch.set_num_threads(1)
        importlib.import_module("ttscompile.runtimes.onnxruntime.backend")  # which only an artifact that opens imports
    if target in (*READ_APART, "mixed"):
        from ttscompile.trajectories.sandbox import IMPORTS

        for name in (name for names in IMPORTS.values() for name in names):
            importlib.import_module(name)
    if target in ("protocol", "mixed"):
        messages.start()
    for i in range(0 if target in READ_APART else 30):
        folder = inside / "case"
        folder.mkdir()
        with suppress(Exception):  # a defect, which the cases find too
            outcome(make(random.Random(f"warm {i}"), corpus, folder))
        _remove(folder)


def _remove(folder: Path) -> None:
    shutil.rmtree(folder)


if __name__ == "__main__":
    if sys.argv[1:2] == ["worker"]:
        seed, first, stop = map(int, sys.argv[3:6])
        worker(sys.argv[2], seed, first, stop, Path(sys.argv[6]), Path(sys.argv[7]))
    else:
        raise SystemExit(main())
