"""Policies beside other engines: what is timed and told, and what they are given."""

import ctypes
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import beside
import in_motion
import numpy as np
import onnx
import pytest
import released_evo1
import released_groot
import tether_beside
import torch
import vla_cpp
from beside import Array
from click.testing import CliRunner
from large_evo1 import STEPS, TASK
from large_groot import BASE
from large_smolvla import CAMERAS, STATE
from onnx import TensorProto, helper
from safetensors.torch import save_file

from tests.families import cameras
from tests.once import Once
from tests.policies import evo1s, vla_jepas
from ttscompile import Noise, load
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError


class Late:
    """A rival that answers as the dense plan does, and says that it took a second."""

    parts = "all of it"

    def __init__(self, artifact: Path) -> None:
        self._policy = load(artifact, plan="dense")
        self.shown: list[Array] = []

    def predict(self, obs: Mapping[str, Array], noise: Noise) -> tuple[Array, list[float]]:
        self.shown.append(obs[cameras.CAMERAS[0]])
        return self._policy.predict_action(obs, noise=noise)["action_pred"][0], [1.0]


@pytest.mark.slow
@pytest.mark.parametrize("fp32", [True, False])
def test_everybody_sees_new_pictures_and_is_told_beside_the_first(
    once: Once, tmp_path: Path, capsys: pytest.CaptureFixture[str], fp32: bool
) -> None:
    (tmp_path / "compiled").symlink_to(cameras.compiled_tokens(once) / "artifact")
    rival = Late(tmp_path / "compiled")
    beside.race(tmp_path, {"late": rival}, threads=1, rounds=1, fp32=fp32)
    assert len({each.tobytes() for each in rival.shown}) == 1 + beside.UNCOUNTED
    first, *others = capsys.readouterr().out.splitlines()
    assert first.split()[:3] == ["1.00", "s", "1.00"] and first.endswith("late: all of it: 1.00")
    precisions = ["fp32", "int8"] if fp32 else ["int8"]
    told = [f"{name}, {bits}" for bits in precisions for name in ("dense", "2 of 3 steps")]
    timed = [line for line in others if " s " in line]
    assert [line.split("  ")[-1].split(":")[0] for line in timed] == [*told, "2 of 3 steps, int8, tokens reused"]
    off = {line.split("  ")[-1].split(":")[0]: float(line.split()[0]) for line in others[len(timed) :]}
    assert list(off) == (["late", "dense, int8"] if fp32 else [])
    if fp32:
        assert off["late"] < 1e-6 < off["dense, int8"]


@pytest.mark.slow
def test_of_a_camera_that_moves_all_is_computed_and_of_a_still_one_what_changed(
    once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "compiled").symlink_to(cameras.compiled_tokens(once) / "artifact")

    def views(sizes: list[tuple[int, int]]) -> Iterator[tuple[bool, list[Array]]]:
        for seen in (0.0, 0.4, 0.8):
            front, gripper = (np.full((3, *size), seen, np.float32) for size in sizes)
            front[:, 1:] = 0.5  # all but its first row of pixels stands still
            yield seen == 0, [front, gripper]

    monkeypatch.setattr(in_motion, "views", views)
    found = in_motion.measured(tmp_path, [0.01], calls=2, patterned=False)
    assert list(found) == [in_motion.WHOLE, "threshold 0.01", in_motion.OTHER]
    assert found[in_motion.WHOLE].shares == [[], []] and found[in_motion.WHOLE].off == [0, 0]
    assert all(0 < still <= 0.5 and moves == 1 for still, moves in found["threshold 0.01"].shares)
    assert max(found["threshold 0.01"].off) < min(found[in_motion.OTHER].off)
    patterned = in_motion.measured(tmp_path, [0.01], calls=2, patterned=True)
    assert all(moves == 1 for _, moves in patterned["threshold 0.01"].shares)


def test_medians_are_of_the_calls_that_count() -> None:
    uncounted = [[9.0, 9.0]] * beside.UNCOUNTED
    times = {"theirs": [*uncounted, [3.0, 1.0], [4.0, 2.0], [30.0, 3.0]], "ours": [*uncounted, [1.0, 0.5]]}
    assert [line.split("  ")[-1] for line in beside.told(times)] == ["theirs: 4.00, 2.00", "ours: 1.00, 0.50"]
    assert [line.split()[:3] for line in beside.told(times)] == [["6.00", "s", "1.00"], ["1.50", "s", "4.00"]]


def test_one_policy_is_in_the_folder(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="expected one folder of smolvla, pi0, pi05, groot, evo1, vla_jepa"):
        beside.policy_of(tmp_path)
    (tmp_path / "pi0").mkdir()
    assert beside.policy_of(tmp_path) == "pi0"


