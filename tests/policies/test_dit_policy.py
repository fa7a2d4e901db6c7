"""DiT-Policy from the folder that its training wrote, raw images to actions, against dit-policy ba22ee3."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tests.families.checks import golden
from tests.families.weights import draw_weights, uniform_images
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.dit_policy import DiTPolicyHead
from ttscompile.policies.networks.dit_policy_tokens import Observed, Tokens, TokensConfig

from .authors import assert_acts_as_the_original, assert_loops, by_one_command
from .refused import assert_not_read

CLASS = "data4robotics.models.diffusion.DiffusionTransformerAgent"
NET = {"time_dim": 16, "hidden_dim": 24, "num_blocks": 2, "dim_feedforward": 40, "nhead": 3, "activation": "gelu"}
RESNET = {"_target_": "data4robotics.models.resnet.ResNet", "size": 18, "weights": "IMAGENET1K_V1", "restore_path": ""}
RESNET |= {"avg_pool": False, "conv_repeat": 0, "norm_cfg": {"name": "group_norm", "num_groups": 16}}
AGENT = {
    "features": RESNET,
    "_target_": CLASS,
    "odim": 4,
    "n_cams": 2,
    "use_obs": "add_token",
    "dropout": 0.1,
    "train_diffusion_steps": 100,
    "eval_diffusion_steps": 8,
    "ac_dim": 5,
    "ac_chunk": 6,
    "imgs_per_cam": 1,
    "share_cam_features": False,
    "early_fusion": False,
    "feat_norm": "layer_norm",
    "token_dim": 24,
    "noise_net_kwargs": NET | {"dropout": 0.1},
}
LOC, SCALE = np.linspace(-1, 1, 5), np.linspace(0.5, 2, 5)

Weights = dict[str, torch.Tensor]


def tokens_config() -> TokensConfig:
    return TokensConfig(2, groups=16, state=4, projected=24, normed=True)


@cache
def weights() -> Weights:
    """Those of the golden file, under the names of the agent's ``state_dict``; not to be changed."""
    head = DiTPolicyHead(24, heads=3, layers=2, hidden=40, waves=16, horizon=6, actions=5).state_dict()
    own = Tokens(tokens_config()).state_dict() | {f"noise_net.{name}": value for name, value in head.items()}
    shapes = {name: tuple(value.shape) for name, value in own.items()}
    return draw_weights(shapes, int(golden("dit_policy_images")["seed"]))


def save(folder: Path, model: Weights | None = None, **changes: Any) -> Path:
    """As ``finetune.py`` and ``save_checkpoint`` write it."""
    (folder / "agent_config.yaml").write_text(yaml.safe_dump(AGENT | changes, sort_keys=False))
    (folder / "ac_norm.json").write_text(json.dumps({"loc": LOC.tolist(), "scale": SCALE.tolist()}))
    saved = {} if model is None else model | {"noise_net.enc_pos.pe": torch.zeros(5000, 1, 24)}
    optim = {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 3e-4, "params": [0]}]}
    schedule = {"base_lrs": [3e-4], "last_epoch": 1, "lr_lambdas": [{}]}
    torch.save({"model": saved, "optim": optim, "schedule": schedule, "global_step": 1}, folder / "test.ckpt")
    return folder / "test.ckpt"


@pytest.mark.slow
def test_one_command_compiles_a_policy_that_acts_as_the_original(tmp_path: Path) -> None:
    path, arrays = save(tmp_path, weights()), golden("dit_policy_images")
    images = uniform_images(2, 2, 256, seed=117)
    observed = {"cam0": images[:, 0], "cam1": images[:, 1], "state": arrays["state"]}
    compiled, actions = by_one_command(path), arrays["actions"] * SCALE + LOC
    policy, _ = assert_acts_as_the_original(path, compiled, observed, arrays["noise"], actions, "action_pred")
    assert policy.info.K == 8
    assert set(policy.info.observation) == set(observed)


@pytest.mark.slow
def test_the_state_in_every_token_and_one_token_an_image(tmp_path: Path) -> None:
    config = TokensConfig(1, state=4, padded=True, pooled=True)
    tokens = Tokens(config)
    arrays = golden("dit_policy_images")
    shapes = {name: tuple(value.shape) for name, value in tokens.state_dict().items()}
    tokens.load_state_dict(draw_weights(shapes, int(arrays["seed"])))
    images = torch.from_numpy(uniform_images(2, 2, 256, seed=117)[:, 0])
    with torch.no_grad(), Counted() as counted:
        made = Observed(tokens.eval())({"cam0": images, "state": torch.from_numpy(arrays["state"])})
    assert_equal_but_for_rounding(made, arrays["padded_tokens"], counted.terms, counted.angle)


