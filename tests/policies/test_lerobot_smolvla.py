"""Parity with LeRobot 0.6.1's SmolVLA: from raw images, state and instruction to robot actions."""

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import original_policy
from ttscompile.core.spec import Noise
from ttscompile.errors import ArtifactChangedError, ArtifactError, CheckpointError, ObservationError
from ttscompile.frontends import load_checkpoint_policy, tokenizer_of
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import parts
from ttscompile.frontends.families import LoadOptions

from ..families.support import record
from ..verification.broken import edited
from . import originals
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array, arrays, as_given, frame, with_fewer_layers

pytestmark = pytest.mark.slow

SIZE = (96, 128)
"""Of the golden images, height and width."""


@pytest.fixture(scope="module")
def directory(shared: Path) -> Path:
    return shared / "golden" / "lerobot_whole" / "smolvla"


@pytest.fixture(scope="module")
def golden(directory: Path) -> Mapping[str, Array]:
    with np.load(directory.with_suffix(".npz")) as numbers:
        return dict(numbers)


@pytest.fixture(scope="module")
def others() -> Mapping[str, Array]:
    """What lerobot made of images of another size, and without a camera."""
    return originals.golden("lerobot_smolvla")


@pytest.fixture(scope="module")
def compiled(once: Once, directory: Path) -> Path:
    artifact, program = once.compiled("smolvla", lambda to: ttscompile.convert(directory, to))
    record("LeRobot smolvla", "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4", "euler 10", program)
    return artifact


def observed(given: Mapping[str, Array], size: tuple[int, int] = SIZE) -> dict[str, Array]:
    """A frame of one stream as LeRobot's batch holds it."""
    one = {key: value[None] for key, value in frame(given, size).items()}
    return one | {TOKENS: given["tokens"], MASK: given["attention_mask"]}


def eager(directory: Path, given: Mapping[str, Array], batch: Mapping[str, Array], options: LoadOptions) -> Array:
    """The actions of the rebuilt network, not compiled."""
    module, spec = load_checkpoint_policy(directory, options=options)
    obs = {key: torch.from_numpy(as_given(key, batch, spec)) for key in spec.observations}
    return spec.chunk.unnormalized(eager_policy(module, spec)(obs, Noise(given["noise"])).numpy())


@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_two_instructions(compiled: Path, golden: Mapping[str, Array], runtime: str) -> None:
    policy = ttscompile.load(compiled, runtime=runtime)
    assert policy.info.observation[CAMERAS[0]].shape == (1, 3, 64, 64)
    for call in (0, 1):
        given = arrays(golden, call)
        found = policy.predict_action_chunk(observed(given), noise=Noise(given["noise"]), plan="dense")
        assert np.abs(found - golden[f"call{call}.action"]).max() < 1e-4


def test_tokens_of_both_cameras_may_be_reused(compiled: Path) -> None:
    """SigLIP and the connector behind it are one piece, whose tokens are found; and those of the language model."""
    tokens = load_artifact(compiled).manifest.tokens
    assert {name: (one.tokens, len(one.words)) for name, one in tokens.items()} == {
        "frame_00": (64, 0),
        "scene": (32, 24),
    }
    assert set(CAMERAS) <= set(load_artifact(compiled).manifest.pieces["frames"].inputs)


def test_images_of_another_size_in_the_same_artifact(
    compiled: Path, golden: Mapping[str, Array], others: Mapping[str, Array]
) -> None:
    policy, given = ttscompile.load(compiled), arrays(golden, 0)
    found = policy.predict_action_chunk(observed(given, (150, 110)), noise=Noise(given["noise"]), plan="dense")
    assert np.abs(found - others["large"]).max() < 1e-4
    assert np.abs(found - golden["call0.action"]).max() > 0.01


def test_select_action_over_twenty_ticks(compiled: Path, golden: Mapping[str, Array]) -> None:
    policy, given = ttscompile.load(compiled), arrays(golden, 0)
    batch = {key: torch.from_numpy(value) for key, value in observed(given).items()} | {"task": [str(given["task"])]}
    found = [policy.select_action(batch, noise=Noise(given["noise"]), plan="dense") for _ in range(20)]
    assert np.abs(torch.stack(found, 1).numpy() - golden["call0.action"][:, :20]).max() < 1e-4


