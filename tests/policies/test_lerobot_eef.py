"""Parity with LeRobot's GR00T N1.7 whose actions are relative to the pose of an end effector, at tiny sizes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.poses import Pose, composed, orthonormal
from ttscompile.core.spec import Noise, Relative
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import AS_SAVED
from ttscompile.report import facts

from . import eefs, groots, originals
from .originals import assert_agreement_on_random_plans
from .vlas import STATE, Array
from .whole_vlas import eager_chunk

RELATIVE = {
    "arm": Relative(STATE, (10, 11, *[None] * 10), (Pose(2, 0),)),
    "alone": Relative(STATE, (None,) * 9, (Pose(0, 0),)),
}
RUNTIMES = ("onnxruntime", "torch", "reference")


@pytest.fixture(scope="module")
def golden() -> Mapping[str, Array]:
    return originals.golden("lerobot_groot_eef")


def test_poses_are_composed_as_lerobot_composes_them(golden: Mapping[str, Array]) -> None:
    """Of no turn, of little, of nearly half a turn, and of rows that are not orthonormal."""
    measured, relative, absolute = (golden[f"composition.{name}"] for name in ("measured", "relative", "absolute"))
    np.testing.assert_allclose(composed(measured[:, None], relative), absolute, atol=1e-6 * np.abs(absolute).max())
    found = composed(torch.from_numpy(measured[:, None]), torch.from_numpy(relative), torch).numpy()
    np.testing.assert_allclose(found, absolute, atol=1e-4)
    back = composed(measured[:, None].astype(np.float64), absolute.astype(np.float64), inverse=True)
    np.testing.assert_allclose(back, orthonormal(relative.astype(np.float64)), atol=1e-5)


@pytest.mark.parametrize("kind", eefs.KINDS)
def test_the_rebuilt_network_gives_lerobots_actions(tmp_path: Path, kind: str, golden: Mapping[str, Array]) -> None:
    directory = eefs.save(kind, tmp_path)
    chunk = load_checkpoint_policy(directory)[1].chunk
    assert chunk.relative == RELATIVE[kind]
    assert chunk.normalizer is not None and chunk.normalizer.scale.shape == (groots.HORIZON, eefs.width(kind))
    for call in (0, 1):
        told = eefs.BACKBONE, groots.TASKS[call]
        _, found = eager_chunk(directory, AS_SAVED, eefs.observation(kind, call), eefs.noise(), *told)
        expected = golden[f"{kind}.{call}"]
        assert expected.shape == (1, eefs.STEPS, eefs.width(kind))
        assert np.abs(found[:, : eefs.STEPS] - expected).max() < 1e-4
        assert np.abs(found[:, : eefs.STEPS] - golden[f"{kind}.{1 - call}"]).max() > 0.1


def compiled(once: Once, tmp_path: Path, kind: str) -> Path:
    return once.compiled(f"groot eef {kind}", lambda to: ttscompile.convert(eefs.save(kind, tmp_path / "in"), to))[0]


def opened(path: Path, kind: str, runtime: str = "onnxruntime") -> Any:
    return ttscompile.load(path, runtime=runtime, tokenizer=eefs.BACKBONE)


def given_to(kind: str, call: int) -> dict[str, Any]:
    return {key: value[None] for key, value in eefs.observation(kind, call).items()} | {"task": groots.TASKS[call]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "runtime"),
    [
        *(("arm", runtime) for runtime in RUNTIMES),
        ("alone", "onnxruntime"),
        *(pytest.param("alone", runtime, marks=pytest.mark.soak) for runtime in RUNTIMES[1:]),
    ],
)
def test_what_is_compiled_gives_them_too(
    once: Once, tmp_path: Path, kind: str, golden: Mapping[str, Array], runtime: str
) -> None:
    """Two streams at once, too, each from its own pose."""
    policy = opened(compiled(once, tmp_path, kind), kind, runtime)
    for call in (0, 1):
        found = policy.predict_action_chunk(given_to(kind, call), noise=Noise(eefs.noise()), plan="dense")
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < 1e-4
    policy.reset()
    given = eefs.both(kind) | {"task": groots.TASKS[0]}
    found = policy.predict_action_chunk(given, noise=Noise(eefs.noise(2)), plan="dense")
    assert np.abs(found - golden[f"{kind}.both"]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_prefix_is_of_poses_of_the_robot(once: Once, tmp_path: Path, runtime: str) -> None:
    """Actions that were predicted in another state stay what they are in the next call's."""
    policy = opened(compiled(once, tmp_path, "arm"), "arm", runtime)
    assert policy.info.prefix_refusal is None
    before = policy.predict_action(windows("arm", 0), Noise(eefs.noise()), "dense")["action"]
    policy.reset()
    after = policy.predict_action(windows("arm", 1), Noise(eefs.noise()), "dense", before[:, 2:4])["action"]
    assert np.abs(after[:, :2] - before[:, 2:4]).max() < 1e-5
    with pytest.raises(ObservationError, match="prefix, less the observation, must be finite; found nan at index"):
        policy.predict_action(windows("arm", 1), Noise(eefs.noise()), "dense", 0 * before[:, :1])


def windows(kind: str, call: int) -> dict[str, Any]:
    own: dict[str, Any] = {key: value[None, None] for key, value in eefs.observation(kind, call).items()}
    return own | {"task": groots.TASKS[call]}


@pytest.mark.slow
def test_every_rung_of_verify_holds_and_runtimes_agree(once: Once, tmp_path: Path) -> None:
    artifact = compiled(once, tmp_path, "arm")
    assert ttscompile.verify(artifact, calls=1).passed
    assert_agreement_on_random_plans(artifact, "onnxruntime")
    (told,) = (row[1] for row in facts.policy(load_artifact(artifact)).tables[0].rows if row[0] == "action")
    assert told.endswith(f"; 11 of the numbers are relative to {STATE!r}, 9 of them in poses")


@pytest.mark.slow
def test_a_state_without_a_rotation_is_refused(once: Once, tmp_path: Path) -> None:
    policy = opened(compiled(once, tmp_path, "arm"), "arm")
    given = given_to("arm", 0)
    given[STATE] = 0 * given[STATE]
    with pytest.raises(ObservationError, match="'observation.state': numbers 3 to 8 are to be two rows of a rotation"):
        policy.predict_action_chunk(given, noise=Noise(eefs.noise()))
