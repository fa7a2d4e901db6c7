"""Fetch's arm over three coloured blocks: an instruction says which block, and what to do with it.

The scene does not say what to do: every scene has all three blocks, and every instruction can be followed in it. The
model of the arm is Gymnasium-Robotics'. Actions are ``[4]``: displacement of the gripper and its opening, -1..1.
"""

from __future__ import annotations

import atexit
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import gymnasium_robotics
import mujoco
import numpy as np
import numpy.typing as npt

from . import Array, Frame

FloatArray = npt.NDArray[np.float64]

COLOURS = {"red": "0.85 0.1 0.1 1", "green": "0.1 0.65 0.15 1", "blue": "0.1 0.2 0.85 1"}
KINDS = ("touch", "push left", "push right", "lift")
TASKS = tuple(f"{kind} {colour}" for kind in KINDS for colour in COLOURS)
"""The twelve tasks; the seed modulo their count says which one an episode has."""

_LEFT_OR_RIGHT = (
    "push the {} block to the {}",
    "push the {} cube {}",
    "move the {} block to the {}",
    "slide the {} block to the {} side",
    "shove the {} cube to the {}",
)
_LEFT_OR_RIGHT_UNSEEN = ("slide the {} cube {}", "move the {} cube to the {} side")
SEEN: Mapping[str, tuple[str, ...]] = {
    "touch": (
        "touch the {} block",
        "reach for the {} block",
        "go to the {} cube",
        "move the gripper to the {} block",
        "put the gripper on the {} cube",
    ),
    "push": _LEFT_OR_RIGHT,
    "lift": (
        "lift the {} block",
        "pick up the {} block",
        "raise the {} cube",
        "grasp the {} block and lift it",
        "pick the {} cube up",
    ),
}
"""By kind, the phrasings of demonstrations."""
UNSEEN: Mapping[str, tuple[str, ...]] = {
    "touch": ("touch the {} cube", "reach the {} block", "move to the {} cube"),
    "push": _LEFT_OR_RIGHT_UNSEEN,
    "lift": ("lift the {} cube up", "grasp and raise the {} block"),
}
"""By kind, phrasings that no demonstration has; their words occur in others."""

WORDS = tuple(
    sorted(
        {*COLOURS, "left", "right"}.union(
            *(text.replace("{}", "").split() for some in (SEEN, UNSEEN) for texts in some.values() for text in texts)
        )
    )
)
"""Of all phrasings."""
BEFORE, LENGTH = 8, 12
"""The policy's tokenizer has so many tokens before ``WORDS``; so many tokens are read of a text."""

SIZE = 96
"""Pixels of a side of both cameras."""
HALF = 0.022
"""Half of a block's edge, metres."""
TABLE = 0.4
"""Height of the table, metres."""
PUSHED, LIFTED = 0.06, 0.05
"""Metres that a block has to move."""
REACH = 0.025
"""Metres that an action of 1 asks for."""
HALF_OPEN = 0.025
"""Metres that a finger is from the middle where the action is 0."""
_POINTING_DOWN = (1.0, 0.0, 1.0, 0.0)
_TO_THE_FINGERS = (0.6015, 0.3717, -0.3717, -0.6015)
"""Of the camera on the gripper, which hangs in front of it and looks down, and back by 27 degrees."""
_SUBSTEPS = 20

_SCENE = """
<mujoco>
  <compiler angle="radian" meshdir="{assets}/stls/fetch" texturedir="{assets}/textures"/>
  <option timestep="0.002"/>
  <visual><quality shadowsize="0" offsamples="0"/><global offwidth="640" offheight="640"/></visual>
  <include file="{assets}/fetch/shared.xml"/>
  <worldbody>
    <geom name="floor0" pos="0.8 0.75 0" size="0.85 0.7 1" type="plane" condim="3" material="floor_mat"/>
    <include file="{assets}/fetch/robot.xml"/>
    <body pos="1.3 0.75 0.2" name="table0">
      <geom size="0.25 0.35 0.2" type="box" mass="2000" material="table_mat" name="table0"/>
    </body>
    {blocks}
    <camera name="front" pos="1.85 0.75 0.9" xyaxes="0 1 0 -0.66 0 0.75" fovy="33"/>
    <light directional="true" ambient="0.3 0.3 0.3" diffuse="0.7 0.7 0.7" specular="0.2 0.2 0.2" castshadow="false"
      pos="0 0 4" dir="0 0 -1" name="light0"/>
  </worldbody>
  <actuator>
    <position ctrllimited="true" ctrlrange="0 0.2" joint="robot0:l_gripper_finger_joint" kp="30000"/>
    <position ctrllimited="true" ctrlrange="0 0.2" joint="robot0:r_gripper_finger_joint" kp="30000"/>
  </actuator>
</mujoco>
"""
_BLOCK = """
    <body name="{name}" pos="1.3 0.75 0.45">
      <joint name="{name}" type="free" damping="0.01"/>
      <geom name="{name}" size="{half} {half} {half}" type="box" condim="4" rgba="{rgba}" friction="1 0.01 0.0001"
        mass="0.5"/>
    </body>"""