def test_the_text_of_a_task_in_place_of_its_tokens(
    compiled: Path, directory: Path, golden: Mapping[str, Array]
) -> None:
    """With the artifact's tokenizer, and with one on the robot; of two episodes the instructions differ."""
    policies = ttscompile.load(compiled), ttscompile.load(compiled, tokenizer=directory.parent / "smolvlm-tiny")
    for call, policy in enumerate(policies):
        given = arrays(golden, call)
        batch = {key: value for key, value in observed(given).items() if key not in (TOKENS, MASK)}
        for task in (str(given["task"]), [str(given["task"])]):
            policy.reset()
            found = policy.predict_action_chunk(batch | {"task": task}, noise=Noise(given["noise"]), plan="dense")
            assert np.abs(found - golden[f"call{call}.action"]).max() < 1e-4
    # What else LeRobot has in a batch tells nothing about the number of streams.
    for foreign in ({"timestamp": np.float32(0.5)}, {"frame_index": np.arange(3)}):
        policy.reset()
        one = foreign | batch | {"task": str(given["task"])}
        found = policy.predict_action_chunk(one, noise=Noise(given["noise"]), plan="dense")
        assert np.abs(found - golden["call1.action"]).max() < 1e-4
    with pytest.raises(ObservationError, match="the task is 3; expected a text"):
        policy.predict_action_chunk(batch | {"task": 3})
    with pytest.raises(ObservationError, match="no such file; expected the tokenizer.json"):
        ttscompile.load(compiled, tokenizer=directory)


def test_the_artifact_has_its_tokenizer(compiled: Path, directory: Path, tmp_path: Path) -> None:
    """It is one of the files that are checked, and LeRobot's own step makes no tokens before it."""
    own = directory.parent / "smolvlm-tiny" / "tokenizer.json"
    assert (compiled / "tokenizer.json").read_bytes() == own.read_bytes()
    assert "tokenizer" not in (compiled / "policy_preprocessor.json").read_text()
    shutil.copytree(compiled, tmp_path / "compiled")
    before = load_artifact(tmp_path / "compiled").tokenizer
    (tmp_path / "compiled" / "tokenizer.json").write_bytes(own.read_bytes().replace(b" ", b"\t", 1))
    assert before is not None
    with pytest.raises(ArtifactChangedError):
        before(ObservationError)
    with pytest.raises(ArtifactError, match="tokenizer.json: expected sha256"):
        ttscompile.load(tmp_path / "compiled")


def test_verify_names_a_broken_layer(compiled: Path, tmp_path: Path) -> None:
    shutil.copytree(compiled, tmp_path / "compiled")
    with edited(tmp_path / "compiled", "weights") as arrays:
        (name,) = (name for name in arrays if name.endswith("denoiser.layers.1.mlp.down_proj.weight"))
        arrays[name] *= 1.05
    found = ttscompile.verify(tmp_path / "compiled", calls=1).first_failure
    assert found is not None
    assert (found.name, found.blocks) == ("block", (3,))
    assert "block 3 (feed_forward)" in found.told


def test_a_camera_that_the_robot_lacks(
    directory: Path, golden: Mapping[str, Array], others: Mapping[str, Array]
) -> None:
    """LeRobot masks a black image; here it is left out."""
    given = arrays(golden, 0)
    without = LoadOptions(without_cameras=[CAMERAS[1]])
    found = eager(directory, given, observed(given), without)
    assert np.abs(found - others["missing"]).max() < 1e-4
    assert np.abs(found - golden["call0.action"]).max() > 0.01


def test_a_rival_is_the_original_without_the_same_camera(directory: Path) -> None:
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(task="push", without_cameras=[CAMERAS[1]]))
    module, original = original_policy(directory, spec)
    assert set(original.observations) == {CAMERAS[0], STATE}
    assert original.source == spec.source
    drawn = {key: each.draw(np.random.default_rng(0)) for key, each in original.observations.items()}
    noise = Noise(np.zeros((1, *original.sample), np.float32))
    obs = {key: torch.from_numpy(original.observations[key].normalized(value)) for key, value in drawn.items()}
    assert np.isfinite(np.asarray(eager_policy(module, original)(obs, noise))).all()


def test_what_a_configuration_leaves_out_is_lerobots_default(directory: Path, tmp_path: Path) -> None:
    policy = copy(directory, tmp_path)
    entries = json.loads((policy / "config.json").read_text())
    for name in ("attention_mode", "self_attn_every_n_layers", "expert_width_multiplier", "min_period", "max_period"):
        del entries[name]
    (policy / "config.json").write_text(json.dumps(entries))
    found: Any = parts(load_checkpoint_policy(policy)[0]).denoiser
    expected: Any = parts(load_checkpoint_policy(directory)[0]).denoiser
    assert found.config == expected.config
    assert [layer.crosses for layer in found.layers] == [False, True, False, True]


