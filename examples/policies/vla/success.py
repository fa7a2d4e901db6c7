"""How often the original policy, run by lerobot, does what it is asked; by task.

    MUJOCO_GL=osmesa python examples/policies/vla/success.py OUT --episodes 10 --log success.log

``OUT`` is the folder that ``train.py`` writes. Seeds are the harness's: of demonstrations are none.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import SEEN, TASKS, UNSEEN, FetchBlocks, instruction

FIRST = 100_000


def episodes(policy: PreTrainedPolicy, processors: Any, seeds: Sequence[int], words: str) -> dict[str, list[bool]]:
    """Drive these episodes in lockstep; success by task.

    Args:
        policy: of lerobot.
        processors: before and after it.
        seeds: of the episodes.
        words: ``seen`` or ``unseen`` phrasings, or ``wrong``: those of the task that is four further.
    """
    before, after = processors
    worlds = [FetchBlocks() for _ in seeds]
    torch.manual_seed(seeds[0])
    policy.reset()
    for world, seed in zip(worlds, seeds, strict=True):
        world.phrasings = UNSEEN if words == "unseen" else SEEN
        world.reset(seed)
        if words == "wrong":
            world.instruction = instruction(TASKS[(TASKS.index(world.task) + 4) % len(TASKS)], seed)
    while not all(world.done for world in worlds):
        frames = [world.observe() for world in worlds]
        given: dict[str, Any] = {
            key: torch.from_numpy(np.stack([frame[key] for frame in frames]))
            for key in frames[0]
            if not key.startswith("observation.language")
        }
        given["task"] = [world.instruction for world in worlds]
        batch = before(given)
        for _ in range(policy.config.n_action_steps):  # a chunk is computed in the first of these, and then taken from
            actions = after(policy.select_action(batch)).numpy()
            for world, action in zip(worlds, actions, strict=True):
                if not world.done:
                    world.step(action)
    found = dict[str, list[bool]]()
    for world in worlds:
        found.setdefault(world.task, []).append(world.success)
        world.close()
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=10, help="of each task")
    parser.add_argument("--words", choices=["seen", "unseen", "wrong"], default="seen")
    parser.add_argument("--log", type=Path, help="add a line of JSON to this file")
    given = parser.parse_args()
    torch.set_num_threads(1)
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    log = None if given.log is None else given.log.resolve()
    os.chdir(given.out)
    update = json.loads(Path("policy/update.json").read_text())["update"]
    policy = get_policy_class(PreTrainedConfig.from_pretrained("policy").type).from_pretrained("policy").eval()
    processors = make_pre_post_processors(policy.config, pretrained_path="policy")
    began, done = time.perf_counter(), dict[str, list[bool]]()
    for number in range(given.episodes):
        first = FIRST + number * len(TASKS)
        for task, successes in episodes(policy, processors, range(first, first + len(TASKS)), given.words).items():
            done.setdefault(task, []).extend(successes)
    every = [success for successes in done.values() for success in successes]
    line: dict[str, Any] = {"update": update, "words": given.words, "episodes": len(every)}
    line |= {"success": round(float(np.mean(every)), 4), "seconds": round(time.perf_counter() - began)}
    text = json.dumps({**line, "by task": {task: sum(found) for task, found in sorted(done.items())}})
    print(text)
    if log is not None:
        with log.open("a") as handle:
            handle.write(text + "\n")


if __name__ == "__main__":
    main()
