"""RDT from its cameras' pictures on: SigLIP is compiled in where it is there, and actions are those of ``step``."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.checks import assert_runtimes_agree, golden, kinds, rounded
from tests.families.support import record, stored_program
from tests.once import Once
from tests.rounding import assert_equal_but_for_rounding
from ttscompile.artifact import load_artifact
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.networks.siglip import Siglip, SiglipConfig
from ttscompile.policies.rdt_cameras import SIGLIP

from .authors import assert_acts_as_the_original, by_one_command
from .rdts import CAMERAS, PATCHES, SIDE, VISION, observed, save, save_siglip
from .refused import assert_not_read

LEFT = CAMERAS[-1]


@pytest.fixture(scope="module")
def compiled(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact of all cameras."""

    def make(folder: Path) -> None:
        by_one_command(save(save_siglip(folder)))

    return once.folder("rdt-pictures", make) / "compiled"


@pytest.mark.slow
def test_pictures_become_the_actions_of_the_original(compiled: Path) -> None:
    """With the runtime of the robot; in one stream an episode begins, and a picture is no square."""
    arrays, path = golden("rdt_pictures"), compiled.parent / "rdt"
    policy, made = assert_acts_as_the_original(path, compiled, observed(), arrays["noise"], arrays["actions"])
    assert {key for key in policy.info.observation if key.startswith("cam")} == set(CAMERAS)
    assert all(policy.info.observation[name].shape == (2, 3, SIDE, SIDE) for name in CAMERAS)
    assert np.abs(arrays["actions"] - arrays["actions_without"]).max() > 0.01
    other = observed()
    other[CAMERAS[0]], other[CAMERAS[1]] = other[CAMERAS[1]], other[CAMERAS[0]]
    policy.reset()
    swapped = policy.predict_action(other, noise=ttscompile.Noise(arrays["noise"]), plan="dense")["action"]
    assert np.abs(swapped - made).max() > 0.001
    program = stored_program(load_artifact(compiled))
    assert kinds(program) == {"self_attention": 4, "cross_attention": 4, "feed_forward": 4}
    compared = (
        "RoboticsDiffusionTransformer deb71d8 `step`, from pictures and T5's features, up to the rounding of float32"
    )
    record("RDT-1B with SigLIP, read from its directory", compared, "dpmsolver++ 5", program)


@pytest.mark.slow
def test_a_picture_is_encoded_once_and_its_tokens_can_be_reused(compiled: Path) -> None:
    """SigLIP and the adaptor behind it are one piece, of which a call of three cameras computes what is new."""
    manifest = load_artifact(compiled).manifest
    assert {name: (one.tokens, one.fixed) for name, one in manifest.tokens.items()} == {"frame_00": (PATCHES, 0)}
    assert set(CAMERAS) <= set(manifest.pieces["frames"].inputs)
    policy = ttscompile.load(compiled)
    first = {key: value[:1] for key, value in observed().items()}
    moved = {key: value[:, ::-1].copy() if key in CAMERAS else value for key, value in first.items()}
    moved |= {CAMERAS[0]: np.stack([first[CAMERAS[0]][:, 1], 1 - first[CAMERAS[0]][:, 0]], 1)}
    frames = []
    for given in (first, first, moved):
        policy.predict_action(given)
        assert policy.last_report is not None
        frames.append(policy.last_report.frames)
    assert [(each.computed, each.remembered) for each in frames] == [(6, 0), (0, 6), (1, 5)]


@pytest.mark.slow
def test_a_camera_that_the_robot_lacks_shows_what_the_original_puts_in_its_place(tmp_path: Path) -> None:
    arrays, path, models = golden("rdt_pictures"), save(tmp_path), save_siglip(tmp_path / "models")
    compiled = by_one_command(path, "--encoders", str(models), "--without-camera", LEFT)
    policy = ttscompile.load(compiled, runtime="onnxruntime")
    assert LEFT not in policy.info.observation and policy._spec.source["without"] == LEFT
    noise = ttscompile.Noise(arrays["noise"])
    made = policy.predict_action(observed(LEFT), noise=noise, plan="dense")["action"]
    module, spec = load_checkpoint_policy(path, options=LoadOptions(encoders=models, without_cameras=(LEFT,)))
    assert_equal_but_for_rounding(made, arrays["actions_without"], *rounded(module, observed(LEFT), spec))