def test_cameras_that_lerobot_calls_empty_are_no_observation(directory: Path, tmp_path: Path) -> None:
    copied = copy(directory, tmp_path)
    entries = json.loads((copied / "config.json").read_text())
    entries["input_features"]["observation.images.empty_camera_0"] = {"type": "VISUAL", "shape": [3, 480, 640]}
    change_json(copied / "config.json", input_features=entries["input_features"])
    _, spec = load_checkpoint_policy(copied)
    assert {key for key in spec.observations if "images" in key} == set(CAMERAS)


@pytest.mark.parametrize("call", [0, 1])
def test_an_instruction_that_is_compiled_in(directory: Path, golden: Mapping[str, Array], call: int) -> None:
    """Its padding is left out, and so is the tokenizer on the robot."""
    given = arrays(golden, call)
    task = LoadOptions(task=str(given["task"]))
    module, spec = load_checkpoint_policy(directory, options=task)
    encoder: Any = module.get_submodule("encoder")
    assert encoder.task.tolist() == [given["tokens"][given["attention_mask"]].tolist()]
    assert set(spec.observations) == {STATE, *CAMERAS}
    assert np.abs(eager(directory, given, observed(given), task) - golden[f"call{call}.action"]).max() < 1e-4


@pytest.mark.parametrize(("name", "without"), [("around", None), ("around.missing", [CAMERAS[1]])])
def test_tokens_around_images(
    directory: Path, tmp_path: Path, golden: Mapping[str, Array], others: Mapping[str, Array], name: str, without: Any
) -> None:
    """Those around a black image, of which LeRobot shows as many as are called empty, are not masked."""
    policy, given = copy(directory, tmp_path), arrays(golden, 0)
    for empty, close in ((1, True), (0, without is None)):
        change_json(policy / "config.json", add_image_special_tokens=True, empty_cameras=empty)
        found = eager(policy, given, observed(given), LoadOptions(without_cameras=without))
        assert (np.abs(found - others[name]).max() < 1e-4) == close
    assert np.abs(found - golden["call0.action"]).max() > 0.01
    path = tmp_path / "smolvlm-tiny" / "tokenizer.json"
    path.write_text(path.read_text().replace("<global-img>", "<another>"))
    assert_not_read(policy, "its tokenizer has no <fake_token_around_image> or no <global-img> among the 288 tokens")


def test_tokens_around_images_are_compiled(
    directory: Path, tmp_path: Path, golden: Mapping[str, Array], others: Mapping[str, Array]
) -> None:
    policy, given = copy(directory, tmp_path), arrays(golden, 0)
    change_json(policy / "config.json", add_image_special_tokens=True)
    ttscompile.convert(policy, tmp_path / "compiled")
    compiled = ttscompile.load(tmp_path / "compiled")
    found = compiled.predict_action_chunk(observed(given), noise=Noise(given["noise"]), plan="dense")
    assert np.abs(found - others["around"]).max() < 1e-4


def test_an_expert_with_fewer_layers(
    directory: Path, tmp_path: Path, golden: Mapping[str, Array], others: Mapping[str, Array]
) -> None:
    """Each sees what the first of two layers of the language model has."""
    policy, given = copy(directory, tmp_path), arrays(golden, 0)
    path, own = policy / "model.safetensors", {"num_expert_layers": 2, "self_attn_every_n_layers": -1}
    weights = with_fewer_layers(load_file(path))
    path.unlink()  # it is mapped
    save_file(weights, path)
    change_json(policy / "config.json", **own)
    found = eager(policy, given, observed(given), LoadOptions())
    assert np.abs(found - others["fewer"]).max() < 1e-4
    change_json(policy / "config.json", num_expert_layers=3)
    assert_not_read(policy, "num_expert_layers is 3; expected none, 4 as the language model has, or a part of it if")


def copy(directory: Path, folder: Path) -> Path:
    """The policy and its language model in a folder of the test's, with one that can be changed."""
    shutil.copytree(directory.parent / "smolvlm-tiny", folder / "smolvlm-tiny", copy_function=shutil.copyfile)
    shutil.copytree(directory, folder / "policy", copy_function=shutil.copyfile)
    for each in (folder / "policy", folder / "smolvlm-tiny"):
        each.chmod(0o755)
    return folder / "policy"


def test_what_does_not_fit_is_refused(directory: Path, tmp_path: Path) -> None:
    policy = copy(directory, tmp_path)
    assert_not_read(
        policy,
        "observation.images.side cannot be left out",
        options=LoadOptions(without_cameras=["observation.images.side"]),
    )
    assert_not_read(policy, "all cannot be left out", options=LoadOptions(without_cameras=CAMERAS))
    for entry, value in (("adapt_to_pi_aloha", True), ("num_expert_layers", 2), ("resize_imgs_with_padding", [64, 32])):
        change_json(policy / "config.json", **{entry: value})
        assert_not_read(policy, rf"{entry}.*\. If lerobot takes the file, this is not compiled")
        shutil.copyfile(directory / "config.json", policy / "config.json")


