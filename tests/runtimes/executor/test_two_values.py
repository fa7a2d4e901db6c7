"""Numbers of an action that have two values alone, as a gripper's: no seam and no interpolation gives another one."""

import itertools

import numpy as np
import pytest

from ttscompile import ChunkSpec
from ttscompile.core.spec import Switch
from ttscompile.runtimes.executor import ExecutorSettings

from .simulation import TA, TO, given_out

RESERVE = 6  # so that a chunk and the one before have actions for the same ticks
GRIPPER = Switch(channel=2, threshold=0.5, below=-1.0, above=1.0)


def given(settings: ExecutorSettings, switches: tuple[Switch, ...]) -> np.ndarray:
    """What is given out of a policy whose gripper opens or closes with every call, and turns within a chunk, too."""
    turns = itertools.cycle((1.0, -1.0))

    def actions(seen: np.ndarray) -> np.ndarray:
        chunk = np.zeros((TO - 1 + TA + RESERVE, 3), np.float32)
        chunk[:, 2] = next(turns) * np.where(np.arange(len(chunk)) % 3 < 2, 1, -1)
        return chunk

    return given_out(settings, ChunkSpec(3, TO - 1, TO - 1 + TA, switches=switches), RESERVE, actions)


@pytest.mark.parametrize(
    "settings",
    [
        ExecutorSettings(seam="blend", blend_steps=3),
        ExecutorSettings(seam="ensemble", ensemble_coefficient=0.1),
        ExecutorSettings(policy_hz=10.0, interpolation="linear"),
    ],
    ids=["blend", "ensemble", "linear"],
)
def test_only_the_two_are_given_out(settings: ExecutorSettings) -> None:
    between = given(settings, ())
    assert not np.isin(between[:, 2], (-1, 1)).all(), "the test has seams to look at"
    found = given(settings, (GRIPPER,))
    assert np.isin(found[:, 2], (-1, 1)).all() and len(np.unique(found[:, 2])) == 2
    np.testing.assert_array_equal(found[:, :2], between[:, :2])
    clear = np.abs(between[:, 2]) > 1e-6
    np.testing.assert_array_equal(found[clear, 2], np.sign(between[clear, 2]))
