"""LeRobot 0.6.1's vision-language-action models, tiny: from raw images, state and instruction to robot actions."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from ttscompile.core.spec import Noise
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.lerobot.files import files_beside

from .originals import assert_agreement_on_random_plans
from .vlas import MASK, STATE, TOKENS, Array
from .whole_vlas import WHOLE, Whole, assert_refused

BY_NAME = [pytest.param(one, id=one.name) for one in WHOLE]


@pytest.fixture(scope="module", params=BY_NAME)
def whole(request: pytest.FixtureRequest) -> Whole:
    found: Whole = request.param
    return found


@pytest.mark.parametrize(
    ("whole", "kind", "compiled_in"),
    [
        pytest.param(one, kind, compiled_in, id=f"{one.name}-{kind}-{'compiled' if compiled_in else 'observed'}")
        for one in WHOLE
        for kind in one.kinds
        for compiled_in in ([True] if kind in one.compiled_in else [False, True])
    ],
    indirect=["whole"],
)
def test_the_rebuilt_network_gives_lerobots_actions(
    whole: Whole, kind: str, compiled_in: bool, tmp_path: Path, golden: Mapping[str, Array]
) -> None:
    """Two instructions, states and image sizes; and a camera that the robot lacks."""
    task = whole.tasks[0] if compiled_in else None
    for call in (0, 1):
        directory = whole.save(kind, tmp_path / str(call), call)
        found = whole.eager(directory, kind, call, LoadOptions(task=task and whole.tasks[call]))
        assert found.shape == golden[f"{kind}.{call}"].shape
        assert np.abs(found - golden[f"{kind}.{call}"]).max() < whole.close
        assert np.abs(found - golden[f"{kind}.{1 - call}"]).max() > 0.01
    directory, absent = whole.save(kind, tmp_path / "missing", 0), whole.missing.get(kind, whole.cameras[0])
    found = whole.eager(directory, kind, 0, LoadOptions(task=task, without_cameras=(absent,)))
    assert np.abs(found - golden[f"{kind}.missing"]).max() < whole.close
    assert np.abs(found - golden[f"{kind}.0"]).max() > 0.001


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_what_is_compiled_gives_them_too(
    whole: Whole, compiled: Path, golden: Mapping[str, Array], runtime: str
) -> None:
    """The text of the task is an observation, whose tokens the policy makes with the tokenizer in the artifact."""
    kind, (count, numbers) = whole.kinds[0], whole.executed
    policy = ttscompile.load(compiled, runtime=runtime)
    assert set(policy.info.observation) == {STATE, *whole.cameras, TOKENS, MASK}
    for call in whole.calls:
        given = {key: value[None] for key, value in whole.observation(kind, call).items()}
        told, noise = {"task": whole.tasks[call]}, Noise(whole.noise(kind))
        found = policy.predict_action_chunk(given | told, noise=noise, plan="dense")
        assert found.shape == (1, count, numbers)
        assert np.abs(found - golden[f"{kind}.{call}"][:, :count]).max() < 1e-4
    if whole.too_long is not None:
        task, message = whole.too_long
        with pytest.raises(ObservationError, match=message):
            policy.predict_action_chunk(given | {"task": task})


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch"])
def test_runtimes_agree_on_random_plans(compiled: Path, runtime: str) -> None:
    assert_agreement_on_random_plans(compiled, runtime)


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    assert ttscompile.verify(compiled, calls=1).passed


@pytest.mark.slow
@pytest.mark.soak
def test_in_eight_bits_its_actions_are_near(whole: Whole, tmp_path: Path, golden: Mapping[str, Array]) -> None:
    kind = whole.kinds[0]
    ttscompile.convert(whole.save(kind, tmp_path / "saved", 0), tmp_path / "compiled", precision="int8")
    policy = ttscompile.load(tmp_path / "compiled")
    assert (policy.info.default_plan, policy.info.precision) == ("full", "int8")
    given = {key: value[None] for key, value in whole.observation(kind, 0).items()}
    found = policy.predict_action_chunk(given | {"task": whole.tasks[0]}, noise=Noise(whole.noise(kind)))
    apart = np.abs(found - golden[f"{kind}.0"][:, : whole.executed[0]])[..., : whole.numbers]
    assert 1e-5 < apart.max() < whole.eight_bits
    assert ttscompile.verify(tmp_path / "compiled", calls=1).passed


def test_doctor_knows_statistics_and_tokenizer(whole: Whole, tmp_path: Path) -> None:
    directory = whole.save(whole.kinds[0], tmp_path, 0)
    found = {one.what: one.found for one in examine(directory, load_checkpoint_policy(directory)[1])}
    assert [what for what, told in whole.doctor.items() if told not in found[what]] == []


@pytest.mark.parametrize("whole", [pytest.param(one, id=one.name) for one in WHOLE if one.files], indirect=True)
def test_lerobots_commands_take_it_with_its_task_alone(whole: Whole, tmp_path: Path) -> None:
    """None of lerobot's steps writes what is around the instruction; an artifact with its tokenizer does it itself."""
    directory = whole.save(whole.kinds[0], tmp_path, 0)
    spec = load_checkpoint_policy(directory)[1]
    assert not files_beside(directory, spec)
    steps = json.loads(files_beside(directory, spec, text=True)["policy_preprocessor.json"])["steps"]
    names = ["rename_observations_processor", "to_batch_processor", "device_processor"]
    assert [step["registry_name"] for step in steps] == names
    beside = files_beside(directory, load_checkpoint_policy(directory, options=LoadOptions(task="go"))[1])
    assert set(json.loads(beside["config.json"])["input_features"]) == {STATE, *whole.cameras}


@pytest.mark.parametrize(
    ("whole", "folder"),
    [pytest.param(one, folder, id=folder) for one in WHOLE for folder in one.elsewhere],
    indirect=["whole"],
)
def test_a_model_that_is_not_on_this_machine_is_named(whole: Whole, folder: str, tmp_path: Path) -> None:
    """Nothing is ever downloaded."""
    directory, (place, entry) = whole.save(whole.kinds[0], tmp_path, 0), whole.elsewhere[folder]
    (tmp_path / folder / "config.json").unlink()
    assert_refused(directory, place, {entry: "somebody/model"}, "'somebody/model' is not on this machine")
