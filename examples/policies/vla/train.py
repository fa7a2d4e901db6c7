"""Train a policy of lerobot's from nothing on the demonstrations, on one or several processors; resumes where it was.

    OMP_NUM_THREADS=1 python examples/policies/vla/train.py smolvla DEMOS OUT --updates 4200 --decay 1400

The networks, their losses, processors and files are lerobot's. One observation, whose encoding is most of the work,
serves several noises and times. Beside its loss a network learns in training to say where the blocks are.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, distributed as dist, nn
from torch.multiprocessing.spawn import spawn

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))
os.environ["MUJOCO_GL"] = "disable"  # nothing is drawn, and the LLVM of OSMesa breaks that of triton

from dit import MultiTaskDiT
from environments.fetch_blocks import COLOURS, TASKS, instruction
from learner import CHUNK, UNIT, Learner, Statistics
from smolvla import SmolVLA

WARM_UP, SMOOTHING, AUXILIARY, REPORTED = 300, 0.999, 0.5, 50

Batch = tuple[dict[str, Any], Tensor, Tensor]


class Demonstrations:
    """Arrays on disk, opened as maps; more folders may come while training runs."""

    def __init__(self, root: Path) -> None:
        self.root, self.folders = root, dict[str, dict[str, npt.NDArray[Any]]]()
        self.scenes: list[list[tuple[str, int, int, int]]] = []
        self.look()

    def look(self) -> None:
        """Open the folders that are new."""
        for path in sorted(self.root.glob("[0-9][0-9][0-9][0-9]")):
            if path.name in self.folders:
                continue
            names = ("front", "wrist", "state", "blocks", "action")
            self.folders[path.name] = {name: np.load(path / f"{name}.npy", mmap_mode="r") for name in names}
            scenes = dict[int, list[tuple[str, int, int, int]]]()
            for begin, count, task, scene in np.load(path / "episodes.npy").tolist():
                scenes.setdefault(scene, []).append((path.name, begin, count, task))
            self.scenes += list(scenes.values())

    def statistics(self) -> Statistics:
        """Of state and action, over all that is there."""
        found = {}
        for key, name in (("observation.state", "state"), ("action", "action")):
            rows = np.concatenate([folder[name] for folder in self.folders.values()]).astype(np.float64)
            told = {"mean": rows.mean(0), "std": rows.std(0), "min": rows.min(0), "max": rows.max(0)}
            found[key] = {name: torch.tensor(value).float() for name, value in told.items()}
        return found

    def batch(self, size: int, random: np.random.Generator) -> Batch:
        """Frames as lerobot's processor takes them, which actions are none, and where the blocks are from the grip.

        Two episodes of a scene follow each other: pictures that are alike, and instructions that are not. The last
        result is ``[size, 4, 3]``: the block that was asked for, and then all three, in ``UNIT``.
        """
        rows, padding, places = list[dict[str, Any]](), [], []
        while len(rows) < size:
            scene = self.scenes[random.integers(len(self.scenes))]
            for chosen in random.permutation(len(scene))[:2]:
                name, begin, count, task = scene[chosen]
                folder, at = self.folders[name], int(random.integers(count))
                there = min(CHUNK, count - at)
                action = np.asarray(folder["action"][begin + at : begin + at + there])
                action = np.concatenate([action, np.repeat(action[-1:], CHUNK - there, 0)])
                frame = {key: folder[key][begin + at] for key in ("front", "wrist", "state")}
                text = instruction(TASKS[task], int(random.integers(100)))
                rows.append({**frame, "action": action, "task": text})
                padding.append(np.arange(CHUNK) >= there)
                offsets = folder["blocks"][begin + at].reshape(-1, 3) - frame["state"][:3]
                places.append(np.stack([offsets[list(COLOURS).index(TASKS[task].split()[-1])], *offsets]) / UNIT)
        stacked = {key: np.stack([row[key] for row in rows[:size]]) for key in ("front", "wrist", "state", "action")}
        given: dict[str, Any] = {
            f"observation.images.{key}": torch.from_numpy(stacked[key]).permute(0, 3, 1, 2).float() / 255
            for key in ("front", "wrist")
        }
        given["observation.state"] = torch.from_numpy(stacked["state"])
        given["action"], given["task"] = torch.from_numpy(stacked["action"]), [row["task"] for row in rows[:size]]
        return given, torch.from_numpy(np.stack(padding[:size])), torch.from_numpy(np.stack(places[:size]))


LEARNERS: dict[str, type[Learner]] = {"smolvla": SmolVLA, "multi_task_dit": MultiTaskDiT}


@dataclass
class Settings:
    """What the command line says."""

    policy: str
    demos: Path
    out: Path
    updates: int
    decay: int
    batch: int
    rate: float
    processes: int
    seed: int
    every: int
    port: int


def rate(settings: Settings, update: int) -> float:
    """Up, level, and at the end down in a cosine."""
    left = (settings.updates - update) / max(settings.decay, 1)
    down = 0.5 - 0.5 * math.cos(math.pi * min(1.0, max(left, 0.0)))
    return settings.rate * min(1.0, (update + 1) / WARM_UP) * (0.01 + 0.99 * down)


class Training:
    """What is trained, and how far it is: the state that was saved, or the beginning.

    Attributes:
        smoothed: the exponential mean of the weights, which is the policy that is saved.
        done: updates.
    """

    def __init__(self, settings: Settings) -> None:
        torch.manual_seed(settings.seed)
        self.learner = LEARNERS[settings.policy](torch.load("statistics.pt"))
        self.policy, self.places = self.learner.policy, self.learner.places
        every = [*self.policy.parameters(), *self.places.parameters()]
        self.parameters = [parameter for parameter in every if parameter.requires_grad]
        how: dict[str, Any] = {"betas": (0.9, 0.95), "weight_decay": 1e-4, "fused": True}
        self.optimizer = torch.optim.AdamW(self.parameters, settings.rate, **how)
        self.smoothed = {name: value.clone() for name, value in self.policy.state_dict().items()}
        self.done = 0
        if Path("state.pt").exists():
            state = torch.load("state.pt")
            self.done, self.smoothed = state["update"], state["smoothed"]
            self.policy.load_state_dict(state["policy"])
            self.places.load_state_dict(state["places"])
            self.optimizer.load_state_dict(state["optimizer"])

    def update(self, given: dict[str, Any], padding: Tensor, offsets: Tensor, settings: Settings) -> list[float]:
        """Learn from a batch; all losses."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate(settings, self.done)
        grip = given["observation.state"][:, :3].clone()
        loss, *others = self.learner.losses(self.learner.processors[0](given), padding, offsets, grip)
        self.optimizer.zero_grad(set_to_none=True)
        (loss + AUXILIARY * sum(others)).backward()
        averaged(self.parameters, settings.processes)
        nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimizer.step()
        share = min(SMOOTHING, (1 + self.done) / (10 + self.done))
        with torch.no_grad():
            for name, value in self.policy.state_dict().items():
                mean = self.smoothed[name]
                mean.lerp_(value, 1 - share) if value.is_floating_point() else mean.copy_(value)
        self.done += 1
        return [each.item() for each in (loss, *others)]

    def save(self) -> None:
        """Write the state, and the smoothed policy as lerobot's directory ``policy``; each is replaced as a whole."""
        present = {name: value.clone() for name, value in self.policy.state_dict().items()}
        state = {"policy": present, "smoothed": self.smoothed, "places": self.places.state_dict(), "update": self.done}
        torch.save({**state, "optimizer": self.optimizer.state_dict()}, "state.part")
        Path("state.part").rename("state.pt")
        self.policy.load_state_dict(self.smoothed)
        part, at = Path("policy.part"), Path("policy")
        shutil.rmtree(part, ignore_errors=True)
        self.policy.save_pretrained(part)
        for processor in self.learner.processors:
            processor.save_pretrained(part)
        self.policy.load_state_dict(present)
        (part / "update.json").write_text(json.dumps({"update": self.done}))
        shutil.rmtree(at, ignore_errors=True)
        part.rename(at)


