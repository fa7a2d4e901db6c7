"""openpi's JAX checkpoints, as its trainer saves them, give the actions that its JAX policy gives."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorstore
import torch

import ttscompile
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies import openpi_params, orbax_files

from . import openpis, originals
from .lerobot_tiny import change_json, write_json
from .refused import assert_not_read

pytestmark = pytest.mark.filterwarnings("ignore:.*what openpi saves is compiled")
KINDS = ("pi0", "pi05")
"""The first has adapters (LoRA) and arrays of bfloat16; the names of the other's end with ``value``."""
ARRAY = "params.action_in_proj.bias"


def unpack(kind: str, folder: Path) -> Path:
    """A checkpoint, with what its training's configuration says beside it. Returns its folder."""
    for name, content in originals.golden("openpi_jax").items():
        if name.startswith(f"file:{kind}/"):
            path = folder / name.removeprefix("file:")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.tobytes())
    openpis.save_statistics(folder / kind)
    told = {"action_horizon": openpis.HORIZON, "max_token_len": openpis.LENGTH}
    write_json(folder / kind / "config.json", told | ({"discrete_state_input": True} if kind == "pi05" else {}))
    return folder / kind


def store(checkpoint: Path) -> Any:
    """Its keys and values, to be changed."""
    base = {"driver": "file", "path": f"{checkpoint / 'params'}/"}
    return tensorstore.KvStore.open({"driver": "ocdbt", "base": base}).result()