def instruction(task: str, number: int, phrasings: Mapping[str, tuple[str, ...]] = SEEN) -> str:
    """A task in words.

    Args:
        task: one of ``TASKS``.
        number: which of the phrasings, modulo their count.
        phrasings: ``SEEN`` or ``UNSEEN``.
    """
    kind, *direction, colour = task.split()
    templates = phrasings[kind]
    return templates[number % len(templates)].format(colour, *direction)


def template(task: str, seed: int, phrasings: Mapping[str, tuple[str, ...]] = SEEN) -> str:
    """The phrasing of the episode of a seed, with ``{}`` for colour and direction."""
    templates = phrasings[task.split()[0]]
    return templates[_number(seed) % len(templates)]


def _number(seed: int) -> int:
    return int(np.random.default_rng((seed, 1)).integers(100))


def tokens(text: str) -> Frame:
    """What the policy is told: a token a word, as its tokenizer makes them, and which of them count; ``[LENGTH]``."""
    made = [BEFORE + WORDS.index(word) for word in text.split()]
    row = np.zeros(LENGTH, np.int64)
    row[: len(made)] = made
    counted = np.arange(LENGTH) < len(made)
    return {"observation.language.tokens": row, "observation.language.attention_mask": counted}


def _model() -> mujoco.MjModel:
    assets = Path(gymnasium_robotics.__file__).parent / "envs" / "assets"
    blocks = "".join(_BLOCK.format(name=name, rgba=rgba, half=HALF) for name, rgba in COLOURS.items())
    scene = mujoco.MjSpec.from_string(_SCENE.format(assets=assets, blocks=blocks))
    wrist = scene.body("robot0:gripper_link").add_camera(name="wrist", pos=(-0.1, 0.0, 0.15), fovy=75.0)
    wrist.quat = _TO_THE_FINGERS
    model = scene.compile()
    hidden = model.body("robot0:mocap").id
    model.geom_rgba[model.geom_bodyid == hidden, 3] = 0.0  # the cross that marks where the hand is asked to be
    return model


@cache
def _renderer(size: int) -> mujoco.Renderer:
    """The only one of its size, for all environments: they differ in what is drawn, not in meshes and textures.

    Where a MuJoCo renderer is freed, it deletes the textures and buffers of whichever is current, so that another
    environment sees a frozen picture from then on. So none is freed before the end of the process.
    """
    renderer = mujoco.Renderer(_model(), size, size)
    atexit.register(renderer.close)
    return renderer