@pytest.mark.slow
def test_the_sampler_is_the_configurations_or_the_one_that_is_asked_for(tmp_path: Path) -> None:
    path = save(tmp_path, weights(), train_diffusion_steps=50, eval_diffusion_steps=5)
    assert_loops(path, ("ddim", 5, 40), ("dpmsolver++", 3), "dit_policy")


def test_without_the_numbers_of_its_actions_it_says_so(tmp_path: Path) -> None:
    path = save(tmp_path, weights())
    (tmp_path / "ac_norm.json").unlink()
    with pytest.warns(
        UserWarning, match=r"ac_norm\.json: no such file, so actions are those of the network, in -1\.\.1"
    ):
        spec = load_checkpoint_policy(path)[1]
    assert spec.chunk.normalizer is None


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"_target_": "data4robotics.agent.MLPAgent"}, f"_target_ is 'data4robotics.agent.MLPAgent'; expected {CLASS}"),
    ({"features": RESNET | {"_target_": "data4robotics.models.resnet.R3M"}}, "features._target_ is .*R3M.*; expected"),
    ({"features": RESNET | {"size": 50}}, "features.size is 50; expected 18 or 34"),
    ({"features": RESNET | {"norm_cfg": {"name": "batch_norm"}}}, "norm_cfg.name is 'batch_norm'; expected group_norm"),
    ({"features": RESNET | {"norm_cfg": {"num_groups": 7}}}, "num_groups is 7; expected a divisor of 64"),
    ({"features": None}, "features is None; expected settings by name"),
    ({"share_cam_features": True}, "share_cam_features is True; expected false: another is not rebuilt"),
    ({"imgs_per_cam": 2}, "imgs_per_cam is 2; expected 1"),
    ({"feat_norm": "batch_norm"}, "feat_norm is 'batch_norm'; expected null or layer_norm"),
    ({"use_obs": "film"}, "use_obs is 'film'; expected false, add_token or pad_img_tokens"),
    ({"noise_net_kwargs": NET | {"hidden_dim": 512}}, "hidden_dim is 512; expected 24, which the tokens have"),
    ({"noise_net_kwargs": NET | {"nhead": 5}}, "hidden_dim is 24; expected an even multiple of nhead, 5"),
    ({"noise_net_kwargs": NET | {"time_dim": 15}}, "time_dim is 15; expected an even number"),
    ({"noise_net_kwargs": NET | {"num_blocks": 10**9}}, "num_blocks is 1000000000; expected a positive whole number"),
    ({"ac_dim": "${task.ac_dim}"}, r"ac_dim is '\$\{task.ac_dim\}'; expected a positive whole number"),
    ({}, r"test\.ckpt: .*missing dec_pos, .*another network than agent_config\.yaml describes"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_is_not_rebuilt_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    assert_not_read(save(tmp_path, **changes), message, names=tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [1]\nb: *a\n", "cannot be read as plain YAML: an alias .a."),
        ("a: !!python/object/apply:os.system ['false']\n", "cannot be read as plain YAML: .*python/object/apply"),
        ("[" * 10_000, "cannot be read as plain YAML"),
        ("a: [1\n", "cannot be read as plain YAML.*line 2"),
        ("- 1\n", "holds a list; expected settings by name"),
        ("1: 1\n", "holds a dict; expected settings by name"),
        ("#" * 300_000, "larger than 262144 bytes"),
    ],
)
def test_a_damaged_or_hostile_configuration_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = save(tmp_path)
    (tmp_path / "agent_config.yaml").write_text(text)
    assert_not_read(path, rf"agent_config\.yaml: {message}")


@pytest.mark.parametrize(
    ("norms", "message"),
    [
        ({"loc": [0.0], "scale": [1.0] * 5}, r"shapes \(1,\) and \(5,\); expected 5 numbers each"),
        ({"loc": [0.0] * 5, "scale": [0.0] * 5}, "scale must be finite"),
        ({"loc": "a", "scale": 1}, "could not convert string to float"),
        ({}, r"shapes \(\) and \(\)"),
    ],
)
def test_damaged_numbers_of_actions_are_refused(norms: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = save(tmp_path, weights())
    (tmp_path / "ac_norm.json").write_text(json.dumps(norms))
    assert_not_read(path, rf"ac_norm\.json: .*{message}.*Copy the file again")


def test_a_hostile_checkpoint_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path)
    torch.save({"model": {"a": print}}, path)
    assert_not_read(path, r"test\.ckpt: refused, .*could run code")
    torch.save({"model": 1}, path)
    assert_not_read(path, r"test\.ckpt: its entry 'model' is a int; expected weights by name")
