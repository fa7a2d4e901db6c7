"""Every way in which a LeRobot directory can be wrong, or another policy's."""

import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from ttscompile.errors import CheckpointError, SpecError, TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions

from .lerobot_tiny import change_json, save_policy, write_json
from .refused import assert_not_read

STATE = "observation.state"


def _edit(name: str, **changes: Any) -> Callable[[Path], None]:
    return lambda directory: change_json(directory / name, **changes)


def _drop(name: str) -> Callable[[Path], None]:
    return lambda directory: (directory / name).unlink()


def _weights(change: Callable[[dict[str, torch.Tensor]], object], name: str = "model") -> Callable[[Path], None]:
    def apply(directory: Path) -> None:
        weights = load_file(directory / f"{name}.safetensors")
        change(weights)
        save_file(weights, directory / f"{name}.safetensors")

    return apply


def _change(name: str, change: Callable[[Any], object]) -> Callable[[Path], None]:
    """Changes of a document in the directory, or beside it."""

    def apply(directory: Path) -> None:
        content = json.loads((directory / name).read_text(encoding="utf-8"))
        change(content)
        write_json(directory / name, content)

    return apply


def _step(index: int, **changes: Any) -> Callable[[Path], None]:
    return _change("policy_preprocessor.json", lambda content: content["steps"][index].update(changes))


def _insert(index: int, step: dict[str, Any], name: str = "policy_preprocessor.json") -> Callable[[Path], None]:
    return _change(name, lambda content: content["steps"].insert(index, step))


def _normalizer(**changes: Any) -> Callable[[Path], None]:
    """Changes of the normaliser's configuration."""
    return _change("policy_preprocessor.json", lambda content: content["steps"][3]["config"].update(changes))


def _encoder(part: str, **changes: Any) -> Callable[[Path], None]:
    """Changes of the configuration of CLIP beside the policy."""
    return _change("../clip-small/config.json", lambda content: content[part].update(changes))


def _text(content: str) -> Callable[[Path], object]:
    return lambda directory: (directory / "config.json").write_text(content)