@pytest.mark.soak
def test_runtimes_agree(compiled: Path) -> None:
    assert_runtimes_agree(compiled)


def test_an_encoder_of_images_alone_is_read_too(tmp_path: Path) -> None:
    """As transformers saves it; and with its own folder named."""
    path, whole, alone = save(tmp_path), save_siglip(tmp_path / "whole"), save_siglip(tmp_path / "alone", alone=True)
    made = [
        load_checkpoint_policy(path, options=LoadOptions(encoders=each))[0].state_dict()
        for each in (whole, alone / SIGLIP)
    ]
    assert made[0].keys() == made[1].keys()
    assert all(torch.equal(value, made[1][name]) for name, value in made[0].items())


def test_every_patch_has_a_position_of_its_own() -> None:
    """Shares of a side, as SmolVLM rounds them, are the same positions of 27 patches, and not of 19."""
    config = SiglipConfig(**VISION)
    assert Siglip(config).positions.tolist() == list(range(PATCHES))
    assert Siglip(config, (SIDE, SIDE)).positions.tolist() != list(range(PATCHES))


def test_cameras_of_another_number_are_counted(tmp_path: Path) -> None:
    save_siglip(tmp_path)
    spec = load_checkpoint_policy(save(tmp_path, img_pos_embed_config=[["image", [3, 2, -PATCHES]]]))[1]
    assert {key: each.shape for key, each in spec.observations.items() if each.image} == {
        "camera_0": (3, 3, SIDE, SIDE),
        "camera_1": (3, 3, SIDE, SIDE),
    }


def test_without_an_encoder_its_tokens_are_observed_and_that_is_said(tmp_path: Path) -> None:
    message = rf"rdt: the image encoder {SIGLIP} is in no checkpoint of RDT, .* img_tokens \[2166, 32\]\. .*--encoders"
    with pytest.warns(UserWarning, match=message):
        spec = load_checkpoint_policy(save(tmp_path))[1]
    assert spec.observations["img_tokens"].shape == (2166, 32)
    assert not set(CAMERAS) & set(spec.observations)


REFUSED: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any], str]] = [
    (
        {},
        {},
        {"without_cameras": ("cam_low",)},
        "the cameras are cam_high, cam_right_wrist, .*; cam_low cannot be left",
    ),
    (
        {},
        {},
        {"without_cameras": CAMERAS},
        "; all cannot be left out. A policy needs a camera that it was trained with",
    ),
    ({"img_pos_embed_config": None}, {}, {}, r"img_pos_embed_config is None; expected \[\['image', \[frames, cameras"),
    (
        {"img_pos_embed_config": [["image", [2, 2, -PATCHES]]]},
        {},
        {},
        "expected .*-patches.*, 2166 tokens in all. Give",
    ),
    (
        {},
        {"patch_size": 6},
        {},
        r"makes 169 tokens of 32 numbers of a picture; expected 361 of 32, .*makes 729 of 1152",
    ),
    ({}, {"hidden_size": 31}, {}, r"config\.json: an encoder's hidden_size is 31; expected a multiple"),
    ({}, {"num_hidden_layers": 3}, {}, r"missing encoder\.layers\.2\..*than its config\.json describes"),
]


@pytest.mark.parametrize(("changes", "seen", "asked", "message"), REFUSED)
def test_what_does_not_fit_is_refused(
    changes: dict[str, Any], seen: dict[str, Any], asked: dict[str, Any], message: str, tmp_path: Path
) -> None:
    save_siglip(tmp_path, **seen)
    assert_not_read(save(tmp_path, **changes), message, names=tmp_path, options=LoadOptions(**asked))


def test_an_encoder_that_is_asked_for_and_not_there_is_missed(tmp_path: Path) -> None:
    path = save(tmp_path)
    for asked in (LoadOptions(encoders=tmp_path / "nowhere"), LoadOptions(without_cameras=(LEFT,))):
        assert_not_read(path, f"the image encoder '{SIGLIP}' is not on this machine", names=path, options=asked)
    config = save_siglip(tmp_path) / SIGLIP / "config.json"
    config.write_text(config.read_text().replace('"siglip"', '"siglip2"'))
    assert_not_read(path, "model_type is 'siglip2'; expected siglip or siglip_vision_model", names=path)
    (config.parent / "model.safetensors").unlink()
    config.write_text(config.read_text().replace('"siglip2"', '"siglip"'))
    assert_not_read(path, r"model\.safetensors: no such file", names=path)
