"""Actions that are relative to a measured pose and to numbers, however a call is made, and from call to call."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import nn

import ttscompile
from tests.calibration import policies
from tests.commands import as_json
from tests.lower.whole_call import every_way
from tests.once import Once
from ttscompile import ChunkSpec, Noise, ObservationSpec, Plan, PolicySpec
from ttscompile.artifact.golden import load_golden_plans
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.strict_json import dump, parse
from ttscompile.artifact.typed_json import from_json, to_json
from ttscompile.artifact.write import update_plans
from ttscompile.calibration.compare import compare
from ttscompile.core.lattice import Source
from ttscompile.core.poses import Pose, orthonormal
from ttscompile.core.spec import Affine, Relative
from ttscompile.core.start import rest_of
from ttscompile.errors import ArtifactError, CalibrationError, ObservationError
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.verification.record_golden import record_plans

from .toys import denoised_by

T, DA, DO, RUNTIMES = policies.HORIZON, 12, 13, ("onnxruntime", "torch", "reference")
RELATIVE = Relative("obs", (12, *[None] * 9, 0, None), (Pose(1, 2),))
"""A joint, a pose, a joint, and a number of its own."""
STAYS = np.array([0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], np.float32)
STEEP = np.linspace(3, 4, T, dtype=np.float32)[:, None]


class Arm(policies.Mixer):
    def __init__(self) -> None:
        super().__init__(0)
        width = policies.WIDTH
        self.embed, self.head = nn.Linear(DA, width), nn.Linear(width, DA)
        self.encode = nn.Sequential(nn.Linear(2 * DO, width), nn.GELU(), nn.Linear(width, width))


def spec() -> PolicySpec:
    """A range for each step, about where the robot is."""
    table = replace(flow_matching_table(6), timesteps=np.arange(6)[::-1].copy())
    rows = Affine(STEEP * np.ones(DA, np.float32), -STEEP * STAYS)
    return PolicySpec(
        sample=(T, DA),
        observations={"obs": ObservationSpec((2, DO), Affine(np.full(DO, 0.5), np.full(DO, 0.1)))},
        sampler=table,
        chunk=ChunkSpec(DA, 1, 5, rows, ranged=False, relative=RELATIVE),
    )


@pytest.fixture(scope="module")
def made(once: Once) -> Path:
    """A policy of flow matching, with a plan that begins with the chunk of the call before, and its single file."""

    def convert(path: Path) -> None:
        ttscompile.compile_denoiser(Arm().eval(), spec(), path / "artifact", single_file=path / "whole.onnx")
        dense = load_artifact(path / "artifact").plans["dense"]
        warm = Plan("original-last-2", np.zeros((2, 6), np.int8), otherwise=dense)
        sparse = replace(warm, cells=np.array([[0] * 6, [Source.TIMESTEP] * 6], np.int8))
        plans, starts = {"dense": dense, "warm": warm, "sparse": sparse}, {warm.loop: StartRecord("original", 2)}
        update_plans(path / "artifact", plans, "warm", {}, starts=starts, golden=record_plans)

    return once.folder("relative poses", convert)


def observed(seed: int, streams: int = 2) -> tuple[dict[str, np.ndarray], Noise]:
    """Of another pose each; rows are not quite orthonormal, as measured."""
    rng = np.random.default_rng(seed)
    obs = rng.standard_normal((streams, 2, DO)).astype(np.float32)
    obs[..., 2:11] = orthonormal(obs[..., 2:11]) + rng.uniform(-0.01, 0.01, 9).astype(np.float32)
    return {"obs": obs}, Noise(rng.standard_normal((streams, T, DA)).astype(np.float32))


def matrix(pose: np.ndarray) -> np.ndarray:
    """A homogeneous one, in numpy's own words: the triangle of the two rows is what is not orthonormal."""
    q, r = np.linalg.qr(pose[3:].reshape(2, 3).T.astype(np.float64))
    rows = (q * np.sign(np.diag(r))).T
    turned = np.vstack([rows, np.cross(*rows)])
    return np.block([[turned, pose[:3, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def literal(sample: np.ndarray, obs: np.ndarray) -> np.ndarray:
    """The actions of denoised samples, one by one."""
    actions = sample / STEEP + STAYS
    for stream, step in np.ndindex(actions.shape[:2]):
        own, state = actions[stream, step], obs[stream, -1]
        whole = matrix(state[2:11]) @ matrix(own[1:10])
        own[:] = [own[0] + state[12], *whole[:3, 3], *whole[:2, :3].ravel(), own[10] + state[0], own[11]]
    return actions


@pytest.mark.slow
def test_every_way_to_make_a_call_composes_it(made: Path) -> None:
    """For each stream of a batch with its own pose."""
    obs, noise = observed(0, 3)
    reference = ttscompile.load(made / "artifact", "reference")
    given = {"obs": spec().observations["obs"].normalized(obs["obs"])}
    sample, _ = reference._runtime.predict(given, noise, reference.plans["dense"])
    expected = literal(sample, obs["obs"])
    found = every_way(made / "artifact", (made / "whole.onnx").read_bytes(), obs, noise)
    for name, actions in found.items():
        np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-4, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_call_goes_on_with_the_actions_of_the_call_before(made: Path, runtime: str) -> None:
    policy, (rest, start) = ttscompile.load(made / "artifact", runtime), rest_of(spec().sampler, 2)
    before = policy.predict_action(*observed(0))["action_pred"]
    for call in (1, 2):
        obs, noise = observed(call)
        going_on = np.concatenate([before[:, 4:], np.repeat(before[:, -1:], 4, 1)], 1)  # four are executed
        for stream, step in np.ndindex(going_on.shape[:2]):
            own, state = going_on[stream, step], obs["obs"][stream, -1]
            back = np.linalg.inv(matrix(state[2:11])) @ matrix(own[1:10])
            own[:] = [own[0] - state[12], *back[:3, 3], *back[:2, :3].ravel(), own[10] - state[0], own[11]]
        initial = start.action * (going_on - STAYS) * STEEP + start.noise * noise.initial
        before = policy.predict_action(obs, noise)["action_pred"]
        sample = denoised_by(Arm().eval(), rest, spec(), obs, initial.astype(np.float32))
        expected = literal(sample, obs["obs"])
        np.testing.assert_allclose(before, expected, rtol=0, atol=1e-4)
        assert policy.last_report is not None and policy.last_report.plan_name == "warm"


@pytest.mark.slow
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_prefix_is_of_actions(made: Path, runtime: str) -> None:
    """What is committed stays, and the rest goes on from it, wherever the robot is meanwhile."""
    policy = ttscompile.load(made / "artifact", runtime)
    alone = policy.predict_action(*observed(3), "dense")["action_pred"]
    policy.reset()
    prefix = policy.predict_action(*observed(4), "dense")["action_pred"][:, 2:4]
    policy.reset()
    found = policy.predict_action(*observed(3), "dense", prefix)["action_pred"]
    np.testing.assert_allclose(found[:, 1:3], prefix, rtol=0, atol=1e-5)
    assert np.abs(found[:, 3:] - alone[:, 3:]).max() > 0.01
    uneven = prefix * np.float32(3)  # its rotations are the same
    policy.reset()
    again = policy.predict_action(*observed(3), "dense", uneven)["action_pred"][:, 1:3]
    np.testing.assert_allclose(again[..., 4:10], prefix[..., 4:10], rtol=0, atol=1e-5)
    with pytest.raises(ObservationError, match="prefix, less the observation, must be finite; found nan at index"):
        policy.predict_action(*observed(3), "dense", 0 * prefix)


@pytest.mark.slow
def test_every_rung_of_verify_holds_and_bench_measures(made: Path) -> None:
    rungs = {
        one.name: one.status for one in ttscompile.verify(made / "artifact", calls=2).rungs if one.name != "engaged"
    }
    assert set(rungs.values()) == {"passed", "skipped"}, rungs  # what is saved here is less than noise
    assert set(load_golden_plans(load_artifact(made / "artifact"), 2)) == {"sparse", "warm"}
    as_json("bench", made / "artifact", "--calls", 2)


@pytest.mark.slow
def test_calibration_measures_what_the_network_says(tmp_path: Path) -> None:
    """Two answers to one observation have the same added to them: every distance is that of the policy without.

    What is furthest is shown as the robot's own actions.
    """
    rows = [observed(seed, 6)[0]["obs"] for seed in range(6)]
    np.savez(tmp_path / "calls.npz", obs=np.concatenate(rows), episode_ends=6 * np.arange(1, 7))
    recording, found, shown = tmp_path / "calls.npz", list[Mapping[str, Any]](), list[np.ndarray]()
    for relative in (None, RELATIVE):
        path, own = tmp_path / str(relative is None), spec()
        own = replace(own, chunk=replace(own.chunk, relative=relative))
        ttscompile.compile_denoiser(Arm().eval(), own, path)
        ttscompile.calibrate(path, [recording], 0.6, learn=("interval",), progress=False)
        plans = (load_artifact(path).manifest.calibration or {})["plans"]
        found.append({name: (one["error"], one["distance"]) for name, one in plans.items()})
        shown.append(compare(path, [recording], calls=4).points[-1].furthest[0].actions)
    assert found[0] and found[0] == found[1]
    assert np.abs(shown[0] - shown[1]).max() > 0.1
    np.testing.assert_allclose(orthonormal(shown[1][..., 1:10]), shown[1][..., 1:10], atol=1e-5)
    assert np.abs(orthonormal(shown[0][..., 1:10]) - shown[0][..., 1:10]).max() > 1e-3


def test_a_latency_is_measured_where_the_robot_has_a_pose(made: Path, tmp_path: Path) -> None:
    """Zeros are no rotation."""
    path, rows = shutil.copytree(made / "artifact", tmp_path / "own"), [observed(seed, 6)[0]["obs"] for seed in (0, 1)]
    np.savez(tmp_path / "calls.npz", obs=np.concatenate(rows), episode_ends=[6, 12])
    with pytest.raises(CalibrationError, match="a call that computes step 0 alone takes"):
        ttscompile.calibrate(path, [tmp_path / "calls.npz"], latency_ms=1e-4, progress=False)


def test_it_is_written_where_there_is_one_and_read_strictly() -> None:
    """An artifact without poses is what it was."""
    own = spec()
    written = to_json(own)
    assert written["chunk"]["relative"]["poses"] == [{"action": 1, "measured": 2}]
    assert from_json(PolicySpec, parse(dump(written), "spec")).chunk.relative == RELATIVE
    del written["chunk"]["relative"]["poses"]
    found = from_json(PolicySpec, parse(dump(written), "spec")).chunk.relative
    assert found == replace(RELATIVE, poses=()) and "poses" not in to_json(found)
    for wrong in (
        [{"action": 1}],
        [{"action": 1, "measured": 2, "format": "xyz+rotvec"}],
        [{"action": 8, "measured": 2}],
    ):
        written["chunk"]["relative"]["poses"] = wrong
        with pytest.raises(ArtifactError, match=r"spec\.chunk\.relative"):
            from_json(PolicySpec, parse(dump(written), "spec"))
