"""Dita, whole, from a checkpoint and the configuration of its training, to the actions of Dita 66350e7."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.checks import assert_runtimes_agree, golden, kinds
from tests.families.support import record, stored_program
from ttscompile.artifact import load_artifact
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions

from .authors import assert_acts_as_the_original, assert_loops, by_one_command
from .ditas import CASES, CLIP, MASK, TASKS, TOKENS, WORDS, Weights, observed, save, save_clip, weights
from .refused import assert_not_read

UNTOLD = "ignore:.*the text encoder:UserWarning"
TOWER, MAKER = "image_tokenizer.tokenizer.", "image_tokenizer.qformer."


def told(encoders: Path, tasks: tuple[str, ...] = TASKS) -> dict[str, np.ndarray]:
    """Tokens of instructions, and which count."""
    tokenizer = Tokenizer(encoders / CLIP, CheckpointError)
    rows, mask = padded([tokenizer(task) for task in tasks], 77)
    return {TOKENS: rows, MASK: mask}


def features(path: Path, encoders: Path) -> np.ndarray:
    """Of the words of both instructions, as our CLIP gives them."""
    module: Any = load_checkpoint_policy(path, options=LoadOptions(encoders=encoders))[0]
    with torch.no_grad():
        made: np.ndarray = module.encoder.words(*map(torch.from_numpy, told(encoders).values())).numpy()
    return made


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_one_command_compiles_a_policy_that_acts_as_the_original(case: str, tmp_path: Path) -> None:
    """From the camera's pictures and the words of two instructions, with the runtime of the robot."""
    path, encoders, arrays = save(tmp_path, case), save_clip(tmp_path / "encoders"), golden("dita")
    compiled = by_one_command(path, "--encoders", str(encoders))
    policy = ttscompile.load(compiled, runtime="onnxruntime")
    given = {**observed(case), "task": list(TASKS)}
    noise, expected = arrays[f"{case}.noise"], arrays[f"{case}.actions"]
    made = policy.predict_action(given, noise=ttscompile.Noise(noise), plan="dense")["action"]
    assert np.abs(made - expected).max() < 5e-5
    assert np.abs(expected[0] - expected[1]).max() > 0.01
    program = stored_program(load_artifact(compiled))
    assert kinds(program) == {"self_attention": 2, "feed_forward": 2}
    # Towers of the instruction and of each camera.
    assert len(program.pieces.towers) == 2 + CASES[case].wrist
    if case == "static":
        compared = "Dita 66350e7 `PytorchDiffInference.inference`, from raw pictures and words, 5e-5"
        record("Dita, whole, read from its file", compared, "ddim 10", program)


@pytest.mark.soak
def test_runtimes_agree(tmp_path: Path) -> None:
    path, encoders = save(tmp_path), save_clip(tmp_path / "encoders")
    assert_runtimes_agree(by_one_command(path, "--encoders", str(encoders)))


@pytest.mark.slow
@pytest.mark.filterwarnings(UNTOLD)
def test_without_the_encoder_its_features_are_observed(tmp_path: Path) -> None:
    path, arrays = save(tmp_path), golden("dita")
    words = features(path, save_clip(tmp_path / "encoders"))
    given = {**observed("static"), WORDS: words}
    noise, expected = arrays["static.noise"], arrays["static.actions"]
    policy, _ = assert_acts_as_the_original(path, by_one_command(path), given, noise, expected)
    assert policy.info.observation[WORDS].shape == (77, 128)


@pytest.mark.slow
def test_a_task_that_is_compiled_in_needs_no_encoder_on_the_robot(tmp_path: Path) -> None:
    path, encoders, arrays = save(tmp_path), save_clip(tmp_path / "encoders"), golden("dita")
    compiled = by_one_command(path, "--encoders", str(encoders), "--task", TASKS[0])
    policy = ttscompile.load(compiled, runtime="onnxruntime")
    assert set(policy.info.observation) == {"image"}
    given = {name: value[:1] for name, value in observed("static").items()}
    for streams in (1, 2):
        policy.reset()
        noise = ttscompile.Noise(np.repeat(arrays["static.noise"][:1], streams, 0))
        many = {name: np.repeat(value, streams, 0) for name, value in given.items()}
        made = policy.predict_action(many, noise=noise, plan="dense")["action"]
        assert np.abs(made - arrays["static.actions"][:1]).max() < 5e-5


@pytest.mark.filterwarnings("error")
def test_that_features_are_observed_is_said(tmp_path: Path) -> None:
    message = rf"the text encoder {CLIP} is in no checkpoint of Dita, .* the words are observed: {WORDS} \[77, 128\]"
    with pytest.warns(UserWarning, match=message):
        spec = load_checkpoint_policy(save(tmp_path))[1]
    assert spec.instruction is None


