"""Kill ``ttscompile build`` again and again, and resume it: ``python -m tests.hostile.kill_builds --kills 20``.

Each build is the command in a forked process, of a small policy of eight steps, where an older artifact is. It gets a
SIGKILL at a moment drawn at random: at one of its operations on files, or one of its looks at the clock. That is a
count, and no time passes by it; what a call takes follows from its plan. In the end nobody kills it, and the artifact
is what a build makes that nobody ever killed, to the byte.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.capturer import captured_once
from tests.conftest import ROOT, first_layer
from tests.exporter import exported_once
from tests.hostile.fuzz import memory
from tests.hostile.kill import PREFIX, changes_files, contents, fork
from tests.loops_once import measured_once
from ttscompile import builder
from ttscompile.artifact import write
from ttscompile.calibration import choose, kept, pipeline, trials
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.proposers import loops, precision
from ttscompile.calibration.proposers.loops import Loops
from ttscompile.calibration.trials import CONFIRMING
from ttscompile.cli import main
from ttscompile.core.lattice import Source
from ttscompile.frontends.checkpoint import plain_config, read_checkpoint
from ttscompile.measure.timer import Times

CONVERTING, ANSWERS, SEARCH, JUDGING, CONFIRM = "converting", "answers", "search", "judging", "confirming"
WRITING, MOVING = "writing", "moving"
IN_PARTS = (ANSWERS, SEARCH, JUDGING)
"""What a build that is gone on with does in part, so that some moments of these do not come again."""

ORDER = (CONVERTING, ANSWERS, SEARCH, CONVERTING, JUDGING, CONFIRM, WRITING, MOVING)
"""In which builds are killed, again and again: the second of a checkpoint that is converted for comparison, and after
the last there is nothing to go on from."""

STEPS, FURTHER_LOOPS = 8, (("dpmsolver++", 4), ("ddim", 4))
"""Of denoising; and the loops beside."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Kill; print a JSON document. Exit status 1 if anything was lost or found halfway."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=memory()) as folder, traced_once(Path(folder)):
        found = killed(Path(folder), random.Random(options.seed), options.kills)
    sys.stdout.write(json.dumps(found) + "\n")
    return 1 if found["failures"] else 0