RENAME, TOKENIZER = "rename_observations_processor", "tokenizer_processor"
HEAD = "noise_predictor.output_proj.bias"
BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no weights": (_drop("model.safetensors"), "model.safetensors: no such file"),
    "no preprocessor": (_drop("policy_preprocessor.json"), "migrate it with lerobot's own script"),
    "no statistics": (_drop("before.safetensors"), "before.safetensors: no such file"),
    "truncated weights": (lambda d: (d / "model.safetensors").write_bytes(b"\x08" * 40), "not a safetensors file"),
    "no JSON": (lambda d: (d / "config.json").write_text("{"), "cannot be read as JSON"),
    "a list": (lambda d: (d / "config.json").write_text("[]"), "expected an object"),
    "missing weight": (_weights(lambda w: w.pop(HEAD)), f"missing {HEAD}"),
    "another weight": (_weights(lambda w: w.update(extra=torch.ones(1))), "unexpected extra"),
    "wrong shape": (_weights(lambda w: w.update({HEAD: torch.ones(4)})), r"shape \(4,\); expected \(3,\)"),
    "not finite": (_weights(lambda w: w[HEAD].fill_(float("nan"))), "3 values that are not finite"),
    "fewer layers": (_edit("config.json", num_layers=1), "unexpected noise_predictor.transformer_blocks.1"),
    "no state": (_edit("config.json", input_features={}), "no vector 'observation.state'"),
    "odd heads": (_edit("config.json", num_heads=3), "hidden_dim is 16 with 3 heads"),
    "text for a number": (_edit("config.json", horizon="8"), "horizon is '8'; expected a positive whole number"),
    "objective": (_edit("config.json", objective="ddpm"), "expected diffusion or flow_matching"),
    "no type": (_edit("config.json", type=[]), r"the policy is \[\]: not known"),
    "no scheduler": (_edit("config.json", noise_scheduler_type=[]), r"config\.json: noise_scheduler_type is \[\]"),
    "no method": (_edit("config.json", objective="flow_matching", integration_method=[]), "integration_method is"),
    "diffusers": (_edit("config.json", beta_schedule={}), r"config\.json: diffusers refuses the settings"),
    "long name": (_edit("config.json", vision_encoder_name="a" * 5000), "vision_encoder_name is .* expected a name"),
    "NaN": (_text('{"type": "multi_task_dit", "horizon": NaN}'), "cannot be read as JSON: it has the number NaN"),
    "infinite": (_text('{"type": "multi_task_dit", "rope_base": 1e999}'), "the number 1e999 is too large"),
    "twice": (_text('{"type": "act", "type": "multi_task_dit"}'), "the key 'type' is twice"),
    "deep": (_text('{"type": ' + "[" * 70 + "]" * 70 + "}"), "more than 64 levels deep"),
    "very deep": (_text("[" * 100_000), "more than 64 levels deep"),
    "large": (_text(" " * (2**22 + 1)), "more than 4,194,304 bytes"),
    "no text": (lambda d: (d / "config.json").write_bytes(b"\xff{}"), "cannot be read as JSON"),
    "step without a name": (_insert(0, {"class": RENAME}), rf"the step '{RENAME}' is not known here"),
    "step with a list": (_step(1, registry_name=[]), r"the step \[\] is not known here"),
    "step of the other pipeline": (_step(1, registry_name="unnormalizer_processor"), "is not known here"),
    "two renames": (_insert(1, {"registry_name": RENAME}), f"found 2 of {RENAME}"),
    "two tokenizers": (lambda d: [_insert(1, {"registry_name": TOKENIZER})(d) for _ in "ab"], f"2 of {TOKENIZER}"),
    "rename after": (
        lambda d: [_step(0, registry_name="to_batch_processor")(d), _insert(4, {"registry_name": RENAME})(d)],
        "rename_observations_processor before the other steps",
    ),
    "two of one name": (
        _step(0, config={"rename_map": {"a": STATE, "b": STATE}}),
        "rename_map is .*expected one name of the robot for each",
    ),
    "one of two names": (
        _step(0, config={"rename_map": {"observation.images.top": STATE}}),
        "rename_map is .*expected one name of the robot for each",
    ),
    "half precision": (_step(2, config={"float_dtype": "float16"}), "float_dtype is 'float16'"),
    "other length": (_insert(1, {"registry_name": TOKENIZER, "config": {"max_length": 5}}), "max_length is 5, and"),
    "no features": (_normalizer(features=None), "normalizer_processor.features is None"),
    "no keys": (_normalizer(normalize_observation_keys=7), "normalize_observation_keys is 7"),
    "no weight": (_weights(lambda w: w.update({HEAD: torch.ones(3, dtype=torch.int64)})), "is a torch.int64 tensor"),
    "prediction": (_edit("config.json", prediction_type="v_prediction"), "expected epsilon or sample"),
    "scheduler": (_edit("config.json", noise_scheduler_type="PNDM"), "expected DDPM or DDIM"),
    "long instruction": (_edit("config.json", tokenizer_max_length=10), "takes 9 at most"),
    "crop": (_edit("config.json", image_crop_shape=[20, 20]), "takes 16 pixels square"),
    "huge crop": (_edit("config.json", image_crop_shape=[99, 99]), "larger than the image"),
    "no encoder": (_edit("config.json", text_encoder_name="../../etc"), "is not on this machine"),
    "unknown step": (_step(1, registry_name="my_processor"), "'my_processor' is not known"),
    "file elsewhere": (_step(3, state_file="../policy/before.safetensors"), "not the name of a file"),
    "no statistic": (_weights(lambda w: w.pop("observation.state.min"), "before"), "needs observation.state.min"),
    "wide statistic": (
        _weights(lambda w: w.update({"observation.state.min": torch.ones(4)}), "before"),
        r"has shape \(4,\); expected \(5,\)",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", BAD)
def test_bad_directories(tmp_path: Path, case: str) -> None:
    """Every error names the place, what was found and what was expected."""
    change, message = BAD[case]
    directory = save_policy(tmp_path, cameras=("top",))
    change(directory)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint_policy(directory)
    assert str(directory) in str(caught.value) or case == "no encoder"


TOO_LARGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "hidden_dim": (_edit("config.json", hidden_dim=2**16, num_heads=1), "weight .* has shape"),
    "timestep_embed_dim": (_edit("config.json", timestep_embed_dim=2**16), "weight .* has shape"),
    "num_layers": (_edit("config.json", num_layers=100), "do not fit the configuration: missing"),
    "10^9 layers": (_edit("config.json", num_layers=10**9), "num_layers is 1000000000; .*512 at most"),
    "all layers": (_edit("config.json", num_layers=511), "asks for 513 layers"),
    "horizon": (_edit("config.json", horizon=10**9), "horizon is 1000000000; .*4096 at most"),
    "positions": (_edit("config.json", horizon=4096, use_positional_encoding=True), "pos_embedding"),
    "frames": (_edit("config.json", n_obs_steps=8), "weight .* has shape"),
    "steps": (_edit("config.json", num_inference_steps=10**9), "1000000000 denoising steps are not possible"),
    "trained": (_edit("config.json", num_train_timesteps=10**9), r"config\.json: num_train_timesteps is 1000000000"),
    "all trained": (_edit("config.json", num_train_timesteps=9999, num_inference_steps=None), "steps= in Python"),
    "flow": (
        _edit("config.json", objective="flow_matching", num_integration_steps=10**12),
        "1000000000000 integration",
    ),
    "resize": (_edit("config.json", image_resize_shape=[10**6, 10**6]), "4096 pixels at most"),
    "crop": (_edit("config.json", image_crop_shape=[10**6, 10**6]), "4096 pixels at most"),
    "instruction": (_edit("config.json", tokenizer_max_length=10**9), "tokenizer_max_length is"),
    "width": (_encoder("text_config", hidden_size=2**20), "weight .* has shape"),
    "vocabulary": (_encoder("text_config", vocab_size=2**20), "weight .* has shape"),
    "tokens": (_encoder("text_config", max_position_embeddings=10**12), "max_position_embeddings is"),
    "image": (_encoder("vision_config", image_size=4096, patch_size=1, hidden_size=2**20), "weight .* has shape"),
    "channels": (_encoder("vision_config", num_channels=2**20), "expected 3 channels"),
    "patch": (_encoder("vision_config", patch_size=4096), "no larger than the image"),
    "huge": (_encoder("vision_config", intermediate_size=10**40), "intermediate_size is 1000"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", TOO_LARGE)
def test_a_configuration_larger_than_its_weights(tmp_path: Path, case: str) -> None:
    """Refused before anything of its size is made; with the memory limited, torch would fail with another error."""
    change, message = TOO_LARGE[case]
    directory = save_policy(tmp_path, cameras=("top",))
    change(directory)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    begun = time.process_time()
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**29, hard))
    try:
        assert_not_read(directory, message, error=TtscompileError)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.process_time() - begun < 5