class FetchBlocks:
    """See ``Environment``. The score is 1 at success and else 0.

    Attributes:
        instruction: ``task`` in words; may be assigned, to ask for something else than what is measured.
        phrasings: ``SEEN`` or ``UNSEEN``, which of them ``reset`` takes words from.
    """

    title, hz, max_steps = "Fetch with blocks", 25.0, 60
    displacements: tuple[int, ...] = (0, 1, 2)

    def __init__(self) -> None:
        self._model = _model()
        self._data = mujoco.MjData(self._model)
        self._hand = self._model.body("robot0:gripper_link").id
        joints = self._model.jnt_qposadr
        self._fingers = [joints[self._model.joint(f"robot0:{side}_gripper_finger_joint").id] for side in "lr"]
        self._blocks = [joints[self._model.joint(name).id] for name in COLOURS]
        self._begin()
        self.phrasings: Mapping[str, tuple[str, ...]] = SEEN
        self.task, self.instruction, self.done, self.success, self.score = "", "", True, False, 0.0
        self.measures: dict[str, float] = {}

    def _begin(self) -> None:
        """Bring the hand over the table once; every episode starts from there."""
        data = self._data
        for name, value in {"slide0": 0.405, "slide1": 0.48, "slide2": 0.0}.items():
            data.joint(f"robot0:{name}").qpos[0] = value
        for number, block in enumerate(self._blocks):
            data.qpos[block : block + 3] = 1.2 + 0.1 * number, 1.0, TABLE + HALF
        for weld in range(self._model.neq):
            self._model.eq_data[weld, 3:10] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        mujoco.mj_forward(self._model, data)
        # Gymnasium-Robotics' own start of the hand: from where the arm is, to in front of the robot.
        data.mocap_pos[0] = np.array([-0.498, 0.005, -0.431 + 0.2]) + data.site("robot0:grip").xpos
        data.mocap_quat[0] = _POINTING_DOWN
        mujoco.mj_step(self._model, data, 200)
        self._start = data.qpos.copy()
        self._middle = data.mocap_pos[0].copy()

    def reset(self, seed: int, task: str | None = None, scene: int | None = None) -> None:
        """Start the episode of this seed.

        Args:
            seed: where hand and blocks are, and the words are drawn from it.
            task: one of ``TASKS``; None for the one whose number is the seed modulo their count.
            scene: a seed for hand and blocks alone.
        """
        random = np.random.default_rng(seed if scene is None else scene)
        data = self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[:] = self._start
        self._place(random)
        data.mocap_pos[0] = self._middle
        data.mocap_quat[0] = _POINTING_DOWN
        mujoco.mj_forward(self._model, data)
        self._move(random.uniform((-0.1, -0.12, -0.06), (0.08, 0.12, 0.06)), 1.0, 60)
        self.task = TASKS[seed % len(TASKS)] if task is None else task
        self._ask(self.task, _number(seed))
        self.score = 0.0

    def _place(self, random: np.random.Generator, *taken: FloatArray) -> None:
        """Put the blocks on the table, apart from each other and from the places ``[2]`` that are taken."""
        places = list(taken)
        while len(places) < len(taken) + len(self._blocks):
            place = random.uniform((1.2, 0.6), (1.42, 0.9))
            if all(np.linalg.norm(place - other) > 0.09 for other in places):
                places.append(place)
        for block, place in zip(self._blocks, places[len(taken) :], strict=True):
            self._data.qpos[block : block + 7] = (*place, TABLE + HALF, 1.0, 0.0, 0.0, 0.0)

    def _ask(self, task: str, number: int) -> None:
        """From here on this is to be done, in the phrasing of this number."""
        self._doing, self.instruction = task, instruction(task, number, self.phrasings)
        self._asked = list(COLOURS).index(task.split()[-1])
        self._was = self.block(self._asked)
        self._steps, self.done, self.success = 0, False, False

    def _move(self, displacement: FloatArray, opening: float, substeps: int) -> None:
        data = self._data
        data.mocap_pos[0] = data.xpos[self._hand] + displacement
        data.mocap_quat[0] = _POINTING_DOWN
        data.ctrl[:] = HALF_OPEN * (opening + 1.0)
        mujoco.mj_step(self._model, data, substeps)
        mujoco.mj_forward(self._model, data)

    @property
    def grip(self) -> FloatArray:
        """Where the tips of the fingers are, ``[3]``, metres."""
        return np.array(self._data.site("robot0:grip").xpos)

    @property
    def opening(self) -> float:
        """How far a finger is from the middle, metres."""
        return float(np.mean(self._data.qpos[self._fingers]))

    def block(self, number: int) -> FloatArray:
        """Where a block is, ``[3]``, metres; number in the order of ``COLOURS``."""
        start = self._blocks[number]
        return np.array(self._data.qpos[start : start + 3])

    def observe(self) -> Frame:
        """Both cameras, float32 ``[3, SIZE, SIZE]`` of 0..1, ``observation.state`` ``[4]``, and ``tokens``."""
        pictures = {f"observation.images.{name}": self.view(name) for name in ("front", "wrist")}
        frames = {key: np.moveaxis(picture, -1, 0).astype(np.float32) / 255 for key, picture in pictures.items()}
        return {**frames, "observation.state": self.state(), **tokens(self.instruction)}

    def state(self) -> npt.NDArray[np.float32]:
        """``[4]``: grip, metres, and opening, metres."""
        return np.array([*self.grip, self.opening], np.float32)

    def view(self, camera: str, size: int = SIZE) -> npt.NDArray[np.uint8]:
        """What a camera sees now, RGB ``[size, size, 3]``; ``camera`` is ``front`` or ``wrist``."""
        renderer, seen_by = _renderer(size), mujoco.MjvCamera()
        seen_by.type, seen_by.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._model.camera(camera).id
        everything, options = mujoco.mjtCatBit.mjCAT_ALL.value, mujoco.MjvOption()
        mujoco.mjv_updateScene(self._model, self._data, options, None, seen_by, everything, renderer.scene)
        return np.asarray(renderer.render())

    def step(self, action: Array) -> None:
        """Move for 0.04 s."""
        given = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        self._move(given[:3] * REACH, float(given[3]), _SUBSTEPS)
        self._steps += 1
        self.success = self.success or self._solved()
        self.score = float(self.success)
        self.done = self.success or self._steps == self.max_steps

    def _solved(self) -> bool:
        now = self.block(self._asked)
        if self._doing.startswith("touch"):
            return float(np.linalg.norm(self.grip - now - (0.0, 0.0, HALF))) < 0.03
        if self._doing.startswith("lift"):
            return bool(now[2] - self._was[2] > LIFTED)
        sign = 1.0 if "left" in self._doing else -1.0
        return bool(sign * (now[1] - self._was[1]) > PUSHED)

    def rest(self) -> Array:
        """No displacement, and the fingers stay as they are."""
        return np.array([0.0, 0.0, 0.0, np.clip(self.opening / HALF_OPEN - 1.0, -1.0, 1.0)], np.float32)

    def picture(self) -> npt.NDArray[np.uint8]:
        """From the fixed camera. Without a display set MUJOCO_GL=osmesa or egl."""
        return self.view("front", 480)

    def close(self) -> None:
        """Nothing is to be freed: the renderer is the process's."""


ENVIRONMENT = FetchBlocks