def killed(folder: Path, draw: random.Random, kills: int) -> dict[str, Any]:
    """The phases in which builds were killed, the moments of each in one that was not, and what went wrong."""
    checkpoint, recording, old = folder / "policy.ckpt", folder / "calls.npz", folder / "old"
    save(checkpoint)
    record(recording)
    how: dict[str, Any] = {"loops": FURTHER_LOOPS, "precision": "int8", "prediction_horizon": "needed"}
    ttscompile.convert(checkpoint, old, **how)  # here and not in a forked process, so that those find all of it known
    whole, target = folder / "whole" / "compiled", folder / "killed" / "compiled"
    for path in (whole, target):
        shutil.copytree(old, path)
    words = ["build", str(checkpoint), "-t", str(recording), "--minutes", "2", "--error", "3", "--resume"]
    moments = json.loads(built([*words, "-o", str(whole)]))
    before, expected = contents(old), contents(whole)
    failures, died = [], list[str]()
    for phase in islice(cycle(ORDER), kills):
        number = draw.randint(1, max(moments[phase] // (4 if phase in IN_PARTS else 1), 1))
        died.append(built([*words, "-o", str(target)], phase, number))
        if (left := contents(target)) not in (before, expected):
            failures.append(f"killed at moment {number} of {phase}: neither the old nor the new: {sorted(left)}")
    built([*words, "-o", str(target)])
    if (made := contents(target)) != expected:
        other = [name for name in {**made, **expected} if made.get(name) != expected.get(name)]
        failures.append(f"resumed, it made other bytes: {sorted(other)}")
    failures += [f"left over: {path.name}" for path in target.parent.iterdir() if path != target]
    return {"killed": Counter(died), "moments": moments, "failures": failures}


def built(words: Sequence[str], phase: str = "", number: int = 0) -> str:
    """Build in another process; the phase in which it was killed, or of one that is not, as JSON, its moments."""
    read, write = os.pipe()

    def build() -> None:
        moments = Moments(write, phase, number)
        with pytest.MonkeyPatch.context() as patch, Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            moments.watch(patch)
            assert not main(words, standalone_mode=False), "it ended with an error"
        os.write(write, json.dumps(moments.seen).encode())

    child = fork(build)
    os.close(write)
    with os.fdopen(read) as pipe:
        told = pipe.read()
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status) != bool(phase) or (not phase and status):
        raise AssertionError(f"killed at moment {number} of {phase or 'none'}: it ended with {status}, {told!r}")
    return told


class Moments:
    """What a build does in this process, which gets a SIGKILL at one of these moments.

    Args:
        told: where the phase is written in which that happens.
        phase: of the last moment, and its ``number``; if there are fewer of it, the first of writing is the last.
    """

    def __init__(self, told: int, phase: str, number: int) -> None:
        self.seen, self.phase = Counter[str](), CONVERTING
        self._told, self._last, self._number = told, phase, number

    def come(self) -> None:
        """One more."""
        self.seen[self.phase] += 1
        late = self.phase == WRITING and self._last not in ("", WRITING, MOVING)
        if (self._last and self.seen[self._last] == self._number) or late:
            os.write(self._told, self.phase.encode())
            os.kill(os.getpid(), signal.SIGKILL)

    @contextmanager
    def within(self, phase: str) -> Iterator[None]:
        """What is done in the block is of a phase; what follows on the last ones, too."""
        before, self.phase = self.phase, phase
        yield
        self.phase = phase if phase in (WRITING, MOVING) else before

    def watch(self, patch: pytest.MonkeyPatch) -> None:
        """Count operations on files and looks at the clock from now on, and tell phases apart; nothing takes time."""
        sys.addaudithook(lambda name, arguments: self.come() if changes_files(name, arguments) else None)

        def of(phase: str, room: Any, name: str) -> None:
            done = getattr(room, name)

            def within(*args: Any, **how: Any) -> Any:
                with self.within(CONFIRM if CONFIRMING in args else phase):
                    return done(*args, **how)

            patch.setattr(room, name, within)

        for room in (choose, kept, loops, precision):
            of(JUDGING, room, "judge")
        of(WRITING, pipeline, "_write")

        @contextmanager
        def replacing(target: Path) -> Iterator[Callable[[Path], None]]:
            with write.replacing(target) as put:

                def moved(folder: Path) -> None:
                    with self.within(MOVING):
                        put(folder)

                yield moved

        def stage(_: object, what: str, *__: int) -> None:
            self.phase = ANSWERS if what.startswith(("original, ", "dense, ")) else SEARCH

        def elapsed(_: object) -> float:
            self.come()
            return 0.0

        patch.setattr(builder, "replacing", replacing)
        patch.setattr(builder, "FURTHER_LOOPS", FURTHER_LOOPS)
        patch.setattr(Bar, "stage", stage)
        patch.setattr(Clock, "elapsed", elapsed)
        patch.setattr(choose, "timed", timed)
        patch.setattr(Loops, "_measured", lambda *_: (1.0, 1.0))
        patch.setattr(trials, "MANY_DRAWS", 2)
        patch.setattr(trials, "MOST_DRAWS", 2)


def timed(entrants: Sequence[tuple[Any, Any]], *_: int) -> list[Times]:
    """A millisecond for each computed step, and less in eight bits."""
    counts = [int((plan.cells == Source.COMPUTE).any(-1).sum()) for _, plan in entrants]
    return [Times((n * (0.7 if plan.precision else 1.0),)) for n, (_, plan) in zip(counts, entrants, strict=True)]


@contextmanager
def traced_once(folder: Path) -> Iterator[None]:
    """As in other tests: what torch's tracer and exporter say of the one policy is kept."""
    with ExitStack() as once:
        for each in (captured_once(folder / "captures"), exported_once(folder / "exports"), measured_once()):
            once.enter_context(each)
        yield


def save(checkpoint: Path) -> None:
    """One narrow layer of the Push-T policy, as if it had been trained for fewer steps."""
    first_layer(ROOT / "examples" / "pusht" / "pusht_dpt_ema_fp16.ckpt", layer := checkpoint.parent / "layer", 32)
    payload = dict(read_checkpoint(layer / "policy.ckpt"))
    config = plain_config(payload["cfg"])
    config["policy"]["noise_scheduler"]["num_train_timesteps"] = config["policy"]["num_inference_steps"] = STEPS
    torch.save({**payload, "cfg": config}, checkpoint)


def record(path: Path) -> None:
    """Eight episodes of six calls: a slow walk."""
    draw = np.random.default_rng(0)
    walks = np.cumsum(draw.normal(0, 4, (48, 1, 20)), 0) + draw.uniform(200, 300, (48, 1, 20))
    np.savez(path, obs=np.repeat(walks, 2, 1).astype(np.float32), episode_ends=np.arange(6, 49, 6))


if __name__ == "__main__":
    raise SystemExit(run())
