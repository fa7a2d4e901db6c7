"""Poses, and what else is relative to the state, at seams: nothing jumps with it, and rotations stay rotations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, DirectDenoiser, ExecutorSettings, ObservationSpec, PolicySpec
from ttscompile.core.poses import Pose
from ttscompile.core.spec import Affine, Relative
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import GuardLimits
from ttscompile.runtimes.executor.measure import measure_latencies
from ttscompile.runtimes.executor.settings import resolve

from .simulation import TA, TO, FakeClock, ScriptedPolicy, actions_of, given_out

RESERVE, HZ, HORIZON, EXECUTED = 6, 10.0, 10, 6
RELATIVE = Relative("obs", (None,) * 10, (Pose(1, 0),))
TURNS = ExecutorSettings(policy_hz=10.0, interpolation="linear")


def about_z(angle: Any) -> np.ndarray:
    """Two rows of turns about z, ``[..., 6]``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c, -s, 0 * c, s, c, 0 * c], -1)


def given(settings: ExecutorSettings, relative: Relative | None, turn: float = 1.5) -> np.ndarray:
    """What is given out of a policy whose arm turns within a chunk, and is elsewhere with every call."""
    calls = iter(range(1000))

    def actions(seen: np.ndarray) -> np.ndarray:
        chunk = np.zeros((TO - 1 + TA + RESERVE, 10), np.float32)
        chunk[:, 4:] = about_z(turn * (np.arange(len(chunk)) + next(calls)))
        chunk[:, :4] = np.arange(len(chunk))[:, None]
        return chunk

    return given_out(settings, ChunkSpec(10, TO - 1, TO - 1 + TA, relative=relative), RESERVE, actions)


def off_orthonormal(rows: np.ndarray) -> float:
    """How far two rows ``[N, 6]`` are from length 1 and right angles."""
    both = rows.reshape(-1, 2, 3).astype(np.float64)
    return float(np.abs(both @ both.swapaxes(1, 2) - np.eye(2)).max())


@pytest.mark.parametrize(
    "settings",
    [
        ExecutorSettings(seam="blend", blend_steps=3),
        ExecutorSettings(seam="ensemble", ensemble_coefficient=0.1),
        TURNS,
        ExecutorSettings(guard=GuardLimits(clip=True, max_step=0.4)),
    ],
    ids=["blend", "ensemble", "linear", "limited"],
)
def test_every_action_has_a_rotation(settings: ExecutorSettings) -> None:
    between, found = given(settings, None), given(settings, RELATIVE)
    assert off_orthonormal(between[:, 4:]) > 0.1, "the test has mixtures to look at"
    assert off_orthonormal(found[:, 4:]) < 1e-5
    np.testing.assert_array_equal(found[:, :4], between[:, :4])
    # about z a mixture of two turns is between them, and only its length is another
    alike = between[:, 4:] / np.linalg.norm(between[:, 4:6], axis=1, keepdims=True)
    if settings.guard is None or not settings.guard.clip:
        np.testing.assert_allclose(found[:, 4:], alike, atol=1e-5)


def test_between_opposite_rotations_the_one_before_stands() -> None:
    """In the middle of a half turn about z both rows are zeros."""
    between, found = given(TURNS, None, np.pi), given(TURNS, RELATIVE, np.pi)
    nothing = np.abs(between[:, 4:]).max(1) < 1e-3
    assert 10 < nothing.sum() < 20
    assert off_orthonormal(found[:, 4:]) < 1e-5
    (where,) = np.nonzero(nothing[1:])
    np.testing.assert_array_equal(found[where + 1, 4:], found[where, 4:])
    np.testing.assert_array_equal(found[:, :4], between[:, :4])


def test_a_pose_is_no_displacement() -> None:
    with pytest.raises(
        ExecutorError, match=r"displacements = \(0, 1, 9\): \[1, 9\] are numbers of poses, which say where"
    ):
        given(ExecutorSettings(displacements=(0, 1, 9)), RELATIVE)
    assert len(given(ExecutorSettings(displacements=(0,)), RELATIVE)) == 30