@pytest.mark.parametrize("call", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_the_rebuilt_network_gives_the_actions_of_openpis_jax(tmp_path: Path, kind: str, call: int) -> None:
    golden, words = originals.golden("openpi_jax"), openpis.save_tokenizer(tmp_path)
    found = openpis.eager(unpack(kind, tmp_path), words, call)
    openpis.assert_same(found, golden[f"{kind}.{call}"])
    assert np.abs(found - golden[f"{kind}.{1 - call}"][..., : openpis.ACTION_DIM]).max() > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_that_the_robot_lacks_is_masked(tmp_path: Path, kind: str) -> None:
    golden, words = originals.golden("openpi_jax"), openpis.save_tokenizer(tmp_path)
    found = openpis.eager(unpack(kind, tmp_path), words, 0, LoadOptions(without_cameras=[openpis.ABSENT]))
    openpis.assert_same(found, golden[f"{kind}.missing"])
    assert np.abs(found - golden[f"{kind}.0"][..., : openpis.ACTION_DIM]).max() > 1e-3


@pytest.mark.slow
def test_what_is_merged_is_said_and_matters(tmp_path: Path) -> None:
    checkpoint, words = unpack("pi0", tmp_path), openpis.save_tokenizer(tmp_path)
    with pytest.warns(UserWarning, match=r"Adapters .LoRA. are merged with the scale 1, alpha = rank"):
        load_checkpoint_policy(checkpoint)
    before, keys = openpis.eager(checkpoint, words, 0), store(checkpoint)
    for key in keys.list().result():
        if b"lora_b" in key:
            keys.delete_range(tensorstore.KvStore.KeyRange(key, key + b"\0")).result()
    assert np.abs(openpis.eager(checkpoint, words, 0) - before).max() > 0.01


@pytest.mark.slow
def test_what_is_compiled_gives_them_too(tmp_path: Path) -> None:
    words = openpis.save_tokenizer(tmp_path)
    ttscompile.convert(unpack("pi0", tmp_path), tmp_path / "compiled", encoders=words)
    policy = ttscompile.load(tmp_path / "compiled")
    seen = {**openpis.observed(1), "task": openpis.TASKS[1]}
    found = policy.predict_action_chunk(seen, noise=Noise(openpis.noise()), plan="dense")
    openpis.assert_same(found, originals.golden("openpi_jax")["pi0.1"])


def test_what_the_reader_needs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = unpack("pi05", tmp_path)
    monkeypatch.setattr(orbax_files, "find_spec", lambda name: None)
    assert_not_read(
        checkpoint, r"needs the package tensorstore, which is not installed. Install 'ttscompile\[openpi\]'"
    )
    monkeypatch.undo()
    change_json(checkpoint / "config.json", action_horizon=None)
    assert_not_read(
        checkpoint, "config.json: action_horizon is None; expected a positive whole number", names=checkpoint
    )


def header(keys: Any, **changes: Any) -> None:
    """Change what is said of an array."""
    key = f"{ARRAY}.value/.zarray"
    keys.write(key, json.dumps({**json.loads(keys.read(key).result().value), **changes})).result()


def copy(keys: Any, name: str) -> None:
    """One array more, of another name."""
    for part in (".zarray", "0"):
        keys.write(f"{name}/{part}", keys.read(f"{ARRAY}.value/{part}").result().value).result()


def without(keys: Any, start: str, end: str) -> None:
    """Without the arrays between two names."""
    keys.delete_range(tensorstore.KvStore.KeyRange(start, end)).result()


EXPERT = "params.PaliGemma.llm.final_norm_1"
DAMAGED = "no arrays of orbax, or damaged ones"
CHANGES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "an array less": (
        lambda keys: without(keys, EXPERT, "params.PaliGemma.llm.g"),
        "missing .*gemma_expert.model.norm",
    ),
    "an array more": (lambda keys: copy(keys, "params.router.value"), "router are no arrays of openpi's pi0 or pi0.5"),
    "another shape": (lambda keys: header(keys, shape=[2**50]), "Compiling them takes about"),
    "a shape without numbers": (
        lambda keys: header(keys, shape=[16, 16], chunks=[16, 16]),
        "action_in_proj.bias has sh",
    ),
    "chunks larger than the array": (lambda keys: header(keys, chunks=[2**40]), "in chunks of the array"),
    "whole numbers": (lambda keys: header(keys, dtype="<i4"), "is int32 .*expected numbers with a point"),
    "no header": (lambda keys: keys.write(f"{ARRAY}.value/.zarray", "hello").result(), DAMAGED),
    "no numbers": (lambda keys: keys.write(f"{ARRAY}.value/0", "hello").result(), DAMAGED),
    "nothing": (lambda keys: without(keys, "", "z"), "found 0 arrays"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_changed_checkpoint_is_refused(tmp_path: Path, what: str) -> None:
    checkpoint = unpack("pi05", tmp_path)
    change, message = CHANGES[what]
    change(store(checkpoint))
    assert_not_read(checkpoint, message, names=checkpoint)


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    checkpoint = unpack("pi05", tmp_path)
    manifest = checkpoint / "params" / "manifest.ocdbt"
    content = manifest.read_bytes()
    manifest.write_bytes(content[:40])
    assert_not_read(checkpoint, "no arrays of orbax, or damaged ones", names=checkpoint)
    manifest.unlink()
    assert_not_read(checkpoint, "manifest.ocdbt: no such file. Copy the checkpoint whole", names=checkpoint)
    manifest.write_bytes(content)
    for path in (checkpoint / "params").rglob("*"):
        if path.parent.name == "d" and path.stat().st_size > 10_000:
            path.write_bytes(path.read_bytes()[:-5000])
    assert_not_read(checkpoint, "no arrays of orbax, or damaged ones", names=checkpoint)


def test_a_reader_that_ends_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its limits, say, or by what a damaged file makes of a library in C++."""
    checkpoint = unpack("pi05", tmp_path)
    monkeypatch.setattr(orbax_files, "_CODE", "import os; os.abort()")
    assert_not_read(checkpoint, "the process that read it ended with SIGABRT: it is damaged", names=checkpoint)


def test_arrays_of_unknown_names_and_shapes_are_no_weights() -> None:
    assert openpi_params._weights("PaliGemma.llm.layers.attn.qkv_einsum.w", torch.zeros(2, 3)) == {}
    made = openpi_params._weights("PaliGemma.llm.layers.mlp_1.linear", torch.arange(12.0).reshape(2, 3, 2))
    assert list(made) == [f"paligemma_with_expert.gemma_expert.model.layers.{i}.mlp.down_proj.weight" for i in (0, 1)]
    assert made[list(made)[1]].tolist() == [[6, 8, 10], [7, 9, 11]]
