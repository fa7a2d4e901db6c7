"""Diffusion Policy's transformer on images, against numbers that the original gave; see ``golden/make_hybrid.py``."""

import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.rounding import Counted, allowed, assert_equal_but_for_rounding
from ttscompile.core.spec import Noise
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import AS_SAVED
from ttscompile.ir.flops import frames_flops, graph_flops
from ttscompile.ir.program import Program
from ttscompile.policies.diffusion_policy import family as diffusion_policy
from ttscompile.policies.diffusion_policy.hybrid import SpatialSoftmax

from ..families.support import record
from . import hybrid
from .originals import as_seen, assert_actions, assert_compiled_acts, golden
from .refused import Refusals, refusals

Payload = dict[str, Any]
WRIST = "obs_encoder.obs_nets.wrist."


@pytest.fixture(scope="module")
def two_cameras() -> Payload:
    """Not to be changed: copy the parts that a test changes."""
    return hybrid.payload("two_cameras")


@pytest.fixture
def build(two_cameras: Payload) -> Callable[..., tuple[Any, Any]]:
    """Build the policy of two cameras with changes to its weights and ``cfg.policy``, without a file."""

    def run(weights: dict[str, Any] | None = None, without: str = "", **policy: Any) -> tuple[Any, Any]:
        config = copy.deepcopy(two_cameras["cfg"])
        config["policy"].update(policy)
        kept = {k: v for k, v in two_cameras["state_dicts"]["ema_model"].items() if not without or without not in k}
        return diffusion_policy.build({"cfg": config, "state_dicts": {"ema_model": kept | (weights or {})}}, AS_SAVED)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("variant", hybrid.VARIANTS)
def test_the_original_gave_the_same(variant: str, tmp_path: Path) -> None:
    """Features of every observed step, and the actions of a whole call, from the file that is saved."""
    torch.save(hybrid.payload(variant), tmp_path / "policy.ckpt")
    module, spec = load_checkpoint_policy(tmp_path / "policy.ckpt")
    numbers = golden(f"hybrid_{variant}")
    assert list(spec.observations) == list(hybrid.VARIANTS[variant]["obs"])
    observation = as_seen(spec, hybrid.observation(variant))
    assert isinstance(module, EncodedDenoiser)
    with torch.inference_mode(), Counted() as counted:
        features = module.encoder(observation).flatten(0, 1)
    assert numbers["features"].std(axis=0).max() > 0.1
    assert_equal_but_for_rounding(features, numbers["features"], counted.terms)
    with torch.inference_mode():
        halved = copy.deepcopy(module.encoder).half().float()(observation).flatten(0, 1).numpy()
    assert np.abs(halved - numbers["features"]).max() > 5 * allowed(numbers["features"], counted.terms)
    assert spec.sampler.timesteps.tolist() == numbers["timesteps"].tolist()
    assert spec.chunk.normalizer is not None and spec.chunk.action_dim == hybrid.ACTION
    assert_actions(spec, eager_policy(module, spec)(observation, Noise(*hybrid.noise(variant))), numbers)


def test_the_encoder_runs_once_in_the_eager_loop(build: Callable[..., tuple[Any, Any]]) -> None:
    """As the original's; otherwise a compiled policy would be compared with one that nobody runs."""
    module, spec = build()
    calls: list[int] = []
    module.encoder.register_forward_hook(lambda *_: calls.append(1))
    inputs = {key: torch.from_numpy(value) for key, value in hybrid.observation("two_cameras").items()}
    eager_policy(module, spec)(inputs, Noise(*hybrid.noise("two_cameras")))
    assert len(calls) == 1


# Compiled

COMPILED = "action_steps_only"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Program, Path]:
    """A policy with one camera and group norm, converted once."""
    folder = tmp_path_factory.mktemp("hybrid")
    torch.save(hybrid.payload(COMPILED), folder / "policy.ckpt")
    return ttscompile.convert(folder / "policy.ckpt", folder / "compiled"), folder / "compiled"


@pytest.mark.slow
def test_compiled_is_the_original(compiled: tuple[Program, Path]) -> None:
    noise = Noise(*hybrid.noise(COMPILED))
    assert_compiled_acts(compiled[1], hybrid.observation(COMPILED), noise, golden(f"hybrid_{COMPILED}"))


