"""LeRobot's ``diffusion``, against numbers that lerobot gave; see ``golden/make_lerobot_unets.py``."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.rounding import PROMISED, Counted, assert_equal_but_for_rounding
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.ir.program import Program

from ..families.support import record
from ..once import Once
from . import lerobot_unets
from .lerobot_tiny import changed_policy
from .lerobot_unets import ACTION_DIM, ENVIRONMENT, STATE, TOP, WRIST
from .originals import assert_agreement_on_random_plans, golden
from .refused import assert_not_read

COMPILED = "one_encoder"


def load(directory: Path) -> tuple[EncodedDenoiser, PolicySpec]:
    """Module and specification."""
    module, spec = load_checkpoint_policy(directory)
    assert isinstance(module, EncodedDenoiser)
    return module, spec


@pytest.mark.slow
@pytest.mark.parametrize("variant", lerobot_unets.VARIANTS)
def test_lerobot_gave_the_same(variant: str, tmp_path: Path) -> None:
    """The condition, single evaluations, and the executed actions of a whole call, from the files that are saved."""
    module, spec = load(lerobot_unets.save(variant, tmp_path / "policy"))
    numbers, observation = golden(f"lerobot_unet_{variant}"), lerobot_unets.observation(variant)
    assert set(spec.observations) == set(observation)
    given = {key: torch.from_numpy(value) for key, value in observation.items()}
    noise = Noise(*lerobot_unets.noise())
    with torch.inference_mode(), Counted() as counted:
        condition = module.encoder({spec.arguments[key]: value for key, value in given.items()})
    assert_equal_but_for_rounding(condition, numbers["condition"], counted.terms)
    expected_condition = torch.from_numpy(numbers["condition"])
    for timestep, expected in zip(numbers["probe_t"], numbers["probe_out"], strict=True):
        with torch.inference_mode(), Counted() as counted:
            times = torch.full((lerobot_unets.STREAMS,), int(timestep))
            found = module.denoiser(torch.from_numpy(noise.initial), times, expected_condition)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)
    assert spec.sampler.timesteps.tolist() == numbers["timesteps"].tolist()
    actions = spec.chunk.unnormalized(eager_policy(module, spec)(given, noise).numpy())
    executed = actions[:, spec.chunk.start : spec.chunk.stop]
    assert executed.shape == numbers["action"].shape
    assert np.abs(executed - numbers["action"]).max() < PROMISED * np.ptp(numbers["action"])


@pytest.mark.parametrize("variant", ["one_encoder", "separate", "deeper"])
def test_the_images_matter(variant: str) -> None:
    """Of the recorded condition each camera's features are not all zero, and not the same for both streams."""
    made, numbers = lerobot_unets.VARIANTS[variant], golden(f"lerobot_unet_{variant}")
    keypoints = made["settings"].get("spatial_softmax_num_keypoints", 8)
    features = numbers["condition"][:, lerobot_unets.STATE_DIM :][:, : 2 * keypoints]
    assert np.ptp(features, axis=0).max() > 0.1


@pytest.mark.parametrize("name", ["image", "state"])
def test_directories_that_lerobot_saved(name: str, shared: Path) -> None:
    """The actions of two calls; the files are those of ``save_pretrained``."""
    directory = shared / "golden" / "lerobot_whole" / f"diffusion_{name}"
    module, spec = load(directory)
    with np.load(directory.with_suffix(".npz")) as numbers:
        for call in ("call0", "call1"):
            frames = {key: [numbers[f"{call}.frame{i}.{key}"] for i in range(2)] for key in spec.observations}
            given = {key: torch.from_numpy(np.stack(each)[None]) for key, each in frames.items()}
            sample = eager_policy(module, spec)(given, Noise(numbers[f"{call}.noise"])).numpy()
            actions = spec.chunk.unnormalized(sample)[:, spec.chunk.start : spec.chunk.stop]
            expected = numbers[f"{call}.action"]
            assert actions.shape == expected.shape
            assert np.abs(actions - expected).max() < PROMISED * np.ptp(expected)


# Compiled


@pytest.fixture(scope="module")
def compiled(once: Once) -> tuple[Path, Program]:
    """The policy of two cameras, converted once: its folder and program."""

    def convert(directory: Path) -> Program:
        return ttscompile.convert(lerobot_unets.save(COMPILED, directory.parent / "policy"), directory)

    return once.compiled("lerobot unet", convert)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_compiled_is_lerobot(compiled: tuple[Path, Program], runtime: str) -> None:
    """From the robot's own observations to actions in its units, through the artifact."""
    expected = golden(f"lerobot_unet_{COMPILED}")["action"]
    policy = ttscompile.load(compiled[0], runtime=runtime)
    observation = lerobot_unets.observation(COMPILED)
    found = policy.predict_action(observation, noise=Noise(*lerobot_unets.noise()), plan="dense")["action"]
    assert np.abs(found - expected).max() < PROMISED * np.ptp(expected)