def test_words_may_not_be_half_there(tmp_path: Path) -> None:
    path, encoders = save(tmp_path), save_clip(tmp_path / "encoders")
    for options in (LoadOptions(task="go"), LoadOptions(encoders=tmp_path / "nowhere")):
        assert_not_read(path, f"the text encoder '{CLIP}' is not on this machine", options=options, names=tmp_path)
    config = encoders / CLIP / "config.json"
    config.write_text(config.read_text().replace('"hidden_size": 128', '"hidden_size": 64'))
    assert_not_read(
        path,
        "the text encoder in .* is 64 wide, for 77 tokens; expected 128, and 77",
        options=LoadOptions(encoders=encoders),
    )
    (encoders / CLIP / "model.safetensors").unlink()
    config.write_text(config.read_text().replace('"hidden_size": 64', '"hidden_size": 128'))
    assert_not_read(path, r"model\.safetensors: no such file", options=LoadOptions(encoders=encoders))


def test_the_padding_of_an_instruction_is_read_as_the_original_pads_it(tmp_path: Path) -> None:
    """Tokens behind the mask are nobody's: the last of CLIP's is there, whatever stands there."""
    path, encoders = save(tmp_path), save_clip(tmp_path / "encoders")
    module: Any = load_checkpoint_policy(path, options=LoadOptions(encoders=encoders))[0]
    tokens, mask = map(torch.from_numpy, told(encoders).values())
    with torch.no_grad():
        made, other = (module.encoder.words(torch.where(mask, tokens, n), mask) for n in (0, 513))
    torch.testing.assert_close(made, other, rtol=0, atol=0)


def test_of_the_wrist_every_second_patch_is_seen(tmp_path: Path) -> None:
    """The original draws half of them anew at each call, in evaluation, too."""
    path, encoders = save(tmp_path, "wrist"), save_clip(tmp_path / "encoders")
    module: Any = load_checkpoint_policy(path, options=LoadOptions(encoders=encoders))[0]
    given = {name: torch.from_numpy(value) for name, value in observed("wrist").items()}
    given |= {key.replace(".", "_"): torch.from_numpy(value) for key, value in told(encoders).items()}
    seen = np.zeros((3, 2), bool)
    with torch.no_grad():
        before = module.encoder(given)
        for row, column in np.ndindex(3, 2):
            changed = given["wrist_image"].clone()
            changed[..., 14 * row : 14 * row + 14, 14 * column : 14 * column + 14] = 0.5
            seen[row, column] = not torch.equal(before, module.encoder({**given, "wrist_image": changed}))
    assert seen.tolist() == [[False, True], [True, False], [False, True]]


@pytest.mark.filterwarnings(UNTOLD)
def test_the_lengths_and_the_sampler_are_the_configurations(tmp_path: Path) -> None:
    path = save(tmp_path, scheduler_type=1, num_inference_steps=20, num_pred_action=4)
    spec = assert_loops(path, ("ddim", 20, 950), ("dpmsolver++", 3), "dita")
    assert spec.observations["image"].shape == (3, 3, 28, 28)
    assert (spec.chunk.start, spec.chunk.stop, spec.sample) == (2, 6, (6, 7))
    for wrapped, length in ((1, 5), (2, 6)):
        path = save(tmp_path, wrap_grmg_data=wrapped, dataset={"traj_length": 9})
        spec = load_checkpoint_policy(path)[1]
        assert (spec.sample[0], spec.chunk.stop - spec.chunk.start) == (length, 5)


@pytest.mark.filterwarnings(UNTOLD)
@pytest.mark.parametrize(("given", "size"), [(28, (28, 28)), ("(14, 56)", (14, 56)), (None, (28, 28))])
def test_the_size_of_pictures(given: object, size: tuple[int, int], tmp_path: Path) -> None:
    changes: dict[str, Any] = {} if given is None else {"input_size": given}
    spec = load_checkpoint_policy(save(tmp_path, **changes))[1]
    assert spec.observations["image"].shape == (2, 3, *size)
    assert spec.observations["image"].image


@pytest.mark.filterwarnings(UNTOLD)
def test_actions_of_seven_numbers_are_the_robots_where_its_data_set_says_so(tmp_path: Path) -> None:
    path = save(tmp_path)
    assert load_checkpoint_policy(path)[1].chunk.normalizer is None
    low, high = [-0.5] * 7, [1.5] * 7
    entry = {"q01": low, "q99": high, "mask": [True] * 6 + [False]}
    (tmp_path / "dataset_statistics.json").write_text(json.dumps({"libero": {"action": entry}}))
    normalizer = load_checkpoint_policy(path)[1].chunk.normalizer
    assert normalizer is not None
    ends = normalizer.unnormalize(np.array([[-1.0] * 7, [1.0] * 7], np.float32))
    np.testing.assert_allclose(ends, [[-0.5] * 6 + [-1], [1.5] * 6 + [1]], rtol=1e-6)


@pytest.mark.filterwarnings(UNTOLD)
def test_other_files_that_hold_the_same_network(tmp_path: Path) -> None:
    path = save(tmp_path)
    expected = copy.deepcopy(load_checkpoint_policy(path)[0].state_dict())  # its memory is the file
    save(tmp_path, held={f"module._orig_mod.{name}": value for name, value in weights("static").items()})
    torch.testing.assert_close(dict(load_checkpoint_policy(path)[0].state_dict()), dict(expected), rtol=0, atol=0)
    old = {"transformer.model.layers.0.self_attn.rotary_emb.inv_freq": torch.zeros(32)}
    torch.save(weights("static") | old, path)
    torch.testing.assert_close(dict(load_checkpoint_policy(path)[0].state_dict()), dict(expected), rtol=0, atol=0)
    save(tmp_path, held={name: value.half() for name, value in weights("static").items()})
    halved = {name: value.half().float() for name, value in expected.items()}
    torch.testing.assert_close(dict(load_checkpoint_policy(path)[0].state_dict()), halved, rtol=0, atol=0)