@pytest.mark.slow
def test_the_encoder_is_a_piece_of_its_own(compiled: tuple[Program, Path]) -> None:
    """Every convolution is in a graph that runs once a frame, and the dense FLOPs count it once a call."""
    program, _ = compiled
    pieces = program.pieces
    assert pieces.step is not None
    (tower,) = pieces.towers
    assert sum("conv" in node.op for node in tower.nodes) == 21  # ResNet-18 has 20; and the keypoints
    assert not any("conv" in node.op for node in pieces.condition.nodes)
    loop = (*(piece.graph for piece in pieces.loop.values()), pieces.step)
    assert not any("conv" in node.op for graph in loop for node in graph.nodes)
    every_step = sum(graph_flops(graph) for graph in loop) * hybrid.STEPS
    once = frames_flops(pieces) + graph_flops(pieces.condition)
    assert 0 < program.dense_flops - once < 1.2 * every_step
    record(
        "Diffusion Policy, transformer on images (robomimic encoder)",
        "actions and features that the original gave, 1e-5 of the range",
        f"ddpm {hybrid.STEPS}",
        program,
    )


# Settings


def test_random_crops_become_the_centre(build: Callable[..., tuple[Any, Any]]) -> None:
    """Without eval_fixed_crop the original crops at random in evaluation, too; that ours does not is said."""
    with pytest.warns(UserWarning, match=r"eval_fixed_crop is false.*takes the centre"):
        module, _ = build(eval_fixed_crop=False)
    # Margins of 5 and 7 pixels: 2.5 and 3.5 are rounded to even numbers.
    assert {(c.crop.top, c.crop.left, *c.crop.size) for c in module.encoder.cameras} == {(2, 4, 36, 36)}


def test_only_the_crop_matters(build: Callable[..., tuple[Any, Any]]) -> None:
    """A change of any pixel outside the crop changes nothing, one inside does."""
    module, _ = build()
    camera = module.encoder.cameras[0]
    image = torch.rand(1, 3, 41, 43)
    outside, inside = image.clone(), image.clone()
    outside[:, :, :2], outside[:, :, 38:], outside[:, :, :, :4], outside[:, :, :, 40:] = 0, 0, 0, 0
    inside[:, :, 2] = 0
    with torch.inference_mode():
        features = camera(image)
        assert torch.equal(camera(outside), features)
        assert not torch.equal(camera(inside), features)


def test_weights_that_are_there_once(build: Callable[..., tuple[Any, Any]], two_cameras: Payload) -> None:
    """Without the second names, or without the first: the same policy."""
    expected = build()[0].state_dict()
    assert two_cameras["state_dicts"]["ema_model"][f"{WRIST}nets.0.nets.0.weight"].shape == (64, 3, 7, 7)
    for without in (".nets.0.nets.", ".backbone."):
        found = build(without=without)[0].state_dict()
        assert all(torch.equal(found[key], expected[key]) for key in expected)


def test_keys_of_any_name(build: Callable[..., tuple[Any, Any]], two_cameras: Payload) -> None:
    """An observation may have a name with dashes, slashes and blanks, as the original's dictionaries may."""
    names = {"wrist": "images/wrist cam", "pos": "arm-pos", "front": "cam-front"}
    meta = copy.deepcopy(two_cameras["cfg"]["policy"]["shape_meta"])
    meta["obs"] = {names[key]: each for key, each in meta["obs"].items()}
    weights = two_cameras["state_dicts"]["ema_model"]
    parts = {key: [names.get(part, part) for part in key.split(".")] for key in weights}
    renamed = {".".join(parts[key]): value for key, value in weights.items()}
    found, spec = build(renamed, without=".", shape_meta=meta)
    expected = build()[0].state_dict()
    assert list(spec.observations) == list(names.values())
    assert all(torch.equal(value, expected[key]) for key, value in found.state_dict().items())


def test_the_grid_of_half_precision_is_exact(build: Callable[..., tuple[Any, Any]], two_cameras: Payload) -> None:
    """The grid of the spatial softmax was rounded with the weights, and is known without them."""
    meta, grid = copy.deepcopy(two_cameras["cfg"]["policy"]["shape_meta"]), SpatialSoftmax(4, 4)
    weights = dict(two_cameras["state_dicts"]["ema_model"])
    for key, each in meta["obs"].items():
        if each.get("type") == "rgb":
            each["shape"] = [3, 100, 100]
            names = (f"obs_encoder.obs_nets.{key}.{part}.pos_" for part in ("pool", "nets.1"))
            weights |= {name + axis: grid.get_buffer(f"pos_{axis}") for name in names for axis in "xy"}
    halved = {key: value.bfloat16() for key, value in weights.items()}
    module, _ = build(halved, shape_meta=meta, crop_shape=None)
    for camera in module.encoder.cameras:
        assert torch.equal(camera.pool.pos_x, grid.pos_x) and torch.equal(camera.pool.pos_y, grid.pos_y)