@pytest.mark.slow
def test_select_action_is_lerobots(compiled: tuple[Path, Program]) -> None:
    """Frame by frame, action after action, in tensors; the window is the last two frames."""
    policy, expected = ttscompile.load(compiled[0]), golden(f"lerobot_unet_{COMPILED}")["action"]
    observation, noise = lerobot_unets.observation(COMPILED), Noise(*lerobot_unets.noise())
    first, second = ({key: torch.from_numpy(value[:, i]) for key, value in observation.items()} for i in range(2))
    policy.predict_action_chunk(first, noise=noise)
    found = [policy.select_action(second, noise=noise)]
    found += [policy.select_action(second) for _ in range(expected.shape[1] - 1)]
    assert all(isinstance(each, torch.Tensor) and each.shape == (2, ACTION_DIM) for each in found)
    assert np.abs(torch.stack(found, dim=1).numpy() - expected).max() < PROMISED * np.ptp(expected)


@pytest.mark.slow
def test_the_encoder_leaves_the_loop(compiled: tuple[Path, Program]) -> None:
    """The ResNet runs once a frame; whole evaluations are what is reused."""
    program = compiled[1]
    record(
        "LeRobot diffusion (U-Net on images)",
        "actions that lerobot 0.6.1 gave, raw observation to action, 1e-5 of the range",
        f"{program.spec.sampler.name} {program.spec.sampler.steps}",
        program,
    )
    images = [node for tower in program.pieces.towers for node in tower.nodes if "conv" in node.op]
    assert len(images) == 21  # 20 of ResNet-18, one of the keypoints
    loop = [node for piece in program.pieces.loop.values() for node in piece.graph.nodes]
    assert not any(len(shape) == 4 for node in loop for shape in (type_.shape for type_ in node.types))


@pytest.mark.slow
def test_both_runtimes_agree_on_random_plans(compiled: tuple[Path, Program]) -> None:
    """Episodes of random legal plans, several streams."""
    assert_agreement_on_random_plans(compiled[0], calls=3)