def test_the_state_is_within_what_vla_cpp_clips(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "compiled").symlink_to(cameras.compiled_tokens(once) / "artifact")
    drawn = {STATE: np.array([-3.0, 0.5, 2.0]), "tokens.mask": np.array([True, False])}
    monkeypatch.setattr(beside, "call", lambda _: (drawn, Noise(np.zeros(1, np.float32))))
    obs, _ = beside.observed(tmp_path)
    assert obs[STATE].tolist() == [-1.0, 0.5, 1.0] and obs["tokens.mask"].all()


def test_as_many_words_count_as_another_engine_reads(
    once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "compiled").symlink_to(cameras.compiled_tokens(once) / "artifact")
    drawn = {"tokens.mask": np.array([[True, False, True, True]])}
    monkeypatch.setattr(beside, "call", lambda _: (drawn, Noise(np.zeros(1, np.float32))))
    assert beside.observed(tmp_path, 2)[0]["tokens.mask"].tolist() == [[True, True, False, False]]


def exported(path: Path) -> Path:
    """As Tether writes a model, in small: noise, plus the number of cameras that are there, plus the first word."""
    shapes: dict[str, tuple[int, list[int]]] = {
        **{f"img_cam{i}": (TensorProto.FLOAT, [1, 3, 4, 4]) for i in (1, 2, 3)},
        **{f"mask_cam{i}": (TensorProto.BOOL, [1]) for i in (1, 2, 3)},
        "lang_tokens": (TensorProto.INT64, [1, 2]),
        "lang_masks": (TensorProto.BOOL, [1, 2]),
        "state": (TensorProto.FLOAT, [1, 8]),
        "noise": (TensorProto.FLOAT, [1, 5, 8]),
    }
    summed = [*(f"mask_cam{i}" for i in (1, 2, 3)), "lang_tokens", "lang_masks", *(f"img_cam{i}" for i in (1, 2, 3))]
    nodes = []
    for name in summed:
        nodes.append(helper.make_node("Cast", [name], [f"{name}.float"], to=TensorProto.FLOAT))
        nodes.append(helper.make_node("ReduceSum", [f"{name}.float"], [f"{name}.sum"], keepdims=0))
    nodes.append(helper.make_node("Sum", ["noise", "state.row", *(f"{name}.sum" for name in summed)], ["actions"]))
    nodes.insert(0, helper.make_node("Unsqueeze", ["state", "axes"], ["state.row"]))
    values = [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in shapes.items()]
    made = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 5, 8])
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    graph = helper.make_graph(nodes, "call", values, [made], [axes])
    path.parent.mkdir()
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9), path)
    return path


def test_tether_is_given_two_cameras_of_three_and_as_many_words_as_it_reads(tmp_path: Path) -> None:
    rival = tether_beside.Tether(exported(tmp_path / tether_beside.MODEL), threads=1)
    assert rival.words == 2
    pictures = {key: np.full((1, 1, 3, 4, 4), 0.25, np.float32) for key in CAMERAS}
    obs = {**pictures, STATE: np.full((1, 6), 2.0, np.float32), "language.tokens": np.array([[10, 20, 40]])}
    noise = np.arange(40, dtype=np.float32).reshape(1, 5, 8)
    actions, seconds = rival.predict(obs, Noise(noise))
    told = 2 + 30 + 2 + 2 * 48 * -0.5 - 48  # cameras, words, all of which count, and the pixels: the third is black
    state = np.array([2.0] * 6 + [0.0] * 2)
    assert np.allclose(actions, noise[0] + state + told) and len(seconds) == 1


def test_the_structures_have_the_sizes_of_the_interface() -> None:
    assert (ctypes.sizeof(vla_cpp.Image), ctypes.sizeof(vla_cpp.Inputs)) == (24, 80)


def test_words_of_smolvla_are_those_that_were_observed() -> None:
    obs = {"observation.language.tokens": np.array([[3, 1, 2]]), "state": np.ones((1, 2), np.float32)}
    prompt = vla_cpp.prompt_of(Path(), "smolvla", obs)
    assert prompt.tokens.tolist() == [3, 1, 2] and prompt.tokens.dtype == np.int32


