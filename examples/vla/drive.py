"""Drive with a compiled vision-language-action policy: record calls for its calibration, and act tick by tick.

    ttscompile convert pretrained_model -o compiled/
    python examples/vla/drive.py compiled/ --tokenizer smolvlm2/ --record calls.npz
    ttscompile calibrate compiled/ --trajectories calls.npz
    ttscompile verify compiled/
    python examples/vla/drive.py compiled/ --tokenizer smolvlm2/

The robot here is made of random numbers: put your own cameras and joints in the place of ``Robot``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import PolicySpec
from ttscompile.core.tokenizer import TASK
from ttscompile.runtimes.instruct import Instruct

IMAGE = (48, 64)
"""Height and width of what the cameras give; the policy resizes images, whatever their size is."""


class Robot:
    """A stand-in: cameras that show noise, and joints that go where they are sent.

    Args:
        spec: of the policy, which says what there is to observe.
    """

    def __init__(self, spec: PolicySpec, seed: int) -> None:
        self._spec, self._rng = spec, np.random.default_rng(seed)
        self._image = {key: self._rng.uniform(0, 1, (1, 3, *IMAGE)) for key in self._images()}
        self._joints = self._rng.standard_normal((1, spec.chunk.action_dim)).astype(np.float32)

    def frame(self) -> dict[str, Any]:
        """One frame of one stream, under LeRobot's names: images ``[1, 3, H, W]`` in 0..1, and the state ``[1, D]``."""
        found: dict[str, Any] = {}
        for key, each in self._spec.observations.items():
            if each.image:
                self._image[key] = np.clip(self._image[key] + self._rng.normal(0, 0.02, (1, 3, *IMAGE)), 0, 1)
                found[key] = self._image[key].astype(np.float32)
            elif each.dtype == "float32":
                found[key] = self._joints[:, : each.shape[-1]]
        return found

    def go(self, action: np.ndarray) -> None:
        """Move a little towards ``[1, D]``."""
        self._joints = self._joints + 0.1 * (action - self._joints)

    def _images(self) -> list[str]:
        return [key for key, each in self._spec.observations.items() if each.image]


def main() -> None:
    """Record, or drive."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("compiled", type=Path)
    parser.add_argument("--tokenizer", type=Path, required=True, help="folder with the tokenizer.json of the policy")
    parser.add_argument("--tasks", nargs="+", default=["pick up the cup", "put it on the table"])
    parser.add_argument("--ticks", type=int, default=60, help="of an episode")
    parser.add_argument("--record", type=Path, help="write the frames of an episode for each task to this .npz")
    options = parser.parse_args()
    spec = load_artifact(options.compiled).manifest.spec
    policy = ttscompile.load(options.compiled, seed=0, tokenizer=options.tokenizer)
    episodes = [drive(policy, Robot(spec, seed), task, options.ticks) for seed, task in enumerate(options.tasks)]
    if options.record is not None:
        record(options.record, episodes, Instruct(spec, options.tokenizer))


def drive(policy: ttscompile.CompiledPolicy, robot: Robot, task: str, ticks: int) -> list[dict[str, Any]]:
    """One episode; the frames that were seen."""
    policy.reset()
    frames, calls, milliseconds = [], 0, 0.0
    for _ in range(ticks):
        before = policy.last_report
        frames.append(robot.frame() | {TASK: task})
        robot.go(policy.select_action(frames[-1]))
        report = policy.last_report
        if report is not None and report is not before:  # a new chunk, not the queue
            calls, milliseconds = calls + 1, milliseconds + report.timings.total
    print(f"{task!r}: {ticks} ticks, {calls} calls of {milliseconds / max(calls, 1):.0f} ms on average")
    return frames


def record(path: Path, episodes: list[list[dict[str, Any]]], instruct: Instruct) -> None:
    """Frames of episodes as ``ttscompile calibrate`` reads them: one row a frame, tokens in place of the text."""
    rows = [instruct(frame) for frames in episodes for frame in frames]
    arrays: dict[str, Any] = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
    ends = np.cumsum([len(frames) for frames in episodes])
    np.savez(path, **arrays, episode_ends=ends, meta=np.array('{"frames": true}'))
    print(f"{path}: {len(rows)} frames of {len(episodes)} episodes")


if __name__ == "__main__":
    main()
