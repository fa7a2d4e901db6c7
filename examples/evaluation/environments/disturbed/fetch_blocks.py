"""Fetch with blocks: other words, other light, cameras that fail, a world that changes, and long episodes."""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from .. import Array, Frame
from ..fetch_blocks import TASKS, UNSEEN, FetchBlocks, instruction

BROWN = (0.45, 0.28, 0.16, 1.0)
LIGHT = 0.5
"""Share of the light that is left."""
NOISE = 0.05
"""Standard deviation of every channel of every pixel, of 0..1."""
SHAKE = 0.01
"""Metres, standard deviation of the place of both cameras, anew in each frame."""
SWAY, PERIOD = 0.02, 25
"""Metres that both cameras sway to each side, and steps that they take there and back: 1 s."""
LATE = 2
"""Steps by which pictures are behind the state: 0.08 s."""
CHANGES, MOVES, LONGER = 16, 12, 100
"""Steps after which the instruction changes, and the block is moved; and after which such an episode ends."""
MOVED = 0.06
"""Metres that the block is moved."""
INSTRUCTIONS = 10
"""One after the other, in a long episode."""


class Unseen(FetchBlocks):
    """Instructions in phrasings that no demonstration has."""

    title = "Fetch with blocks, unseen phrasings"

    def __init__(self) -> None:
        super().__init__()
        self.phrasings = UNSEEN


class Wrong(FetchBlocks):
    """The instruction is that of another task, of another kind and colour; success is still that of the first."""

    title = "Fetch with blocks, wrong instruction"

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed."""
        super().reset(seed, task, scene)
        self.instruction = instruction(other(self.task), seed)


class Table(FetchBlocks):
    """The table is brown, where recordings have a white one."""

    title = "Fetch with blocks, a brown table"

    def __init__(self) -> None:
        super().__init__()
        table = self._model.geom("table0").id
        self._model.geom_matid[table], self._model.geom_rgba[table] = -1, BROWN


class Dark(FetchBlocks):
    """Half of the light."""

    title = "Fetch with blocks, half of the light"

    def __init__(self) -> None:
        super().__init__()
        for light in (self._model.light_ambient, self._model.light_diffuse, self._model.light_specular):
            light *= LIGHT
        for light in (self._model.vis.headlight.ambient, self._model.vis.headlight.diffuse):
            light *= LIGHT


class Seeded(FetchBlocks):
    """Counts steps, so that what is drawn is a function of seed and step."""

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed."""
        super().reset(seed, task, scene)
        self._now = [seed, 0]

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        super().step(action)
        self._now[1] += 1

    def _random(self) -> np.random.Generator:
        return np.random.default_rng(self._now)


class Noisy(Seeded):
    """Both cameras have noise."""

    title = "Fetch with blocks, noise in the pictures"

    def observe(self) -> Frame:
        """As ``FetchBlocks`` has it, with noise."""
        random, frame = self._random(), super().observe()
        for key in ("observation.images.front", "observation.images.wrist"):
            errors = random.normal(0, NOISE, frame[key].shape).astype(np.float32)
            frame[key] = np.clip(frame[key] + errors, 0, 1)
        return frame


class Shaken(Seeded):
    """Both cameras shake."""

    title = "Fetch with blocks, cameras that shake"

    def observe(self) -> Frame:
        """From cameras that are not where they were."""
        places = self._model.cam_pos.copy()
        self._model.cam_pos += self._moved(places.shape)
        mujoco.mj_forward(self._model, self._data)
        frame = super().observe()
        self._model.cam_pos[:] = places
        mujoco.mj_forward(self._model, self._data)
        return frame

    def _moved(self, shape: tuple[int, ...]) -> Array:
        return self._random().normal(0, SHAKE, shape)


class Swaying(Shaken):
    """Both cameras sway, as on a torso that does not stand still: along each axis with a phase of the seed."""

    title = "Fetch with blocks, cameras that sway"

    def _moved(self, shape: tuple[int, ...]) -> Array:
        seed, step = self._now
        phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, shape)
        return SWAY * np.sin(2 * np.pi * step / PERIOD + phases)


class Late(FetchBlocks):
    """Pictures come late; the state does not."""

    title = "Fetch with blocks, late pictures"

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed."""
        super().reset(seed, task, scene)
        self._frames = deque([super().observe()], LATE + 1)

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        super().step(action)
        self._frames.append(super().observe())

    def observe(self) -> Frame:
        """The pictures of two steps ago, and the state of now."""
        return {**self._frames[0], "observation.state": self.state()}


class Changed(FetchBlocks):
    """For the first steps another task is asked for; then the instruction changes."""

    title, max_steps = "Fetch with blocks, the instruction changes", LONGER

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed."""
        super().reset(seed, task, scene)
        self._then, self.instruction = self.instruction, instruction(other(self.task), seed)

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        super().step(action)
        if self._steps == CHANGES:
            self.instruction = self._then


class Moved(Seeded):
    """Somebody moves the block that was asked for."""

    title, max_steps = "Fetch with blocks, the block is moved", LONGER

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        super().step(action)
        if self._steps != MOVES or self.done:
            return
        start, was = self._blocks[self._asked], self.block(self._asked)
        others = [self.block(number) for number in range(len(self._blocks)) if number != self._asked]
        random = self._random()
        for _ in range(100):
            angle = random.uniform(0, 2 * np.pi)
            place = was[:2] + MOVED * np.array([np.cos(angle), np.sin(angle)])
            room = min(float(np.linalg.norm(place - each[:2])) for each in (*others, self.grip))
            if room > MOVED and np.all(place > (1.2, 0.6)) and np.all(place < (1.42, 0.9)):
                break
        else:
            return  # there is no room
        self._data.qpos[start : start + 2] = place
        mujoco.mj_forward(self._model, self._data)
        self._was = self.block(self._asked)


class Long(FetchBlocks):
    """Ten instructions, one after the other; the score is the share that was followed.

    Where one was followed, or as many steps as an episode has were in vain, the blocks are put elsewhere, away from the
    hand, and the next one is given. Nobody resets the policy, and the hand goes on from where it is.
    """

    title, max_steps = f"Fetch with blocks, {INSTRUCTIONS} instructions in a row", INSTRUCTIONS * FetchBlocks.max_steps

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed, which decides the later places and instructions, too."""
        super().reset(seed, task, scene)
        self._later = np.random.default_rng((seed, 2))
        self.task = ""  # none is the episode's
        self._given, self._followed, self.measures = 1, 0, {"followed": 0.0}

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        super().step(action)
        over = self.success or self._steps == FetchBlocks.max_steps
        self._followed += self.success
        self.score, self.measures = self._followed / INSTRUCTIONS, {"followed": float(self._followed)}
        self.done, self.success = over and self._given == INSTRUCTIONS, self._followed == INSTRUCTIONS
        if over and not self.done:
            self._given += 1
            self._place(self._later, self.grip[:2])
            self._data.qvel[:] = 0.0
            mujoco.mj_forward(self._model, self._data)
            self._ask(str(self._later.choice(TASKS)), int(self._later.integers(100)))


def other(task: str) -> str:
    """A task of another kind, with a block of another colour."""
    return TASKS[(TASKS.index(task) + 4) % len(TASKS)]


DISTURBED: dict[str, type[FetchBlocks]] = {
    "unseen": Unseen,
    "wrong": Wrong,
    "table": Table,
    "dark": Dark,
    "noisy": Noisy,
    "shaken": Shaken,
    "swaying": Swaying,
    "late": Late,
    "long": Long,
    "changed": Changed,
    "moved": Moved,
}