def test_a_tokenizer_that_is_missing_or_of_another_model(directory: Path, tmp_path: Path) -> None:
    policy = copy(directory, tmp_path)
    model = tmp_path / "smolvlm-tiny"
    entries = json.loads((model / "tokenizer.json").read_text())
    entries["model"]["vocab"]["zebra"] = 4000
    entries["added_tokens"].append(dict(entries["added_tokens"][0], id=4000, content="zebra"))
    (model / "tokenizer.json").write_text(json.dumps(entries))
    _, spec = load_checkpoint_policy(policy)
    assert_not_read(policy, "token 4000; the language model has 400", options=LoadOptions(task="zebra"))
    assert tokenizer_of(policy, spec, None) == (
        None,
        f"{model}/tokenizer.json has 4001 tokens, of which the policy knows 400",
    )
    (model / "tokenizer.json").write_text("{")
    assert_not_read(policy, "no tokenizer that can be read", options=LoadOptions(task="go"))
    assert "no tokenizer that can be read" in tokenizer_of(policy, spec, None)[1]
    (model / "tokenizer.json").unlink()
    assert_not_read(
        policy, "is not on this machine: .* has none, and nothing is ever downloaded", options=LoadOptions(task="go")
    )
    assert tokenizer_of(policy, spec, None)[0] is None
    # What stands beside the policy, and not under the name of its model, may be anybody's.
    shutil.copyfile(directory.parent / "smolvlm-tiny" / "tokenizer.json", tmp_path / "tokenizer.json")
    assert tokenizer_of(policy, spec, None)[0] is None
    assert tokenizer_of(policy, spec, tmp_path)[0] == (tmp_path / "tokenizer.json").read_bytes()


def test_without_the_package_that_reads_it_the_artifact_has_no_tokenizer(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, spec = load_checkpoint_policy(directory)
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    content, told = tokenizer_of(directory, spec, None)
    assert content is None and "Install 'ttscompile[tokens]'" in told


def test_a_language_model_of_another_variant_or_with_entries_left_out(directory: Path, tmp_path: Path) -> None:
    """A file of transformers' leaves out what is its default: Llama's, of 32 heads, which this one has not."""
    policy = copy(directory, tmp_path)
    path = tmp_path / "smolvlm-tiny" / "config.json"
    entries = json.loads(path.read_text())
    for wrong in ({"hidden_act": "gelu"}, {"mlp_bias": True}, {"attention_bias": True}):
        path.write_text(json.dumps({**entries, "text_config": entries["text_config"] | wrong}))
        assert_not_read(policy, f"text_config.{next(iter(wrong))} is .*another is not rebuilt here")
    text = {key: value for key, value in entries["text_config"].items() if key != "num_attention_heads"}
    path.write_text(json.dumps({**entries, "text_config": text}))
    assert_not_read(
        policy, "weight .* has shape .*; expected .*, which config.json, or the language model's, describes"
    )


def test_a_processor_or_a_language_model_that_is_missing(directory: Path, tmp_path: Path) -> None:
    policy = copy(directory, tmp_path)
    (policy / "policy_preprocessor.json").unlink()
    with pytest.raises(CheckpointError, match="policy_preprocessor.json: no such file"):
        ttscompile.convert(policy, tmp_path / "out")
    shutil.rmtree(tmp_path / "smolvlm-tiny")
    shutil.copyfile(directory / "policy_preprocessor.json", policy / "policy_preprocessor.json")
    with pytest.raises(CheckpointError, match="language model 'smolvlm-tiny' is not on this machine"):
        ttscompile.convert(policy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_policy_that_exceeds_the_memory_is_refused_before_work(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ttscompile.frontends.saved_weights.memory_bytes", lambda: 2**16)
    with pytest.raises(CheckpointError, match=r"million weights.* takes about 0\.0 GiB .*; this machine has 0\.0 GiB"):
        ttscompile.convert(directory, tmp_path / "out")


def test_a_path_of_this_machine_is_found(directory: Path, tmp_path: Path) -> None:
    """The configuration may name the language model's folder wherever it is."""
    policy = copy(directory, tmp_path)
    (tmp_path / "smolvlm-tiny").rename(tmp_path / "elsewhere")
    model = tmp_path / "elsewhere"
    (tmp_path / "far").mkdir()
    policy.rename(tmp_path / "far" / "policy")
    change_json(tmp_path / "far" / "policy" / "config.json", vlm_model_name=str(model))
    _, spec = load_checkpoint_policy(tmp_path / "far" / "policy")
    assert spec.sample == (50, 32)
