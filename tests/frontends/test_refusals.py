"""What is no policy that this compiler reads, in miniature: each is named, with how it was told and what to do."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import save_file

from ttscompile.cli import main
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.refusals import (
    DIRECTORIES,
    ENTRIES,
    LEROBOT,
    POLICIES,
    STATES,
    refuse_directory,
    refuse_payload,
    refuse_policy,
)

W = torch.zeros(2)
OWN_MODULE = r"compile_denoiser\(module, spec\)"

PAYLOADS: list[tuple[dict[str, Any], str, str]] = [
    ({"model": {"llm_backbone": {"a": W}, "x_embedder": {"mlp.fc1.weight": W}}}, "HybridVLA", "file of its folder ch"),
    ({"parameter": {"blocks.0.weight": W}}, "Dita", r"\.hydra/config\.yaml that its training wrote"),
    (
        {"model": {"nets": {"policy.noise_pred_net.down_modules.0.0.a": W}}, "config": "{}", "algo_name": "bc"},
        "a checkpoint of robomimic",
        rf"\(told by its entry algo_name\)\. If that is diffusion_policy: .*{OWN_MODULE}",
    ),
    ({"model.blocks.0.ffn.fc1.weight": W, "lang_adaptor.0.weight": W}, "weights of RDT", "config.json, and model"),
    ({"state_adaptor.0.bias": W, "act_adaptor.0.bias": W}, "an RDT2 or H-RDT", "is the module, and what the vision"),
    ({"encoder.state_adaptor.0.bias": W, "encoder.action_adaptor.0.bias": W}, "an RDT2 or H-RDT", OWN_MODULE),
    (
        {"model": {"action_model": {"net.blocks.0.attn.qkv.weight": W}, "projector": {"a": W}}},
        "CogACT",
        "ends with .pt",
    ),
    (
        {"qwen_vl_interface.model.a": W, "action_model.model.proj_out_1.weight": W, "vj_predictor.a": W},
        "a VLA-JEPA or another of starVLA",
        rf"No tool makes LeRobot's vla_jepa of it: .*{OWN_MODULE}",
    ),
    (
        {"backbone.tok_emb.weight": W, "gmm_mean_net.layers.0.weight": W, "gating_network.network.layers.0.weight": W},
        "a policy of VDD",
        "a DirectDenoiser of the mean of the expert with the highest gate",
    ),
    (
        {"itr": 9, "model": {"actor_ft.mlp_mean.layers.0.l1.weight": W, "actor.a": W}},
        "a policy of DPPO",
        r"with the \.hydra/config\.yaml",
    ),
    ({"epoch": 9, "model": {"network.time_mlp.1.weight": W}, "ema": {}}, "a policy of DPPO", "its training wrote"),
    ({"model": {"nn_model.fc1.0.model.0.weight": W}}, "of Diffusion BC without its schedule", "Model_Cond_Di"),
    (
        {"nets": {"nets": {"policy.noise_pred_net.blocks.0.attn.qkv.weight": W}}},
        "a first stage of DexVLA's ScaleDP",
        "second or third",
    ),
    ({"model": {"noise_net.dec_pos": W, "noise_net.time_net.w": W}, "optim": {}}, "DiT-Policy", r"agent_config\.yaml"),
    (
        {"state_dict": {"model.inner_model.blocks.0.mlp.router.weight": W}, "pytorch-lightning_version": "2"},
        "a mixture of experts",
        r"howto/own-denoiser\.md\. The module has to compute all experts and weigh them",
    ),
    (
        {"state_dict": {"model.inner_model.tok_emb.weight": W}, "hyper_parameters": {"kind": dict, "lr": 1e-4}},
        r"a policy of k-diffusion \(BESO or MDT, say\)",
        "an EDMDenoiser of its inner_model",
    ),
    ({"joint_blocks.0.context_block.attn.qkv.weight": W}, r"two streams \(MM-DiT\)", "becomes one block"),
    ({"transformer_blocks.0.attn.add_q_proj.weight": W}, r"two streams \(MM-DiT\)", "becomes one block"),
    ({"model": {"down_modules.0.0.blocks.0.block.0.weight": W}}, "weights of a U-Net", "do not say how they"),
    ({"base.layers.0.q_proj.lora_A.weight": W}, "an adapter .LoRA.", "merge_and_unload"),
    ({"blocks.0.weight": W, "head.bias": W}, "a plain dictionary of weights", "do not say how they are connected"),
    ({}, "a plain dictionary of weights", r"its entries \(none\)"),
]


def test_a_vla_jepa_is_told_from_a_cogact(tmp_path: Path) -> None:
    """Both have an ``action_model``, and both are files of a folder ``checkpoints``."""
    path = tmp_path / "VLA-JEPA-LIBERO.pt"
    torch.save({"qwen_vl_interface.model.a": W, "action_model.model.proj_out_1.weight": W}, path)
    with pytest.raises(CheckpointError, match="this is a VLA-JEPA or another of starVLA") as caught:
        load_checkpoint_policy(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(("payload", "what", "remedy"), PAYLOADS)
def test_torch_files(tmp_path: Path, payload: dict[str, Any], what: str, remedy: str) -> None:
    """Told by an entry or by the name of a weight, which the message quotes."""
    torch.save(payload, tmp_path / "model.pth")
    with pytest.raises(CheckpointError, match=rf"{what}.*{remedy}") as caught:
        load_checkpoint_policy(tmp_path / "model.pth")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'model.pth'}: no entry 'cfg'")
    assert "(told by " in message
    assert "\n" not in message


NAMES = [
    ("DiffusionUnetVideoPolicy", "a diffusion policy with another observation encoder.*inside the module"),
    ("OneDPUnetLowdimPolicy", f"a policy of OneDP, distilled to one evaluation.*{OWN_MODULE}.*no torch on the robot"),
    ("MyOneDPImagePolicy", "a policy of OneDP"),
    ("BETLowdimPolicy", "a policy without diffusion.*no denoising loop"),
    ("RobomimicImagePolicy", "a policy without diffusion"),
    ("MyDiffusionUnetImagePolicy", r".*one of these renamed\. .* the name of that class at the end of cfg\.policy\._t"),
    ("RobotPolicy", r".*kind\. If its class adds nothing .* cfg\.policy\._target_\. Otherwise: Build"),
    ("MyPolicy", f"a policy of its own kind.*{OWN_MODULE}"),
]


@pytest.mark.parametrize(("name", "message"), NAMES)
def test_other_policies(payload: Callable[..., Any], save: Callable[..., Path], name: str, message: str) -> None:
    """Told by the class in the configuration."""
    built = payload()
    built["cfg"]["policy"]["_target_"] = f"some.package.{name}"
    with pytest.raises(CheckpointError, match=rf"the policy is {name}: {message}"):
        load_checkpoint_policy(save(built))


LEROBOT_TYPES = ["vqbet", "pi0_fast", "tdmpc", "sac"]
LEROBOT_TYPES += ["molmoact2", "fastwam", "something_new"]

DIRECTORY_FILES: list[tuple[list[str], str]] = [
    (["adapter_config.json", "adapter_model.safetensors"], "PEFT adapter.*adapter_config.json.*Merge"),
    (["step_10/pretrained_model/config.json"], "around what lerobot saved.*Give the folder pretrained_model in it"),
    (["checkpoints/000200/pretrained_model/config.json"], "told by checkpoints/000200/pretrained_model.*in it"),
    (["meta/info.json", "data/chunk-000/file-000.parquet"], "a data set of LeRobot, not a policy.*with --trajectories"),
    (["default/_METADATA", "default/manifest.ocdbt"], "a JAX checkpoint.*Convert it to PyTorch"),
    (["_METADATA", "manifest.ocdbt"], "a JAX checkpoint.*of openpi, give the folder with params in it"),
    (["model.msgpack"], "a JAX checkpoint"),
    (["manifest.json", "weights.safetensors"], "compiled already.*ttscompile.load"),
    (["checkpoints/latest.ckpt", ".hydra/config.yaml"], "a directory of checkpoints.*latest.ckpt"),
    (["config.json", "model.safetensors"], r"a directory of weights .told by model\.safetensors"),
    (["config.json", "checkpoints/step-1.pt"], r"a directory of checkpoints .told by checkpoints/step-1\.pt"),
    (["config.json=model_type=gr00t_n1_5", "model.safetensors"], r"a GR00T model .told by config\.json: model_type"),
    (["config.json=act_adaptor=mlp3x_silu", "pytorch_model.bin"], rf"an RDT2 or H-RDT .*{OWN_MODULE}"),
    (["config.json=policy_head_type=unet_diffusion_policy", "model.safetensors"], "DexVLA.*whose head is a U-Net"),
    (
        ["config.json=model_type=xvla", "model.safetensors"],
        "an X-VLA .*beside the JSON files .* a LeRobot policy xvla,",
    ),
    (["30000/model.safetensors", "30000/metadata.pt"], r"around checkpoints of openpi .*30000/metadata\.pt.*one of"),
    (["9/params/_METADATA", "9/_CHECKPOINT_METADATA"], r"around checkpoints of openpi .told by 9/params/_METADATA"),
    (["config.json=model_type=eo1", "model.safetensors"], "an EO-1 .*No tool makes LeRobot's eo1"),
    (["config.json=dof_config=7", "model.safetensors"], "a Wall-X .*No tool makes LeRobot's wall_x"),
    (["checkpoint-1000/config.json", "checkpoint-1000/model.safetensors"], "around checkpoints .*Give one of those in"),
    (["step_final/config.json", "step_final/checkpoint.pt"], "around checkpoints .*Give one of those in it"),
    (["pytorch_model.bin"], "a directory of weights"),
    (["README.md"], r"found README\.md; expected the config\.json and model\.safetensors"),
    ([], "found nothing"),
]


def make(folder: Path, files: list[str]) -> None:
    """Files that hold an empty object, or one entry, ``name=key=value``."""
    for each in files:
        name, _, entry = each.partition("=")
        key, _, value = entry.partition("=")
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps({key: value} if key else {}))


@pytest.mark.parametrize(("files", "message"), DIRECTORY_FILES)
def test_directories(tmp_path: Path, files: list[str], message: str) -> None:
    """Told by the files in them."""
    make(tmp_path, files)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint_policy(tmp_path)
    assert str(caught.value).startswith(str(tmp_path))


def test_files_that_torch_did_not_write(tmp_path: Path) -> None:
    """Told by their first bytes or what is in the archive; a damaged archive is still called damaged."""
    path = tmp_path / "policy.ckpt"
    save_file({"a": W}, path)
    with pytest.raises(CheckpointError, match="a safetensors file.*do not say how they are connected"):
        load_checkpoint_policy(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(CheckpointError, match="an HDF5 file"):
        load_checkpoint_policy(path)
    path.write_bytes(b"GGUF" + bytes(100))
    with pytest.raises(CheckpointError, match="a GGUF file"):
        load_checkpoint_policy(path)
    for name, message in (
        ("readme.txt", "torch.save did not write .*readme.txt"),
        ("manifest.json", "compiled already"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name, "hello")
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint_policy(path)
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"PK\x01\x02") + 6] = 128  # the version of zip that it needs: 12.8
    path.write_bytes(damaged)
    with pytest.raises(CheckpointError, match=r"zip file version 12\.8"):
        load_checkpoint_policy(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("model.onnx", "an ONNX model .*checkpoint that it was exported from"),
        ("octo.msgpack", "a checkpoint of Flax .*Convert it to PyTorch"),
        ("calls.npz", "no checkpoint .*the training saved"),
        ("model.onnx.ckpt", "or a truncated one"),  # a name that only looks like one
    ],
)
def test_files_of_another_kind_are_not_called_truncated(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / name).write_bytes(b"hello" * 20)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint_policy(tmp_path / name)
    assert ("truncated" in str(caught.value)) == (name == "model.onnx.ckpt")


def test_every_row_is_reached(tmp_path: Path) -> None:
    """By one of the cases above: a row behind another that matches more would never be."""
    told = [said(refuse_payload, payload) for payload, *_ in PAYLOADS] + [
        said(refuse_policy, name) for name, _ in NAMES
    ]
    for i, (files, _) in enumerate(DIRECTORY_FILES):
        (tmp_path / str(i)).mkdir()
        make(tmp_path / str(i), files)
        told.append(said(refuse_directory, tmp_path / str(i)))
    told += [said(lambda name: refuse_policy(name, LEROBOT), name) for name in LEROBOT_TYPES]
    for row in (*POLICIES, *DIRECTORIES, *ENTRIES, *STATES, *LEROBOT):
        assert any(f"{row.what}. {row.remedy}" in each or f"{row.what} (told by " in each for each in told), row.what
        assert row.remedy.endswith(".")


def said(refusal: Callable[[Any], Any], argument: Any) -> str:
    """The message."""
    with pytest.raises(CheckpointError) as caught:
        refusal(argument)
    return str(caught.value)


def test_command_exits_with_2_and_one_line(tmp_path: Path) -> None:
    """As every error about input does."""
    save_file({"a": W}, tmp_path / "model.safetensors")
    result = CliRunner().invoke(main, ["convert", str(tmp_path / "model.safetensors"), "-o", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "a safetensors file" in result.stderr
    assert not (tmp_path / "out").exists()