def test_cameras_without_end(tmp_path: Path) -> None:
    """Neither many nor large ones."""
    directory = save_policy(tmp_path, cameras=("top",))
    for cameras, size in ((65, 24), (1, 5000)):
        inputs: dict[str, Any] = {STATE: {"type": "STATE", "shape": [5]}}
        inputs |= {f"observation.images.{i}": {"type": "VISUAL", "shape": [3, size, size]} for i in range(cameras)}
        change_json(directory / "config.json", input_features=inputs)
        assert_not_read(directory, f"there are {cameras} cameras .*64 at most, of 4096 pixels")


@pytest.mark.parametrize("content", ["{}", '{"version": "1.0"}', "[", '{"model": {"type": "BPE"}, "added_tokens": 3}'])
def test_a_damaged_tokenizer(tmp_path: Path, content: str) -> None:
    """The tokenizers package raises plain ``Exception``."""
    directory = save_policy(tmp_path)
    (tmp_path / "clip-small" / "tokenizer.json").write_text(content)
    assert_not_read(directory, r"tokenizer\.json: no tokenizer that can be read", options=LoadOptions(task="push"))


@pytest.mark.parametrize(
    ("vocabulary", "merges", "told"),
    [
        (" " * (2**26 + 1), "", r"vocab\.json: has more than"),
        ("{", "", r"vocab\.json: no tokenizer that can be read"),
        ('{"a": 0}', "", r"vocab\.json: no tokenizer that can be read"),
        ('{"<|startoftext|>": 0, "<|endoftext|>": 1}', "a b c d", r"vocab\.json: no tokenizer that can be read"),
    ],
)
def test_damaged_files_of_clip(tmp_path: Path, vocabulary: str, merges: str, told: str) -> None:
    """Its older form: two files."""
    directory = save_policy(tmp_path)
    (tmp_path / "clip-small" / "vocab.json").write_text(vocabulary)
    (tmp_path / "clip-small" / "merges.txt").write_text(merges)
    assert_not_read(directory, told, options=LoadOptions(task="push"))


