"""Poses that are relative to a measured one: by hand, by properties, and as numpy, torch and ONNX have them."""

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from ttscompile.core.chunk import ChunkSpec, Relative, Switch
from ttscompile.core.poses import LEAST, Pose, composed, has_rotation, orthonormal
from ttscompile.errors import ObservationError, SpecError
from ttscompile.lower.graph_writer import GraphWriter, tensor
from ttscompile.lower.poses import write_absolute

STAYS = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32)
TURN = np.array([10, 20, 30, 0, -1, 0, 1, 0, 0], np.float32)
"""A place, and a quarter turn about z: the rows of ``[[0, -1, 0], [1, 0, 0], [0, 0, 1]]``."""
BOTH = Relative("obs", (*[None] * 9, 2, None, *[None] * 9), (Pose(0, 3), Pose(11, 12)))
"""A pose, a joint, a number of its own and another pose, of an observation of 21 numbers."""


def poses(count: int, seed: int = 0) -> np.ndarray:
    """With rows that are neither of length 1 nor at right angles."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 9)).astype(np.float32)


def test_a_quarter_turn_by_hand() -> None:
    """One ahead along x is one along y from there; and the same turn once more is a half turn."""
    ahead = STAYS + np.array([1, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)
    np.testing.assert_allclose(composed(TURN, ahead), [10, 21, 30, 0, -1, 0, 1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(composed(TURN, TURN), [-10, 30, 60, -1, 0, 0, 0, -1, 0], atol=1e-7)
    np.testing.assert_allclose(
        composed(TURN, [10, 21, 30, 0, -1, 0, 1, 0, 0] + 0 * TURN, inverse=True), ahead, atol=1e-7
    )
    np.testing.assert_allclose(composed(TURN, TURN, inverse=True), STAYS, atol=1e-7)


def test_rows_are_made_orthonormal_the_first_first() -> None:
    np.testing.assert_allclose(orthonormal(np.array([7, 8, 9, 0, 5, 0, 3, -2, 0.0])), [7, 8, 9, 0, 1, 0, 1, 0, 0])
    found = orthonormal(poses(100)).astype(np.float64)
    np.testing.assert_allclose((found[:, 3:6] ** 2).sum(1), 1, atol=1e-6)
    np.testing.assert_allclose((found[:, 6:] ** 2).sum(1), 1, atol=1e-6)
    np.testing.assert_allclose((found[:, 3:6] * found[:, 6:]).sum(1), 0, atol=1e-6)
    found = orthonormal(poses(100).astype(np.float64))
    np.testing.assert_allclose(orthonormal(found), found, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_inverse_takes_back_what_was_composed(dtype: type) -> None:
    """But for what made no rotation of the numbers, which does not come back."""
    measured: np.ndarray = poses(200, 1).astype(dtype)
    own = orthonormal(poses(200, 2).astype(dtype))
    near = 2e-4 if dtype is np.float32 else 1e-11
    np.testing.assert_allclose(composed(measured, composed(measured, own), inverse=True), own, atol=near)
    np.testing.assert_allclose(composed(measured, composed(measured, own, inverse=True)), own, atol=near)
    np.testing.assert_allclose(composed(STAYS, own), own, atol=near)
    assert np.abs(composed(measured, own) - composed(own, measured)).max() > 0.1  # the order counts


def test_composing_goes_from_the_left_on() -> None:
    """``(a b) c = a (b c)``; half turns and next to none among them."""
    a, b, c = (orthonormal(poses(50, seed).astype(np.float64)) for seed in (3, 4, 5))
    a[0], b[0] = composed(TURN, TURN), composed(TURN, TURN)
    a[1] = orthonormal(np.array([0, 0, 0, 1, 1e-6, 0, -1e-6, 1, 0.0]))
    np.testing.assert_allclose(composed(composed(a, b), c), composed(a, composed(b, c)), atol=1e-12)


def test_what_is_no_rotation() -> None:
    rows = [[0, 0, 0, 0, 1, 0], [1, 0, 0, 0, 0, 0], [1, 2, 3, 2, 4, 6], [1, 0, 0, 1, LEAST / 2, 0], [np.nan] * 6]
    assert not has_rotation(np.pad(np.array(rows), ((0, 0), (3, 0)))).any()
    assert has_rotation(np.array([STAYS, TURN, [0, 0, 0, 1, 0, 0, 1, 2 * LEAST, 0]])).all()


def actions_and_reference() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    obs = rng.uniform(-1, 1, (3, 2, 21)).astype(np.float32)
    reference = ChunkSpec(20, 0, 1, relative=BOTH).reference({"obs": obs})
    assert reference is not None
    return rng.uniform(-1, 1, (3, 5, 20)).astype(np.float32), reference, obs[:, -1]


def test_each_number_of_an_action_is_relative_to_its_own() -> None:
    """Of the newest frame of its own stream."""
    actions, reference, seen = actions_and_reference()
    found = BOTH.absolute(actions, reference)
    for stream, step in np.ndindex(3, 5):
        own, state = actions[stream, step].astype(np.float64), seen[stream].astype(np.float64)
        expected = [composed(state[3:12], own[:9]), [own[9] + state[2], own[10]], composed(state[12:], own[11:])]
        np.testing.assert_allclose(found[stream, step], np.concatenate(expected), atol=1e-12)
    back = BOTH.absolute(found, reference, inverse=True)
    np.testing.assert_allclose(BOTH.absolute(back, reference), found, atol=1e-12)
    np.testing.assert_allclose(back[..., 9:11], actions[..., 9:11], atol=1e-6)


def test_torch_and_onnx_compute_the_same() -> None:
    actions, reference, _ = actions_and_reference()
    expected = BOTH.absolute(actions, reference)
    np.testing.assert_allclose(
        BOTH.absolute(torch.from_numpy(actions), torch.from_numpy(reference), torch).numpy(), expected, atol=1e-5
    )
    turned = replace(BOTH, poses=BOTH.poses[::-1])
    for relative in (BOTH, turned, Relative("obs", BOTH.entries), Relative("obs", (None,) * 20, (Pose(5, 0),))):
        expected = relative.absolute(actions, reference)
        main = GraphWriter()
        main.rename(write_absolute(main, "actions", "reference", relative), "found")
        shapes: dict[str, list[int | str]] = {"actions": ["B", 5, 20], "reference": ["B", 1, 20]}
        graph = main.graph(
            "poses",
            [tensor("found", np.float32, ["B", 5, 20])],
            [tensor(name, np.float32, shape) for name, shape in shapes.items()],
        )
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=9)
        onnx.checker.check_model(model, full_check=True)
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        (found,) = session.run(None, {"actions": actions, "reference": reference})
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_measured_pose_without_a_rotation_is_refused() -> None:
    chunk, obs = ChunkSpec(9, 0, 1, relative=Relative("arm", (None,) * 9, (Pose(0, 1),))), np.zeros((2, 10), np.float32)
    obs[0, 1:] = TURN
    message = r"observation 'arm': numbers 4 to 9 are to be two rows of a rotation, of length 1 and at right angles;"
    with pytest.raises(ObservationError, match=message + r" found \[0.0, .*\] of stream 1, which gives none"):
        chunk.reference({"arm": obs})


def test_a_chunk_that_is_moved_holds_the_same_poses() -> None:
    rng = np.random.default_rng(7)
    chunk = ChunkSpec(20, 0, 4, relative=BOTH)
    sample = rng.uniform(-1, 1, (2, 4, 22)).astype(np.float32)
    before, now = (chunk.reference({"obs": rng.uniform(-1, 1, (2, 21)).astype(np.float32)}) for _ in range(2))
    assert before is not None and now is not None
    moved = chunk.moved(sample, 1, (before, now))
    found, expected = chunk.unnormalized(moved, now), chunk.unnormalized(sample, before)[:, [1, 2, 3, 3]]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(moved[..., 20:], sample[:, [1, 2, 3, 3], 20:])
    assert np.abs(moved[..., :20] - sample[:, [1, 2, 3, 3], :20]).max() > 0.1


@pytest.mark.parametrize(
    ("entries", "given", "message"),
    [
        ((None,) * 9, (Pose(1, 0),), r"9 numbers each of 9"),
        ((None,) * 12, (Pose(0, 0), Pose(3, 0)), "of which no other pose has one"),
        ((*[None] * 8, 4), (Pose(0, 0),), "with None in entries"),
    ],
)
def test_poses_have_room_in_an_action(entries: tuple[int | None, ...], given: tuple[Pose, ...], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        Relative("obs", entries, given)
    with pytest.raises(SpecError, match="a pose's action"):
        Pose(-1, 0)


def test_no_number_of_a_pose_has_two_values() -> None:
    with pytest.raises(SpecError, match=r"and None for \[8\]"):
        ChunkSpec(9, 0, 1, switches=(Switch(8, 0.0, 0.0, 1.0),), relative=Relative("obs", (None,) * 9, (Pose(0, 0),)))