class Path3(nn.Module):
    """Where a path of its own goes from here, less where the robot is: observed are a pose, the time and a place."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = nn.Parameter(torch.arange(float(HORIZON)))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        turned, now = obs[:, 0, :9], obs[:, :, 9:10] + self.steps[:, None]
        first, second = turned[:, 3:6], turned[:, 6:9]
        back = torch.stack([first, second, torch.linalg.cross(first, second)], 2)  # the inverse, for orthonormal rows
        place = torch.cat([now, 2 * now, -now], 2) - turned[:, None, :3]
        c, s, o = torch.cos(0.3 * now), torch.sin(0.3 * now), 0 * now
        whole = torch.stack([torch.cat(row, 2) for row in ((c, -s, o), (s, c, o), (o, o, 1 + o))], 2)
        rows = (back[:, None] @ whole)[:, :, :2].flatten(2)
        return 0.5 * torch.cat([now - obs[:, :, 10:], (back[:, None] @ place[..., None])[..., 0], rows], 2) + 0.1


def compiled(once: Once, relative: Relative | None) -> Path:
    spec = PolicySpec(
        sample=(HORIZON, 10),
        observations={"obs": ObservationSpec((1, 11))},
        sampler=ttscompile.direct_table(),
        chunk=ChunkSpec(10, 0, EXECUTED, Affine(np.full(10, 0.5), np.full(10, 0.1)), ranged=False, relative=relative),
    )
    name, network = f"a path, relative: {relative is not None}", DirectDenoiser(Path3()).eval()
    return once.compiled(name, lambda to: ttscompile.compile_denoiser(network, spec, to))[0]


@pytest.mark.slow
@pytest.mark.parametrize("seam", ["replace", "blend", "ensemble"])
def test_the_path_does_not_jump_with_the_state(once: Once, seam: str) -> None:
    """Of a robot that is somewhere else at every tick: the first number is relative to its place, and a pose to its."""

    def played(relative: Relative | None) -> np.ndarray:
        rng, policy = np.random.default_rng(0), ttscompile.load(compiled(once, relative), seed=0)

        def seen(tick: int) -> np.ndarray:
            turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
            return np.concatenate([rng.uniform(-9, 9, 3), turn[:2].ravel(), [tick], rng.uniform(-9, 9, 1)])

        return actions_of(policy, ExecutorSettings(seam=seam, blend_steps=3), HZ, 0.2, seen, 4 * EXECUTED)

    found = played(Relative("obs", (10, *[None] * 9), (Pose(1, 0),)))
    now = found[:, 0]
    np.testing.assert_allclose(np.diff(now), 1, atol=1e-4)
    np.testing.assert_allclose(found[:, 1:4], now[:, None] * [1, 2, -1], atol=1e-3)
    np.testing.assert_allclose(found[:, 4:], about_z(0.3 * now), atol=1e-4)
    assert np.abs(np.diff(played(None)[:, 0])).max() > 4, "the state is what would jump"


def test_latencies_are_measured_where_the_middle_of_a_range_is_no_rotation() -> None:
    """With a prefix of a pose that is the measured one."""
    policy = ScriptedPolicy(FakeClock(), reserve=RESERVE)
    action = ChunkSpec(10, 1, 1 + TA, Affine(np.ones(10, np.float32), np.zeros(10, np.float32)), relative=RELATIVE)
    info = replace(policy.info, action=action, observation={"obs": ObservationSpec((2, 9))}, sample=(TA + 2, 10))
    given: list[tuple[np.ndarray, np.ndarray]] = []

    class Prefixed:
        def predict_action(self, obs: Any, *, plan: str, prefix: np.ndarray) -> None:
            given.append((obs["obs"], prefix))

    settings = resolve(ExecutorSettings(seam="prefix", warm_up=1, measured_calls=1, n_obs_steps=2), info, HZ)
    once = Prefixed()
    once.info = info  # type: ignore[attr-defined]
    measure_latencies(once, policy.clock, settings)  # type: ignore[arg-type]
    for obs, prefix in given:
        assert prefix.shape == (1, 1, 10) and prefix[0, 0, 0] == 0
        np.testing.assert_array_equal(prefix[0, 0, 1:], obs[0, -1])