def test_an_instruction_that_is_placed_otherwise(tmp_path: Path) -> None:
    """Text would become other tokens than in LeRobot: none is taken, and none is compiled in."""
    directory = save_policy(tmp_path)
    path = directory / "policy_preprocessor.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    step: dict[str, Any] = {"registry_name": "tokenizer_processor", "config": {"truncation": False}}
    content["steps"].insert(2, step)
    write_json(path, content)
    assert load_checkpoint_policy(directory)[1].instruction is None
    assert_not_read(directory, "does not cut the instruction; expected truncation", options=LoadOptions(task="push"))
    # CLIP's padding is its end token: before a text it would be read in place of the text's own.
    step["config"] = {"padding_side": "left"}
    write_json(path, content)
    assert_not_read(directory, "the tokenizer's padding_side is 'left'; expected right. CLIP pads with its end token")


def test_the_action_is_normalised_whatever_the_features_say(tmp_path: Path) -> None:
    """As lerobot does: ``features`` are looked at for observations only."""
    directory = save_policy(tmp_path)
    path = directory / "policy_postprocessor.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    expected = load_checkpoint_policy(directory)[1].chunk.normalizer
    content["steps"][0]["config"]["features"] = {}
    write_json(path, content)
    found = load_checkpoint_policy(directory)[1].chunk.normalizer
    assert found is not None and expected is not None
    assert found.scale.tolist() == expected.scale.tolist()


OTHERS = {
    "vqbet": "autoregressive over codes of actions. There is no denoising loop",
    "pi0_fast": "autoregressive over codes of actions. There is no denoising loop",
    "tdmpc": "a world model with a planner. There is no denoising loop",
    "sac": "an actor of reinforcement learning. There is no denoising loop",
    "molmoact2": "a policy whose backbone, Molmo, is not rebuilt here.*compile_denoiser",
    "fastwam": "a world model that denoises video .* No module of it was compiled yet",
    "lingbot_va": "a world model that denoises video .* No module of it was compiled yet",
    "something_new": "not known. Expected act, .*compile_denoiser",
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_policies_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    """Each with what can be done instead."""
    directory = save_policy(tmp_path)
    change_json(directory / "config.json", type=kind)
    assert_not_read(directory, rf"the policy is {kind}: {OTHERS[kind]}")


def test_adapters_and_other_directories(tmp_path: Path) -> None:
    """An adapter alone, an empty directory, a training run's folder, and options of another format."""
    directory = save_policy(tmp_path)
    (directory / "model.safetensors").unlink()
    write_json(directory / "adapter_config.json", {"peft_type": "LORA"})
    assert_not_read(directory, r"adapter_config\.json: the base is None: .*Give the base policy")
    empty = tmp_path / "empty"
    (empty / "pretrained_model").mkdir(parents=True)
    assert_not_read(empty, "pretrained_model")
    assert_not_read(tmp_path / "nowhere", "no such file or directory", format="lerobot")
    assert_not_read(tmp_path / "policy.ckpt", "for policies of LeRobot, ", options=LoadOptions(task="push"))


def test_samplers_of_the_wrong_objective(tmp_path: Path) -> None:
    """A solver of the one cannot run the other."""
    assert_not_read(
        save_policy(tmp_path, objective="flow_matching"),
        "flow-matching method 'ddim' is not known; expected one of euler, rk4",
        error=SpecError,
        options=LoadOptions(sampler="ddim"),
    )
    assert_not_read(tmp_path / "policy", "spacing", error=SpecError, options=LoadOptions(spacing="trailing"))
