"""Make what another machine is given: artifacts, and the actions that this machine computes with them.

    python tests/machines/made.py FOLDER

Needs the compiler. ``robot.py`` reads the folder on a machine that has the runtime alone. Two policies are Push-T's
transformer (matrix products, attention, GELU) and its U-Net (convolutions, group norms), each with blocks of eight bits
and of fp32, and with its own loop and one of few steps, in one artifact; observations and noise are drawn. Actions are
of whole episodes of three calls, so that the residuals of the call before are read.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.spec import FP32, INT8
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.random_calls import random_calls

ROOT = Path(__file__).resolve().parents[2]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from tests.once import Once  # noqa: E402
from tests.runtimes.toys import toy_program, written_artifact  # noqa: E402

CHECKPOINTS = {
    "transformer": ROOT / "examples/pusht/pusht_dpt_ema_fp16.ckpt",
    "unet": ROOT / "examples/policies/unet/pusht_unet_ema_fp16.ckpt",
}
STEPS, CALLS, EPISODES = 8, 3, 8
ACTIONS = "actions.npz"


def make(folder: Path) -> None:
    """Fill a folder that is not there yet.

    In it: ``NAME/artifact`` and ``NAME/actions.npz`` for each policy, and ``once/``, what the tests of the executor and
    of the command line share.
    """
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    unfinished.mkdir(parents=True)
    for name, checkpoint in CHECKPOINTS.items():
        artifact = unfinished / name / "artifact"
        ttscompile.convert(checkpoint, artifact, sampler="dpmsolver++", steps=STEPS, precision=INT8)
        calibrate(artifact, unfinished / name / "calls.npz")
        made: dict[str, Any] = dict(answers(artifact))
        np.savez(unfinished / name / ACTIONS, **made)
    Once(unfinished / "once").folder("toy", lambda directory: written_artifact(toy_program(), directory))
    unfinished.rename(folder)


def calibrate(artifact: Path, recording: Path) -> None:
    """Give an artifact evenly spaced steps and their correction, fitted to calls with drawn observations."""
    calls = random_calls(load_artifact(artifact).manifest.spec, CALLS * EPISODES, seed=0)
    arrays: dict[str, Any] = {key: np.concatenate([obs[key] for obs, _ in calls]) for key in calls[0][0]}
    ends = np.arange(1, EPISODES + 1) * CALLS
    np.savez(recording, episode_ends=ends, **arrays)
    ttscompile.calibrate(artifact, [recording], 0.5, learn=("interval",), correct=True, progress=False)


def answers(artifact: Path, precisions: Sequence[str] = (FP32, INT8)) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Of each call its observation and noise, and its actions.

    They are ``CALL/obs/KEY``, ``CALL/noise`` and, where the loop of a plan draws any, ``CALL/steps/PLAN``; and
    ``CALL/action/PRECISION/PLAN``.
    """
    opened = load_artifact(artifact)
    for number, (obs, noise) in enumerate(random_calls(opened.manifest.spec, CALLS, seed=1)):
        yield from ((f"{number}/obs/{key}", value) for key, value in obs.items())
        yield f"{number}/noise", noise.initial
    for name, plan in opened.plans.items():
        calls = random_calls(view_of(opened, plan).manifest.spec, CALLS, seed=1)  # which begin alike in all loops
        for number, (_, noise) in enumerate(calls):
            if noise.steps is not None:
                yield f"{number}/steps/{name}", noise.steps
        for precision in precisions:
            policy = open_policy(opened, plan=f"{name}@{precision}")
            for number, (obs, noise) in enumerate(calls):
                yield f"{number}/action/{precision}/{name}", policy.predict_action(obs, noise=noise)["action"]


if __name__ == "__main__":
    make(Path(sys.argv[1]))