# Settings


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of one camera whose files a test may replace by others in a folder of its own."""
    return lerobot_unets.save("separate", tmp_path_factory.mktemp("lerobot_unet") / "policy")


@pytest.fixture
def changed(saved: Path, tmp_path: Path) -> Callable[..., Path]:
    """The same policy with entries of its ``config.json``, or some of its weights, changed."""

    return partial(changed_policy, saved, tmp_path / "policy")


PREFIX = "diffusion.rgb_encoder.0."
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "deeper ResNet": (
        {"vision_backbone": "resnet50"},
        r"vision_backbone is 'resnet50'; expected resnet18 or resnet34\. .*compile_denoiser",
    ),
    "no text": ({"vision_backbone": ["resnet18"]}, r"vision_backbone is .*expected resnet18 or resnet34"),
    "other ResNet": ({"vision_backbone": "resnet34"}, r"missing diffusion\.rgb_encoder\.0\.backbone\.4\.2"),
    "one encoder": ({"use_separate_rgb_encoder_per_camera": False}, r"missing diffusion\.rgb_encoder\.backbone\.0"),
    "batch norm": ({"use_group_norm": False}, r"missing diffusion\.rgb_encoder\.0\.backbone\.1\.running_mean"),
    "keypoints": ({"spatial_softmax_num_keypoints": 9}, r"out\.bias has shape \(16,\); expected \(18,\)"),
    "scales": ({"use_film_scale_modulation": True}, r"cond_encoder\.1\.bias has shape \(8,\); expected \(16,\)"),
    "no flag": ({"use_film_scale_modulation": 1}, r"use_film_scale_modulation is 1; expected true or false"),
    "levels": ({"down_dims": [8, 16]}, r"unexpected .*diffusion\.unet\.down_modules\.2"),
    "channels": ({"down_dims": [8, 16, 22]}, r"down_dims = \[8, 16, 22\] with n_groups = 4; expected channels that"),
    "no channels": ({"down_dims": []}, r"down_dims is \[\]; expected up to 16 positive whole numbers"),
    "many levels": ({"down_dims": [8] * 17}, r"down_dims is .*expected up to 16"),
    "huge": ({"down_dims": [8, 2**15, 2**16]}, r"weight diffusion\.unet\S+ has shape"),
    "even kernel": ({"kernel_size": 4}, r"kernel_size of the U-Net is 4; expected an odd number"),
    "horizon": ({"horizon": 6}, r"horizon is 6; expected a multiple of 4"),
    "frames": ({"n_obs_steps": 2}, r"weight diffusion\.unet\S+ has shape"),
    "ratio": ({"resize_shape": [36, 33], "crop_ratio": 0}, r"crop_ratio is 0; expected a number above 0, 1 at most"),
    "nothing left": ({"resize_shape": [2, 2], "crop_ratio": 0.4}, r"crop_ratio is 0\.4; expected a share that leaves"),
    "crop": ({"crop_shape": [50, 33]}, r"the crop \(50, 33\) is larger than the image, \(43, 38\)"),
    "huge crop": ({"crop_shape": [10**6, 10**6]}, r"crop_shape is .*4096 pixels at most"),
    "map": ({"crop_shape": [36, 32]}, r"pool\.pos_grid has shape \(4, 2\); expected \(2, 2\)"),
    "prediction": ({"prediction_type": "v_prediction"}, r"expected epsilon or sample"),
    "scheduler": ({"noise_scheduler_type": "PNDM"}, r"expected DDPM or DDIM"),
    "no state": ({"input_features": {}}, r"no vector 'observation\.state'"),
    "grid": ({"weights": lambda w: w[f"{PREFIX}pool.pos_grid"].mul_(0.9)}, r"pos_grid is not the grid from -1 to 1"),
    "missing": ({"weights": lambda w: w.pop(f"{PREFIX}out.bias")}, r"missing diffusion\.rgb_encoder\.0\.out\.bias"),
    "extra": ({"weights": lambda w: w.update(extra=torch.ones(1))}, r"unexpected extra"),
    "not finite": (
        {"weights": lambda w: w[f"{PREFIX}out.bias"].fill_(float("nan"))},
        r"out\.bias holds 16 values that are not finite",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", BAD)
def test_settings_that_do_not_fit(changed: Callable[..., Path], case: str) -> None:
    """Each is named, with what was expected, and the directory."""
    given, message = BAD[case]
    directory = changed(**given)
    assert_not_read(directory, message, error=TtscompileError, names=directory)


def test_another_environment(changed: Callable[..., Path]) -> None:
    """lerobot reads one vector of the environment, by its name."""
    inputs = {STATE: {"type": "STATE", "shape": [4]}, "observation.goal": {"type": "ENV", "shape": [2]}}
    assert_not_read(changed(input_features=inputs), f"'observation.goal'.*expected one, '{ENVIRONMENT}'")


def test_a_network_that_was_compiled_in_training(changed: Callable[..., Path]) -> None:
    """With ``compile_model`` lerobot saves its weights a level deeper."""

    def wrap(weights: dict[str, torch.Tensor]) -> None:
        for name in [name for name in weights if ".unet." in name]:
            weights[name.replace(".unet.", ".unet._orig_mod.")] = weights.pop(name)

    module, _ = load(changed(weights=wrap, compile_model=True))
    drawn = lerobot_unets.observation("separate")
    given = {name.replace(".", "_"): torch.from_numpy(value) for name, value in drawn.items()}
    with torch.inference_mode():
        assert module.encoder(given).shape == golden("lerobot_unet_separate")["condition"].shape


@pytest.mark.parametrize("option", ["task", "encoders"])
def test_options_of_other_types(saved: Path, option: str) -> None:
    """There is no instruction to compile in."""
    assert_not_read(
        saved,
        f"the option {option} is for LeRobot's multi_task_dit",
        options=LoadOptions(**dict[str, Any]({option: "push"})),
    )


def test_defaults_are_lerobots(changed: Callable[..., Path]) -> None:
    """Of what a file leaves out; beside its own a policy can have another sampler."""
    directory = changed(crop_ratio=1.0)
    config = lerobot_unets.read(directory)
    assert (config.crop, config.resize, config.image_size) == ((36, 33), None, (36, 33))
    assert list(config.features) == [STATE, WRIST, TOP, ENVIRONMENT, "action"]
    _, spec = load_checkpoint_policy(directory, options=LoadOptions(sampler="ddim", steps=3))
    found = {name: (one.name, one.steps) for name, one in spec.all_loops.items()}
    assert found == {"original": ("ddim", lerobot_unets.STEPS), "ddim-3": ("ddim", 3)}
    assert (spec.chunk.start, spec.chunk.stop, spec.source["policy"]) == (0, 4, "diffusion")


@pytest.mark.parametrize(("ratio", "crop"), [(0.5, (18, 16)), (1, None)])
def test_what_is_seen_after_a_resize(changed: Callable[..., Path], ratio: float, crop: tuple[int, int] | None) -> None:
    """A share of it, or all of it, whatever crop_shape says."""
    config = lerobot_unets.read(changed(resize_shape=[36, 33], crop_ratio=ratio))
    assert (config.resize, config.crop) == ((36, 33), crop)
    assert config.image_size == (crop or (36, 33))