def test_weights_of_a_release_are_the_same_bytes_under_its_names(tmp_path: Path) -> None:
    names = ("_groot_model.backbone.model.lm_head.weight", "_groot_model.action_head.vlln.weight")
    header = json.dumps({name: {"data_offsets": [i, i + 1]} for i, name in enumerate(names)}).encode()
    for folder in ("groot", BASE):
        (tmp_path / folder).mkdir()
    saved = len(header).to_bytes(8, "little") + header + b"ab"
    (tmp_path / "groot" / "model.safetensors").write_bytes(saved)
    assert CliRunner().invoke(released_groot.main, [str(tmp_path)]).exit_code == 0
    made = (tmp_path / BASE / "model.safetensors").read_bytes()
    assert len(made) == len(saved) and made[:8] == saved[:8] and made.endswith(b"ab")
    found = json.loads(made[8:-2])
    assert list(found) == ["backbone.model.model.language_model.embed_tokens.weight", "action_head.vlln.weight"]
    assert [each["data_offsets"][0] for each in found.values()] == [0, 1]
    index = json.loads((tmp_path / BASE / "model.safetensors.index.json").read_text())
    assert set(index["weight_map"]) == set(found)


_SEEN = f"<|vision_start|>{'<|image_pad|>' * 8}<|vision_end|>"
_FRAMES = "".join(f"<|action_{i}|>" * 2 for i in range(3))
_JEPA = (
    f"<|im_start|>user\n{_SEEN * 2}Your task is {TASK}. Infer the temporal dynamics from frames {_FRAMES} and produce"
    f" the corresponding policy actions {'<|embodied_action|>' * 3}"
)
_EVO1 = "".join(f"Image-{i}: <img>{'<IMG_CONTEXT>' * 4}</img>\n" for i in (1, 2)) + TASK


@pytest.mark.parametrize(
    ("name", "written", "kind", "model", "text"),
    [("evo1", evo1s, "pooled", evo1s.LANGUAGE, _EVO1), ("vla_jepa", vla_jepas, "libero", vla_jepas.BACKBONE, _JEPA)],
)
def test_a_prompt_says_where_pictures_stand(
    tmp_path: Path, name: str, written: Any, kind: str, model: str, text: str
) -> None:
    (tmp_path / name).symlink_to(written.save(kind, tmp_path))
    tokenizer = Tokenizer(tmp_path / model, CheckpointError)
    tokenizer.with_words([*(f"<|action_{i}|>" for i in range(20)), "<|embodied_action|>"])
    own = json.loads((tmp_path / model / "config.json").read_text())["image_token_id"]
    tokens = [vla_cpp.IMAGE_TOKENS[name] if each == own else each for each in tokenizer(text)]
    prompt = vla_cpp.prompt_of(tmp_path, name, {})
    assert prompt.tokens.tolist() == tokens and prompt.tokens.dtype == np.int32


def test_weights_of_evo1_have_the_names_of_its_authors(tmp_path: Path) -> None:
    start, head = "model.embedder.vision_tower.encoder.layers.0", "model.action_head"
    rows = torch.arange(1000.0)[None, :, None]
    weights = {f"{start}.self_attn.{one}_proj.bias": torch.full((2,), i) for i, one in enumerate("kqv")}
    weights |= {f"{start}.lambda_1": torch.ones(2), f"{head}.times": rows}
    weights |= {f"{head}.mlp_head.fc2.bias": torch.ones(72), f"{head}.action_encoder.first.bias": torch.zeros(2)}
    weights["model.embedder.language_model.layers.0.self_attn.q_proj.bias"] = torch.ones(2)
    (tmp_path / "evo1").mkdir()
    save_file(weights, tmp_path / "evo1" / "model.safetensors")
    assert CliRunner().invoke(released_evo1.main, [str(tmp_path)]).exit_code == 0
    made = torch.load(tmp_path / released_evo1.BASE / "mp_rank_00_model_states.pt")["module"]
    assert sorted(made) == [
        "action_head.action_encoder.W1.linear.bias",
        "action_head.mlp_head.fc2.linear.bias",
        "action_head.time_pos_enc.pe",
        "embedder.model.language_model.model.layers.0.self_attn.q_proj.bias",
        "embedder.model.vision_model.encoder.layers.0.attn.qkv.bias",
        "embedder.model.vision_model.encoder.layers.0.ls1",
    ]
    assert made["embedder.model.vision_model.encoder.layers.0.attn.qkv.bias"].tolist() == [1, 1, 0, 0, 2, 2]
    read = made["action_head.time_pos_enc.pe"][0, [int(step / STEPS * 1000) for step in range(STEPS)], 0]
    assert read.tolist() == [int(step / STEPS * 999) for step in range(STEPS)]
    entries = json.loads((tmp_path / released_evo1.BASE / "config.json").read_text())
    assert (entries["horizon"], entries["action_dim"], entries["per_action_dim"]) == (3, 72, 24)
