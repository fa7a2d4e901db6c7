"""RDT-1B's own directory: read, compiled, and its actions those of the original's ``predict_action``."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tests.families.checks import golden
from tests.policies.saved import RDT, rdt_observation, rdt_with, save_rdt, weights_of
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions

from .authors import assert_acts_as_the_original, by_one_command
from .refused import assert_not_read

pytestmark = pytest.mark.filterwarnings("ignore:.*the image encoder:UserWarning")


@pytest.mark.slow
def test_a_converted_directory_acts_as_the_original(tmp_path: Path) -> None:
    """With the runtime of the robot. A number that the mask leaves out is 0, as the original's is."""
    directory, arrays = save_rdt(tmp_path / "rdt"), golden("rdt")
    compiled = by_one_command(directory)
    policy, made = assert_acts_as_the_original(
        directory, compiled, rdt_observation(), arrays["noise"], arrays["actions"]
    )
    assert not made[..., 4].any() and made[..., :4].all()
    assert policy.info.K == 5 and dict(policy._spec.source) == {"format": "rdt"}


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["dpmsolver++", "ddim", "ddpm"])
def test_every_loop_masks_what_it_gives_and_nothing_before(sampler: str, tmp_path: Path) -> None:
    directory = save_rdt(tmp_path / "rdt")
    module, spec = load_checkpoint_policy(directory, options=LoadOptions(sampler=sampler, steps=8))
    own = spec.in_loop(f"{sampler}-8")
    assert (own.sampler.timesteps < 0).tolist() == 7 * [False] + [True]
    rng = np.random.default_rng(0)
    noise = Noise(golden("rdt")["noise"], rng.standard_normal((8, 2, 6, 5), dtype=np.float32))
    obs = {key: torch.from_numpy(value) for key, value in rdt_observation().items()}
    found = eager_policy(module, own)(obs, noise).numpy()
    timesteps = own.sampler.timesteps.copy()
    timesteps[-1] = -1 - timesteps[-1]
    unmarked = replace(own, sampler=replace(own.sampler, timesteps=timesteps))
    plain = eager_policy(module, unmarked)(obs, noise).numpy()
    assert plain[..., 4].all() and not found[..., 4].any()
    np.testing.assert_array_equal(found[..., :4], plain[..., :4])


def test_weights_are_read_from_either_file_in_any_floating_point_type(tmp_path: Path) -> None:
    """As the original does: safetensors first."""
    directory, weights = save_rdt(tmp_path / "rdt"), weights_of("rdt")
    first = load_checkpoint_policy(directory)[0].state_dict()
    save_file({key: value.bfloat16() for key, value in weights.items()}, directory / "model.safetensors")
    second = load_checkpoint_policy(directory)[0].state_dict()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.dtype == second[name].dtype == torch.float32
        assert torch.equal(value.bfloat16().float(), second[name])


@pytest.mark.parametrize(("adaptor", "depths"), [("linear", (0, 2, 3)), ("mlp1x_gelu", (1, 2, 3))])
def test_adaptors_are_what_their_names_say(adaptor: str, depths: tuple[int, int, int], tmp_path: Path) -> None:
    directory = save_rdt(tmp_path / "rdt", rdt_with(depths).state_dict(), lang_adaptor=adaptor)
    module, spec = load_checkpoint_policy(directory)
    obs = {key: torch.from_numpy(value) for key, value in rdt_observation().items()}
    assert torch.isfinite(eager_policy(module, spec)(obs, Noise(golden("rdt")["noise"]))).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rdt": RDT["rdt"] | {"depth": 5}}, r"missing model\.blocks\.4.*another network than config\.json describes"),
        (
            {"rdt": RDT["rdt"] | {"hidden_size": 2**30}},
            "rdt.hidden_size is 1073741824; expected a positive whole number,",
        ),
        ({"rdt": RDT["rdt"] | {"num_heads": 5}}, "hidden_size is 32 with 5 heads; expected a multiple of the heads"),
        ({"rdt": None}, "rdt is None; expected settings by name. Give the folder"),
        ({"img_adaptor": "resampler"}, r"img_adaptor is 'resampler'; expected linear, or mlpNx_gelu with N = 1 to 16"),
        ({"img_adaptor": "mlp99x_gelu"}, "img_adaptor is 'mlp99x_gelu'; expected linear"),
        ({"state_token_dim": 6}, "state_token_dim is 6; expected 5, as action_dim is"),
        ({"img_cond_len": 9}, r"img_cond_pos_embed has shape \(1, 8, 32\); expected \(1, 9, 32\)"),
        ({"pred_horizon": 10**9}, "pred_horizon is 1000000000; expected a positive whole number, 65536 at most"),
        ({"noise_scheduler": {"num_inference_timesteps": 5}}, "noise_scheduler: num_train_timesteps is None"),
        (
            {"noise_scheduler": RDT["noise_scheduler"] | {"prediction_type": "epsilon"}},
            "prediction_type is 'epsilon'; expected sample: another is not rebuilt here.*compile_denoiser",
        ),
    ],
)
def test_a_directory_that_is_no_such_policy_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    directory = save_rdt(tmp_path / "rdt", **changes)
    assert_not_read(directory, message, names=directory)


def test_weights_that_are_missing_damaged_or_hostile_are_refused(tmp_path: Path) -> None:
    directory = save_rdt(tmp_path / "rdt", {"lang_adaptor.0.weight": print})  # type: ignore[dict-item]
    assert_not_read(directory, "could run code while loading. Nothing of the file was executed")
    (directory / "pytorch_model.bin").write_bytes(b"no archive")
    assert_not_read(directory, "not a torch checkpoint, or a truncated one")
    (directory / "pytorch_model.bin").unlink()
    assert_not_read(directory, r"expected model\.safetensors or pytorch_model\.bin; found neither. Copy")
    (directory / "model.safetensors").write_bytes(b"no tensors")
    assert_not_read(directory, r"model\.safetensors: not a safetensors file, or a truncated one")
    (directory / "config.json").write_text(json.dumps(RDT)[:-20])
    assert_not_read(directory, r"config\.json: cannot be read as JSON")


@pytest.mark.parametrize("file", ["model.safetensors", "pytorch_model.bin"])
def test_more_weights_than_the_machine_can_compile_are_refused(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = save_rdt(tmp_path / "rdt")
    if file == "model.safetensors":
        save_file(weights_of("rdt"), directory / file)
    monkeypatch.setattr("ttscompile.frontends.saved_weights.memory_bytes", lambda: 1000)
    assert_not_read(directory, rf"{file}: 0 million weights.* Compiling them takes about 0\.0 GiB")


def test_options_of_other_families_are_refused(tmp_path: Path) -> None:
    assert_not_read(
        save_rdt(tmp_path / "rdt"),
        "the option task is for policies of LeRobot, GR00T, Evo-1, Dita, openpi, Octo; this is one of RDT",
        options=LoadOptions(task="push the block"),
    )