REFUSED: Refusals = {
    "weights": [
        ({f"{WRIST}nets.0.nets.0.weight": torch.zeros(64, 3, 7, 7)}, r"nets\.0\.weight differ: .* saved twice"),
        (
            {f"{WRIST}nets.1.nets.bias": torch.zeros(32)},
            r"pool\.nets\.bias and \S+nets\.1\.nets\.bias differ|nets\.1\.nets\.bias and \S+pool\.nets\.bias differ",
        ),
        ({f"{WRIST}nets.3.bias": torch.zeros(65)}, r"nets\.3\.bias has shape \(65,\); expected \(64,\)"),
        ({f"{WRIST}nets.3.bias": torch.full((64,), math.nan)}, r"nets\.3\.bias holds 64 values that are not finite"),
        ({f"{WRIST}nets.4.weight": torch.zeros(3)}, r"unexpected .*nets\.4\.weight"),
        (
            {"obs_encoder.obs_nets.third.nets.3.bias": torch.zeros(64)},
            r"third\.nets\.3\.bias, which belong to no image",
        ),
        ({"obs_encoder.key_model_map.rgb.weight": torch.zeros(64)}, "another observation encoder; use"),
        (
            {f"{WRIST}pool.pos_x": torch.zeros(1, 4), f"{WRIST}nets.1.pos_x": torch.zeros(1, 4)},
            r"pos_x is not the grid",
        ),
        (
            {f"normalizer.params_dict.wrist.{name}": torch.ones(3) for name in ("scale", "offset")},
            r"params_dict\.wrist has 3 entries; expected one for the whole image",
        ),
        ({"normalizer.params_dict.pos.scale": torch.ones(3)}, r"pos\.scale has shape \(3,\).* 4 channels"),
    ],
    "policy": [
        ({"obs_encoder_group_norm": False}, r"not those of robomimic's .*missing .*nets\.1\.running_mean"),
        ({"obs_encoder_group_norm": 1}, r"obs_encoder_group_norm is 1; expected true or false"),
        ({"crop_shape": [41, 30]}, r"crop_shape is \[41, 30\], and the images of 'wrist' are 41 x 43"),
        ({"crop_shape": 36}, r"crop_shape is 36; expected \[height, width\] or null"),
        ({"crop_shape": [20, 20]}, r"pos_x has shape \(1, 4\); expected \(1, 1\)"),
        ({"shape_meta": None}, "shape_meta is missing or malformed"),
        ({"shape_meta": {"obs": {}, "action": {"shape": [3]}}}, "names no observation"),
        ({"shape_meta": {"obs": {"a": {"shape": [4]}}, "action": {"shape": [3, 2]}}}, r"action\.shape is \[3, 2\]"),
        (
            {"shape_meta": {"obs": {"a": {"shape": [4], "type": "depth"}}, "action": {"shape": [3]}}},
            r"obs\.a\.type is 'depth'; expected low_dim or rgb",
        ),
        (
            {"shape_meta": {"obs": {"a": {"shape": [4, 4], "type": "rgb"}}, "action": {"shape": [3]}}},
            r"obs\.a\.shape is \[4, 4\]; expected \[C, H, W\]",
        ),
        ({"n_emb": 33}, r"cfg\.policy: n_emb = 33"),
        ({"horizon": None}, r"cfg\.policy\.horizon is None"),
        ({"obs_as_cond": "yes"}, r"cfg\.policy\.obs_as_cond is 'yes'"),
        ({"share_rgb_model": True}, r"cfg\.policy has settings that are not known: share_rgb_model"),
    ],
}


@pytest.mark.parametrize(("place", "given", "message"), refusals(REFUSED))
def test_what_does_not_fit_is_refused(
    build: Callable[..., tuple[Any, Any]], place: str, given: dict[str, Any], message: str
) -> None:
    """Each is named, with what was expected."""
    with pytest.raises(CheckpointError, match=message):
        build(**({"weights": given} if place == "weights" else given))
