"""The world of instructions: what is asked decides, the experts do it, and its tokens are those of the policy."""

import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from .recipes import script

os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported; there is no display
MISSING = importlib.util.find_spec("gymnasium_robotics") is None
pytestmark = pytest.mark.skipif(
    MISSING, reason="NO TESTS OF FETCH-BLOCKS: gymnasium_robotics is not installed; pip install 'ttscompile[examples]'"
)


@pytest.fixture(scope="module")
def recipe() -> Iterator[ModuleType]:
    """The demonstrations of ``examples/policies/vla``."""
    folder = Path(__file__).parents[2] / "examples" / "policies" / "vla"
    sys.path.insert(0, str(folder))
    try:
        yield script(folder, "demonstrations")
    finally:
        sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def world(recipe: ModuleType) -> Iterator[Any]:
    made = recipe.FetchBlocks()
    yield made
    made.close()


def test_the_end_of_a_world_does_not_freeze_the_pictures_of_another(recipe: ModuleType) -> None:
    def risen(world: Any) -> Any:
        for _ in range(8):
            world.step(np.array([0.0, 0.0, 1.0, -1.0], np.float32))
        return world.observe()["observation.images.front"]

    other, world, alone = (recipe.FetchBlocks() for _ in range(3))
    for each in (other, world, alone):
        each.reset(5)
        first = each.observe()["observation.images.front"]
    expected = risen(alone)
    assert not np.array_equal(first, expected)
    world.observe()
    other.close()
    del other
    assert np.array_equal(risen(world), expected)


def test_every_task_can_be_done_in_the_same_scene(recipe: ModuleType, world: Any) -> None:
    for task in recipe.TASKS:
        world.reset(5, task, 5)
        while not world.done:
            world.step(recipe.act(world, task))
        assert world.success, task


def test_whoever_does_something_else_fails(recipe: ModuleType, world: Any) -> None:
    """An expert that heard another colour, or another direction."""
    for task, done in (("lift red", "lift blue"), ("push left green", "push right green"), ("lift red", "touch red")):
        world.reset(5, task, 5)
        while not world.done:
            world.step(recipe.act(world, done))
        assert not world.success, (task, done)


def test_the_first_pictures_do_not_say_what_is_asked(recipe: ModuleType, world: Any) -> None:
    frames = []
    for task in recipe.TASKS:
        world.reset(7, task, 7)
        frames.append(world.observe())
    for key in ("observation.images.front", "observation.images.wrist", "observation.state"):
        assert all(np.array_equal(frames[0][key], frame[key]) for frame in frames), key
    said = {frame["observation.language.tokens"].tobytes() for frame in frames}
    assert len(said) == len(recipe.TASKS)


def column(picture: np.ndarray) -> float:
    """Where the green block is, pixels from the left."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    return float(np.argwhere((green > red + 60) & (green > blue + 60) & (red < 100))[:, 1].mean())


def test_a_block_that_lies_still_moves_in_the_picture_of_the_gripper_alone(world: Any) -> None:
    world.reset(3)
    before = {name: column(world.view(name)) for name in ("front", "wrist")}
    for _ in range(2):
        world.step(np.array([0, 1, 0, 1], np.float32))
    moved = {name: abs(column(world.view(name)) - was) for name, was in before.items()}
    assert moved["wrist"] > 5 and moved["front"] < 1, moved


def test_phrasings_that_are_unseen_have_words_that_are_not() -> None:
    from environments import fetch_blocks

    seen = {word for texts in fetch_blocks.SEEN.values() for text in texts for word in text.split()}
    for kind, texts in fetch_blocks.UNSEEN.items():
        for text in texts:
            assert text not in fetch_blocks.SEEN[kind]
            assert set(text.split()) <= seen, text


def test_a_demonstration_has_a_row_for_each_step(recipe: ModuleType, world: Any) -> None:
    recorded = recipe.episode(world, recipe.SEEDS, "touch red", 0.1)
    steps = len(recorded["action"])
    shapes = {name: array.shape[1:] for name, array in recorded.items()}
    assert {len(array) for array in recorded.values()} == {steps} and steps > recipe.AFTER
    pictures = {"front": (96, 96, 3), "wrist": (96, 96, 3)}
    assert shapes == {**pictures, "state": (4,), "blocks": (9,), "action": (4,)}
    assert np.abs(recorded["action"]).max() <= 1


def test_success_is_counted_by_phrasing(recipe: ModuleType) -> None:
    folder = Path(__file__).parents[2] / "examples" / "policies" / "vla"
    by_phrasing = script(folder, "phrasings").by_phrasing
    world, seeds, asked = recipe.FetchBlocks(), range(40), dict[int, str]()
    for seed in seeds:
        world.reset(seed)
        asked[seed] = world.instruction
    episodes = [{"seed": n, "task": recipe.TASKS[n % 12], "success": n % 3 == 0} for n in seeds]
    found = by_phrasing({"environment": "fetch-blocks", "variants": [{"episodes": episodes}] * 2})
    assert sum(len(one) for one, _ in found.values()) == len(seeds)
    assert sum(map(sum, (one for one, _ in found.values()))) == 14
    for words, (one, other) in found.items():
        form = re.compile(words.replace("{}", r"\w+"))
        assert len(one) == len(other) == sum(form.fullmatch(text) is not None for text in asked.values())