LAYER = "transformer.model.layers.0.mlp."
REFUSED: list[tuple[dict[str, Any], Weights, str]] = [
    ({"use_action_head_diff": 2}, {}, "use_action_head_diff is 2; expected 0: another is not rebuilt here"),
    ({"dim_align_type": 1}, {}, "dim_align_type is 1; expected 0"),
    ({"cfg": 1.5}, {}, "cfg is 1.5; expected 0: another is not rebuilt here"),
    ({"abs_sup": 3}, {}, "abs_sup is 3; expected 0: another is not rebuilt here"),
    ({"model": {"use_depth_img": True}}, {}, r"model\.use_depth_img is True; expected false: another is not rebuilt"),
    (
        {"dataset": None},
        {},
        r"config\.yaml: dataset is None; expected settings by name\. Give the \.hydra/config\.yaml",
    ),
    ({"dataset": {}}, {}, "dataset.traj_length is None; expected a positive whole number, 4096 at most"),
    ({"num_pred_action": 7}, {}, "num_pred_action is 7; expected 6 at most, of dataset.traj_length"),
    ({"prediction_type": "flow"}, {}, "prediction_type is 'flow'; expected epsilon or sample or v_prediction"),
    ({"scheduler_type": "x"}, {}, "scheduler_type is 'x'; expected a whole number"),
    ({"input_size": "wide"}, {}, "input_size is 'wide'; expected a positive whole number"),
    ({"input_size": 224}, {}, r"input_size is 224; expected '\(height, width\)' in pixels, of 4 patches of 14 x 14"),
    ({"input_size": "(28, 35)"}, {}, r"input_size is '\(28, 35\)'; expected '\(height, width\)' in pixels, of 4"),
    (
        {},
        {f"{LAYER}gate_proj.weight": None},
        r"ckpt_1000\.pth: no weight transformer\.model\.layers\.0\.mlp\.gate_proj.* \(found none\)",
    ),
    ({}, {f"{LAYER}gate_proj.weight": torch.zeros(80, 100)}, "is 100 wide; expected a multiple of 64"),
    ({}, {f"{LAYER}up_proj.weight": None}, r"missing transformer\.model\.layers\.0\.mlp\.up_proj\.weight"),
    ({}, {f"{LAYER}up_proj.weight": torch.zeros(2, 2)}, r"up_proj\.weight has shape \(2, 2\); expected \(80, 128\)"),
    ({}, {f"{LAYER}up_proj.weight": torch.full((80, 128), torch.inf)}, "10240 values that are not finite"),
    ({}, {f"{LAYER}up_proj.lora_A.default.weight": torch.zeros(2)}, r"holds an adapter \(LoRA: .*merge_and_unload"),
    ({}, {f"{MAKER}queries": None}, "whose rows are the tokens of a frame; expected a Dita with use_qformer"),
    (
        {},
        {"diffuse_action_head.w": torch.zeros(2)},
        "diffuse_action_head.w; expected a network without use_action_head",
    ),
    ({}, {f"{TOWER}patch_embed_depth.proj.bias": torch.zeros(2)}, "patch_embed_depth.* and use_depth_img: another is"),
    ({}, {f"{TOWER}reg_token": None}, "no weight image_tokenizer.tokenizer.reg_token of 3 axes"),
    ({}, {f"{TOWER}patch_embed.proj.weight": torch.zeros(64, 3, 14, 14)}, "its image encoder is 64 wide, with patches"),
    ({}, {f"{TOWER}blocks.1.ls2.gamma": None}, r"missing tokenizer\.encoder\.layers\.1\.lambda_2"),
    (
        {},
        {f"{MAKER}blocks.1.film_layer._projection_add.bias": None},
        "missing qformer.blocks.1.film_layer._projection_a",
    ),
]


@pytest.mark.parametrize(("changes", "replaced", "message"), REFUSED)
def test_what_is_no_such_network_is_refused(
    changes: dict[str, Any], replaced: Weights, message: str, tmp_path: Path
) -> None:
    held = {name: value for name, value in (weights("static") | replaced).items() if value is not None}
    assert_not_read(save(tmp_path, held=held, **changes), message, names=tmp_path)


def test_hostile_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path, held={"a": print})
    assert_not_read(path, r"ckpt_1000\.pth: refused, .*could run code")
    torch.save({"parameter": [1]}, path)
    assert_not_read(path, "its entry 'parameter' is a list; expected weights by name")
    (tmp_path / ".hydra" / "config.yaml").write_text("a: [1\n")
    assert_not_read(path, r"config\.yaml: cannot be read as plain YAML")
