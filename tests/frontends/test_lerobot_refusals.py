"""Every way in which a LeRobot directory can be wrong, or another policy's."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends import load_checkpoint_policy

from .lerobot_tiny import change_json, save_policy, write_json

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


def _step(index: int, **changes: Any) -> Callable[[Path], None]:
    def apply(directory: Path) -> None:
        path = directory / "policy_preprocessor.json"
        content = json.loads(path.read_text(encoding="utf-8"))
        content["steps"][index] |= changes
        write_json(path, content)

    return apply


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
    "prediction": (_edit("config.json", prediction_type="v_prediction"), "expected epsilon or sample"),
    "scheduler": (_edit("config.json", noise_scheduler_type="PNDM"), "expected one of DDPM, DDIM"),
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


@pytest.mark.parametrize("case", BAD)
def test_bad_directories(tmp_path: Path, case: str) -> None:
    """Every error names the place, what was found and what was expected."""
    change, message = BAD[case]
    directory = save_policy(tmp_path, cameras=("top",))
    change(directory)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint_policy(directory)
    assert str(directory) in str(caught.value) or case in ("prediction", "scheduler", "no encoder")


def test_missing_statistics_are_said(tmp_path: Path) -> None:
    """Without statistics lerobot does not normalise, and neither do we; it is worth a warning."""
    directory = save_policy(tmp_path)
    _weights(lambda w: [w.pop(k) for k in list(w) if k.startswith(STATE)], "before")(directory)
    with pytest.warns(UserWarning, match=r"no statistics of observation\.state"):
        load_checkpoint_policy(directory)


@pytest.mark.parametrize("kind", ["diffusion", "act", "smolvla", "pi0", "groot", "pi0_fast", "something_new"])
def test_other_policies_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    """Each with what can be done instead."""
    directory = save_policy(tmp_path)
    change_json(directory / "config.json", type=kind)
    with pytest.raises(CheckpointError, match=kind) as caught:
        load_checkpoint_policy(directory)
    remedy = {"diffusion": "multi_task_dit", "act": "no denoising loop", "pi0_fast": "no denoising loop"}
    assert re.search(remedy.get(kind, "compile_denoiser"), str(caught.value))


def test_adapters_and_other_directories(tmp_path: Path) -> None:
    """An adapter alone, an empty directory, a training run's folder, and options of another format."""
    directory = save_policy(tmp_path)
    (directory / "model.safetensors").unlink()
    write_json(directory / "adapter_config.json", {"peft_type": "LORA"})
    with pytest.raises(CheckpointError, match=r"PEFT.*[Mm]erge"):
        load_checkpoint_policy(directory)
    empty = tmp_path / "empty"
    (empty / "pretrained_model").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="pretrained_model"):
        load_checkpoint_policy(empty)
    with pytest.raises(CheckpointError, match="no such directory"):
        load_checkpoint_policy(tmp_path / "nowhere", format="lerobot")
    with pytest.raises(CheckpointError, match="for LeRobot policies"):
        load_checkpoint_policy(tmp_path / "policy.ckpt", task="push")


def test_samplers_of_the_wrong_objective(tmp_path: Path) -> None:
    """A solver of the one cannot run the other."""
    with pytest.raises(SpecError, match=r"'ddim' is not known|flow"):
        load_checkpoint_policy(save_policy(tmp_path, objective="flow_matching"), sampler="ddim")
    with pytest.raises(SpecError, match="spacing"):
        load_checkpoint_policy(tmp_path / "policy", spacing="trailing")
