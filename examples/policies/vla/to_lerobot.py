"""The demonstrations as a LeRobot data set with videos, by lerobot's own writer.

python examples/policies/vla/to_lerobot.py DEMOS OUT --episodes 24
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import SIZE, TASKS, FetchBlocks, instruction


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=24, help="the first so many")
    given = parser.parse_args()
    video = {"dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {f"observation.images.{name}": video for name in ("front", "wrist")}
    for key in ("observation.state", "action"):
        features[key] = {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "gripper"]}
    written = LeRobotDataset.create("local/fetch-blocks", int(FetchBlocks.hz), features, root=given.out)
    left = given.episodes
    for folder in sorted(given.demos.glob("[0-9][0-9][0-9][0-9]")):
        held = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("front", "wrist", "state", "action")}
        for begin, count, task, scene in np.load(folder / "episodes.npy").tolist()[:left]:
            text = instruction(TASKS[task], scene)
            for row in range(begin, begin + count):
                frame = {f"observation.images.{name}": np.asarray(held[name][row]) for name in ("front", "wrist")}
                frame |= {
                    "observation.state": np.asarray(held["state"][row]),
                    "action": np.asarray(held["action"][row]),
                }
                written.add_frame({**frame, "task": text})
            written.save_episode()
            left -= 1
        if not left:
            break
    written.finalize()


if __name__ == "__main__":
    main()
