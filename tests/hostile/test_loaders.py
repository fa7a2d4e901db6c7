"""What the fuzzer found, one test each, and attacks that chance would not find."""

import io
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

import ttscompile
from tests.hostile.forged import forge
from tests.policies.conftest import _config, _weights
from ttscompile.artifact import load_artifact
from ttscompile.calibration.state import StateFile
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ArtifactError, CalibrationError, CheckpointError, TrajectoryError, TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.checkpoint import plain_config
from ttscompile.policies.diffusion_policy.interpolation import Config
from ttscompile.trajectories import frames as trajectories_frames, load_trajectories


def external(path: Path, name: str, **entries: str) -> None:
    """Say where the weights of a model lie."""
    model = onnx.load(path / name, load_external_data=False)
    tensor = next(t for t in model.graph.initializer if t.data_location == onnx.TensorProto.EXTERNAL)
    del tensor.external_data[:]
    for key, value in entries.items():
        tensor.external_data.add(key=key, value=value)
    (path / name).write_bytes(model.SerializeToString())


INSIDE = {"location": "weights.safetensors", "offset": "0", "length": "1024"}


@pytest.mark.parametrize(
    "place",
    [
        {"location": "../weights.safetensors"},
        {"location": "/etc/passwd"},
        {"location": "/dev/zero"},
        {"location": "manifest.json"},
        {"location": "*/_ORT_MEM_ADDR_/*"},
        {"offset": "-8"},
        {"offset": str(2**63 - 8)},
        {"length": str(2**40)},
        {"length": ""},
        {"offset": "\u0663"},
        {"basepath": ".."},
    ],
)
def test_weights_that_lie_elsewhere(written: Path, place: dict[str, str]) -> None:
    shutil.copy(written / "weights.safetensors", written.parent)
    external(written, "block_00.onnx", **{**INSIDE, **place})
    forge(written)
    with pytest.raises(ArtifactError, match=r"block_00\.onnx: expected weights in the model itself or in a range"):
        load_artifact(written)


def test_a_model_by_another_name_is_looked_at_too(written: Path) -> None:
    external(written, "block_00.onnx", **{**INSIDE, "location": "../weights.safetensors"})
    (written / "block_00.onnx").rename(written / "block_00.bin")

    def rename(document: dict[str, Any]) -> None:
        document["pieces"]["block_00"]["file"] = "block_00.bin"
        document["files"]["block_00.bin"] = document["files"].pop("block_00.onnx")

    forge(written, rename)
    with pytest.raises(ArtifactError, match=r"block_00\.bin: expected a file NAME\.onnx"):
        load_artifact(written)


def test_weights_inside_are_accepted(written: Path) -> None:
    """The control."""
    external(written, "block_00.onnx", **INSIDE)
    forge(written)
    load_artifact(written)


def test_weights_of_a_subgraph_are_found(written: Path) -> None:
    """In a branch of an If, in an attribute of a node."""
    tensor = onnx.TensorProto(name="w", data_type=1, dims=[1], data_location=onnx.TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="../x")
    branch = onnx.helper.make_graph([onnx.helper.make_node("Constant", [], ["y"], value=tensor)], "g", [], [])
    node = onnx.helper.make_node("If", ["c"], ["y"], then_branch=branch, else_branch=branch)
    model = onnx.load(written / "stem.onnx", load_external_data=False)
    model.graph.node.append(node)
    (written / "stem.onnx").write_bytes(model.SerializeToString())
    forge(written)
    with pytest.raises(ArtifactError, match="expected weights in the model itself"):
        load_artifact(written)


@pytest.mark.parametrize("content", [b"\xff" * 40, b"\x3a\xff\xff\xff\xff\x0f", b"\x3b\x3c", b"\x3a\x02" * 3])
def test_a_model_that_is_none(written: Path, content: bytes) -> None:
    (written / "stem.onnx").write_bytes(content)
    forge(written)
    with pytest.raises(ArtifactError, match=r"stem\.onnx: expected an ONNX model"):
        load_artifact(written)


def test_a_graph_that_does_not_do_what_the_manifest_says(written: Path) -> None:
    shutil.copy(written / "block_00.onnx", written / "stem.onnx")
    forge(written)
    with pytest.raises(TtscompileError):
        ttscompile.load(written)


@pytest.mark.parametrize(("key", "value"), [("sample", [2**20, 2**20]), ("left_out", 10**12)])
def test_a_policy_out_of_proportion_to_its_files(written: Path, key: str, value: object) -> None:
    def huge(document: dict[str, Any]) -> None:
        document["spec"][key] = value

    forge(written, huge)
    with pytest.raises(ArtifactError, match="its manifest declares"):
        load_artifact(written)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compression_than_deflate(written: Path, method: int) -> None:
    path = written.parent / "a.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for each in written.iterdir():
            archive.write(each, each.name)
    with pytest.raises(ArtifactError, match="compressed by another method"):
        load_artifact(path)


def test_an_entry_without_a_name(written: Path) -> None:
    path = written.parent / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("\x00x"), b"")
    with pytest.raises(ArtifactError, match="not a file"):
        load_artifact(path)


