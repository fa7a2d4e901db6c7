"""Run every command in surroundings that nobody thinks of: ``python -m tests.hostile.surroundings``.

Standard streams that are closed, full, or read by nobody; terminals of one column; no home; folders that are read-only,
full, or gone; few files that may be open. Whatever happens, a command ends with a status that is documented, says so in
a few lines without a traceback, and leaves nothing half written. Some surroundings need Linux and root, to mount.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SETTINGS: Mapping[str, str] = {
    "as it is": ":",
    "no HOME": "unset HOME",
    "HOME is no folder": "export HOME=/proc/nothing MPLCONFIGDIR=",
    "TERM=dumb": "export TERM=dumb",
    "LANG=C": "export LANG=C LC_ALL=C",
    "neither UTF-8 nor UTF-8 mode": "export LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0",
    "output in ASCII": "export PYTHONIOENCODING=ascii",
    "COLUMNS=1": "export COLUMNS=1",
    "COLUMNS=10000": "export COLUMNS=10000",
    "COLUMNS=many": "export COLUMNS=many FORCE_COLOR=1",
    "no TMPDIR": "export TMPDIR=/nowhere",
    "standard input closed": "exec <&-",
    "standard output closed": "exec >&-",
    "standard error closed": "exec 2>&-",
    "all three closed": "exec <&- >&- 2>&-",
    "standard output full": "exec >/dev/full",
    "standard error full": "exec 2>/dev/full",
    "one line is read": 'set -o pipefail; "$@" | head -1 >/dev/null; exit',
    "nothing is read": 'set -o pipefail; "$@" | exec <&-; exit',
    "in a folder that is gone": 'mkdir "$OUT/gone" && cd "$OUT/gone" && rmdir "$OUT/gone"',
    "in a folder whose name is no text": 'cd "$(mkdir -p "$TOP"/$\'\\xff\' && echo "$TOP"/$\'\\xff\')"',
    "40 open files": "ulimit -n 40",
    "12 open files": "ulimit -n 12",
    "files of 8 KiB": "ulimit -f 8",
}
MOUNTED: Mapping[str, str] = {
    "in a read-only folder": 'mkdir "$TOP/ro"; mount -t tmpfs -o ro tmpfs "$TOP/ro"; cd "$TOP/ro"',
    "results in a read-only folder": 'mount -t tmpfs -o ro tmpfs "$OUT"',
    "results on a full disk": 'mount -t tmpfs -o size=4k tmpfs "$OUT"; head -c 4096 /dev/zero >"$OUT/zeros"',
    "results on a disk of 24 KiB": 'mount -t tmpfs -o size=24k tmpfs "$OUT"',
    "read-only artifact": 'mount --bind "$TOP/A" "$TOP/A"; mount -o remount,ro,bind "$TOP/A"',
    "temporary files on a full disk": 'export TMPDIR="$TOP/t"; mkdir $TMPDIR; mount -t tmpfs -o size=4k tmpfs $TMPDIR',
}
"""What the shell does before a command; those below in a name space of mounts of their own."""

COMMANDS: Mapping[str, Sequence[str]] = {
    "help": ("--help",),
    "doctor": ("doctor", "A"),
    "inspect": ("inspect", "A"),
    "inspect a zip": ("inspect", "A.zip", "--json"),
    "inspect -o plan.png": ("inspect", "A", "-o", "OUT/plan.png"),
    "verify": ("verify", "V", "--json"),
    "predict": ("predict", "A", "--state", "0.5,-1", "--plot", "OUT/chunk.png"),
    "bench": ("bench", "A", "--calls", "1"),
    "bench --control-hz": ("bench", "A", "--control-hz", "1", "--margin-ticks", "0", "--calls", "1"),
    "inspect -o": ("inspect", "A", "-o", "OUT/page.html"),
    "bench -t": ("bench", "A", "-t", "calls.npz", "--calls", "2", "--plot", "OUT/frontier.svg"),
    "calibrate": ("calibrate", "OUT/B", "--trajectories", "calls.npz", "--max-minutes", "0.01"),
    "push --dry-run": ("push", "A", "org/name", "--dry-run"),
    "convert --single-file": ("convert", "policy.ckpt", "-o", "OUT/C", "--single-file", "OUT/one.onnx"),
    "build": ("build", "policy.ckpt", "-o", "OUT/C", "--trajectories", "demos.npz", "--minutes", "0.5"),
    "convert": ("convert", "policy.ckpt", "-o", "OUT/C", "--sampler", "ddim", "--steps", "2"),
}
NEED_CHECKPOINT = ("convert", "convert --single-file", "build", "verify")
STATUSES = {0, 2, 141}
"""All checks of the toy hold."""
LEFT = (".partial", ".replaced")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; print a JSON line for each surrounding. Exit status 1 if anything ended as it should not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = {**SETTINGS, **MOUNTED}
    parser.add_argument("--surrounding", choices=known, action="append")
    parser.add_argument("--command", choices=COMMANDS, action="append")
    parser.add_argument("--checkpoint", type=Path, help="of Push-T, for convert, build and verify, which take it")
    options = parser.parse_args(arguments)
    failures, commands = 0, options.command or [c for c in COMMANDS if options.checkpoint or c not in NEED_CHECKPOINT]
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        prepare(top, options.checkpoint)
        for name in options.surrounding or known:
            began, counted, wrong = time.monotonic(), Counter[int](), list[Any]()
            for command in commands:
                status, told = run(top, name, COMMANDS[command])
                counted[status] += 1
                if told:
                    wrong.append({"command": command, "status": status, "wrong": told})
            found = {"surrounding": name, "statuses": dict(sorted(counted.items())), "wrong": wrong}
            print(json.dumps(found | {"seconds": round(time.monotonic() - began, 1)}), flush=True)
            failures += len(wrong)
    return 1 if failures else 0


def prepare(top: Path, checkpoint: Path | None) -> None:
    """A small artifact, the same zipped, recorded calls and a checkpoint."""
    import numpy as np

    from tests.runtimes.toys import toy_program, written_artifact

    written_artifact(toy_program(), top / "A")
    shutil.make_archive(str(top / "A"), "zip", top / "A")
    obs = np.random.default_rng(0).standard_normal((8, 2), np.float32)
    np.savez(top / "calls.npz", obs=obs, episode_ends=[4, 8])
    pushed = np.random.default_rng(1).uniform(100, 400, (32, 2, 20)).astype(np.float32)
    np.savez(top / "demos.npz", obs=pushed, episode_ends=[8, 16, 24, 32])
    if checkpoint is not None:
        import ttscompile

        shutil.copy(checkpoint, top / "policy.ckpt")
        ttscompile.convert(checkpoint, top / "V", sampler="ddim", steps=2)


def run(top: Path, surrounding: str, words: Sequence[str]) -> tuple[int, str]:
    """Status of a command, and what is wrong with how it ended."""
    out, errors = top / "out", top / "errors"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    mounts = surrounding in MOUNTED
    if words[0] == "calibrate" and not mounts:
        shutil.copytree(top / "A", out / "B")
    setup = {**SETTINGS, **MOUNTED}[surrounding]
    if words[0] == "calibrate" and mounts:  # on the disk itself; where it does not fit there is none
        setup += '; cp -r "$TOP/A" "$OUT/B" 2>/dev/null'
    here = {name: top / name for name in ("A", "V", "A.zip", "calls.npz", "demos.npz", "policy.ckpt")}
    given = [str(here.get(word, word.replace("OUT", str(out)) if word.startswith("OUT/") else word)) for word in words]
    shell = ["bash", "-c", f'{setup}; exec "$@"', "bash", sys.executable, "-P", "-m", "ttscompile", *given]
    shell = ["unshare", "-m", *shell] if mounts else shell
    env = {**os.environ, "OUT": str(out), "TOP": str(top), "OMP_NUM_THREADS": "1"}
    with errors.open("wb") as file:
        status = subprocess.run(shell, cwd=top, env=env, stdout=subprocess.DEVNULL, stderr=file, timeout=900).returncode
    return status, judged(status, errors.read_text(errors="replace"), out)


def judged(status: int, told: str, out: Path) -> str:
    """What is wrong with an end; empty if nothing is."""
    if status not in STATUSES:
        return f"status {status}: {told[-600:]}"
    for word in ("Traceback", "defect: ", "Exception ignored", "Fatal Python"):
        if word in told:
            return f"{word}: {told[-600:]}"
    if status == 2 and told and not 0 < len(told.split("rror: ")[-1].splitlines()) <= 3:
        return f"no message of three lines: {told[-600:]}"
    left = [str(path.relative_to(out)) for path in out.rglob("*") if path.name.endswith(LEFT)]
    return f"left behind: {left}" if left else ""


if __name__ == "__main__":
    sys.exit(main())