def averaged(parameters: list[nn.Parameter], processes: int) -> None:
    """Replace gradients by their mean over processes."""
    if processes == 1:
        return
    there = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in there])
    dist.all_reduce(flat)
    for gradient, part in zip(there, flat.split([gradient.numel() for gradient in there]), strict=True):
        gradient.copy_(part.view_as(gradient) / processes)


def batches(settings: Settings, demonstrations: Demonstrations, first: int, rank: int) -> Iterator[tuple[int, Batch]]:
    """The remaining updates, with what each is computed from. New folders are looked for now and then."""
    for update in range(first, settings.updates):
        if update % 200 == 0:
            demonstrations.look()
        yield update, demonstrations.batch(settings.batch, np.random.default_rng((settings.seed, update, rank)))


def work(rank: int, settings: Settings) -> None:
    """One process."""
    torch.set_num_threads(1)
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    os.chdir(settings.out)
    if settings.processes > 1:
        address = f"tcp://127.0.0.1:{settings.port}"
        dist.init_process_group("gloo", init_method=address, rank=rank, world_size=settings.processes)
    demonstrations = Demonstrations(settings.demos)
    if rank == 0 and not Path("statistics.pt").exists():
        torch.manual_seed(settings.seed)
        LEARNERS[settings.policy].prepare()
        torch.save(demonstrations.statistics(), "statistics.pt")
    if settings.processes > 1:
        dist.barrier()
    training = Training(settings)
    since, losses = time.perf_counter(), list[list[float]]()
    for update, batch in batches(settings, demonstrations, training.done, rank):
        torch.manual_seed(settings.seed + 1000 * update + rank)
        losses.append(training.update(*batch, settings))
        if rank == 0 and len(losses) == REPORTED:
            took = (time.perf_counter() - since) / REPORTED
            report(training.done, losses, took, settings.updates, len(demonstrations.scenes))
            since, losses = time.perf_counter(), []
        if rank == 0 and (training.done % settings.every == 0 or training.done == settings.updates):
            training.save()
    if settings.processes > 1:
        dist.destroy_process_group()


def report(done: int, losses: list[list[float]], seconds: float, updates: int, scenes: int) -> None:
    """Add a line to ``log.jsonl``."""
    loss, told, seen = np.mean(losses, axis=0).tolist()
    line = {"update": done, "loss": loss, "places": told, "pictures": seen, "seconds": seconds}
    line |= {"hours_left": (updates - done) * seconds / 3600, "scenes": scenes}
    with Path("log.jsonl").open("a") as log:
        log.write(json.dumps({name: round(value, 4) for name, value in line.items()}) + "\n")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", choices=sorted(LEARNERS))
    parser.add_argument("demos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--updates", type=int, default=4_200)
    parser.add_argument("--decay", type=int, default=1_400, help="updates at the end in which the rate goes down")
    parser.add_argument("--batch", type=int, default=32, help="frames of one process")
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=200, help="updates between two checkpoints")
    parser.add_argument("--port", type=int, default=29511)
    settings = Settings(**vars(parser.parse_args()))
    settings.demos, settings.out = settings.demos.resolve(), settings.out.resolve()
    settings.out.mkdir(parents=True, exist_ok=True)
    if settings.processes == 1:
        work(0, settings)
    else:
        spawn(work, (settings,), settings.processes)


if __name__ == "__main__":
    main()