def save(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], object]) -> Path:
    config = _config(True)
    weights = _weights(config["policy"]["model"], 0)
    change(config["policy"], weights)
    torch.save({"cfg": config, "state_dicts": {"ema_model": weights}}, path)
    return path


@pytest.mark.parametrize("name", ["n_emb", "n_layer", "n_cond_layers", "input_dim", "horizon", "n_obs_steps"])
def test_a_configuration_larger_than_its_weights(tmp_path: Path, name: str) -> None:
    path = save(tmp_path / "a.ckpt", lambda policy, weights: policy["model"].update({name: 10**9}))
    with pytest.raises(CheckpointError, match="weights; the checkpoint holds"):
        load_checkpoint_policy(path)


@pytest.mark.parametrize("steps", [10**9, 2**63, 0, "many"])
def test_timesteps_without_end(tmp_path: Path, steps: Any) -> None:
    path = save(tmp_path / "a.ckpt", lambda policy, _: policy["noise_scheduler"].update(num_train_timesteps=steps))
    with pytest.raises(CheckpointError, match="num_train_timesteps is"):
        load_checkpoint_policy(path)


@pytest.mark.parametrize(
    "tensor", [torch.zeros(1).expand(2**31), torch.zeros(4, device="meta"), torch.zeros(4).to_sparse()]
)
@pytest.mark.filterwarnings("ignore:Validating sparse tensor invariants")  # torch 2.14, where one is unpickled
def test_a_tensor_without_data_of_its_own(tmp_path: Path, tensor: torch.Tensor) -> None:
    path = save(tmp_path / "a.ckpt", lambda _, weights: weights.update({"model.extra": tensor}))
    with pytest.raises(CheckpointError, match="data of their own"):
        load_checkpoint_policy(path)


def test_a_compressed_checkpoint(tmp_path: Path) -> None:
    path = save(tmp_path / "a.ckpt", lambda policy, weights: None)
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    with pytest.raises(CheckpointError, match="compressed ones"):
        load_checkpoint_policy(path)


def test_a_configuration_whose_parts_are_shared() -> None:
    value: Any = []
    for _ in range(60):
        value = [value, value]
    with pytest.raises(CheckpointError, match="more than 100000 values"):
        plain_config(value)


def test_references_that_multiply() -> None:
    tree: dict[str, Any] = {f"a{i}": [f"${{a{i + 1}}}"] * 10 for i in range(12)} | {"a12": 1}
    with pytest.raises(CheckpointError, match="more than 100000 values"):
        Config(tree).get("a0")
    text = {f"a{i}": f"${{a{i + 1}}}" * 10 for i in range(2)} | {"a2": "x" * 2000}
    with pytest.raises(CheckpointError, match="longer than 100000 characters"):
        Config(text).get("a0")


def recording(path: Path, header: str, data: bytes = bytes(64)) -> Path:
    ends = io.BytesIO()
    np.save(ends, np.array([1]))
    encoded = header.encode() + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("obs.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(encoded)) + encoded + data)
        archive.writestr("episode_ends.npy", ends.getvalue())
    return path


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (9223372036854775808,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776,), }",
        "{'descr': '<f4', 'fortran_order': True, 'shape': (True, 1.5), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': __import__('os').system('id'), 'fortran_order': False, 'shape': (1,), }",
        "(" * 200,
        "",
    ],
)
def test_headers_of_arrays(tmp_path: Path, header: str) -> None:
    path = recording(tmp_path / "a.npz", header)
    with pytest.raises(TrajectoryError, match=r"a\.npz"):
        load_trajectories([path], {"obs": ObservationSpec((2,))}, 1)


def test_a_recording_that_is_a_bomb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectories_frames, "FREE_BYTES", 2**20)
    path = recording(tmp_path / "a.npz", "{'descr': '|u1', 'fortran_order': False, 'shape': (1,), }", bytes(2**24))
    assert path.stat().st_size < 2**16
    with pytest.raises(TrajectoryError, match="in proportion to a file"):
        load_trajectories([path], {"obs": ObservationSpec((2,))}, 1)


def test_a_state_with_a_flipped_bit(tmp_path: Path) -> None:
    state = StateFile(tmp_path, {"seed": 0})
    state.arrays, state.progress = {"targets/x": np.arange(50.0)}, {"intervals": 1, "seconds": 2.0}
    state.save()
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    again = StateFile(tmp_path, {"seed": 0})
    assert again.load()
    assert again.progress == state.progress
    for position in range(0, len(content), 7):
        path.write_bytes(content[:position] + bytes([content[position] ^ 4]) + content[position + 1 :])
        with pytest.raises(CalibrationError, match="Calibrate again without --resume"):
            StateFile(tmp_path, {"seed": 0}).load()


@pytest.mark.parametrize("progress", [{"intervals": -1}, {"seconds": "1"}, {"seconds": float("nan")}, {"latency": 3}])
def test_a_state_with_numbers_that_are_none(tmp_path: Path, progress: dict[str, Any]) -> None:
    state = StateFile(tmp_path, {"seed": 0})
    state.progress = progress
    state.save()
    with pytest.raises(CalibrationError, match="json/progress"):
        StateFile(tmp_path, {"seed": 0}).load()


def test_a_state_that_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="does not fit this calibration"), StateFile(tmp_path, {}).reading():
        raise KeyError("logits")
