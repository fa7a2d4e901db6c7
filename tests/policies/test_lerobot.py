"""LeRobot policies of our own: variants against their definitions, and every way a directory can be wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from safetensors.torch import load_file
from torch.nn import functional

import ttscompile
from tests.rounding import Counted, allowed, amplified, assert_equal_but_for_rounding
from ttscompile.core.spec import Noise, ObservationSpec
from ttscompile.driver import transform
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.lerobot.multi_task_dit import Network, with_inputs
from ttscompile.policies.lerobot.processors import Normalizer, Statistics, read_processors
from ttscompile.policies.networks.clip import TextConfig
from ttscompile.policies.networks.image_geometry import ResizeCrop

from .lerobot_tiny import DA, DS, SIDE, TEXT, TO, VISION, change_json, dit_config, save_policy
from .originals import assert_agreement_on_random_plans
from .refused import assert_not_read

STATE, TOKENS, MASK = "observation.state", "observation.language.tokens", "observation.language.attention_mask"
PLAIN: dict[str, Any] = {"use_rope": False, "use_positional_encoding": True}


def load(directory: Path, **options: Any) -> tuple[EncodedDenoiser, Any]:
    """Module and specification."""
    module, spec = load_checkpoint_policy(directory, options=LoadOptions(**options))
    assert isinstance(module, EncodedDenoiser)
    return module, spec


def observe(spec: Any, streams: int = 2, seed: int = 0) -> dict[str, torch.Tensor]:
    """A random raw observation whose instruction ends somewhere in the row."""
    rng = np.random.default_rng(seed)
    obs = {key: np.concatenate([o.draw(rng) for _ in range(streams)]) for key, o in spec.observations.items()}
    if TOKENS in obs:
        obs[TOKENS] %= TEXT["eos_token_id"]
        obs[TOKENS][:, 6:] = TEXT["eos_token_id"]
        obs[MASK] = np.broadcast_to(np.arange(9) < 7, obs[MASK].shape).copy()
    return {key: torch.from_numpy(value) for key, value in obs.items()}


def test_learned_positions_and_plain_attention(tmp_path: Path) -> None:
    """The variant without rotation, against the definition of adaLN-Zero written out on the saved weights."""
    directory = save_policy(tmp_path, **PLAIN)
    module, _ = load(directory)
    w = {k.removeprefix("noise_predictor."): v for k, v in load_file(directory / "model.safetensors").items()}
    draw = torch.Generator().manual_seed(0)
    x, t = torch.randn(2, 8, DA, generator=draw), torch.tensor([3, 17])
    condition = torch.randn(2, TO * (DS + 16), generator=draw)

    angle = t[:, None] * torch.exp(torch.arange(4) * -(np.log(10000) / 3))
    time = torch.cat((angle.sin(), angle.cos()), -1).float()
    for i in (1, 3):
        time = functional.gelu(functional.linear(time, w[f"time_mlp.{i}.weight"], w[f"time_mlp.{i}.bias"]))
    features = functional.silu(torch.cat((time, condition), -1))
    h = functional.linear(x, w["input_proj.weight"], w["input_proj.bias"]) + w["pos_embedding"]
    for i in range(2):
        b = {
            k.removeprefix(f"transformer_blocks.{i}."): v
            for k, v in w.items()
            if k.startswith(f"transformer_blocks.{i}.")
        }
        made = functional.linear(features, b["adaLN_modulation.1.weight"], b["adaLN_modulation.1.bias"])
        s1, c1, g1, s2, c2, g2 = made[:, None].chunk(6, -1)
        n = functional.layer_norm(h, (16,), eps=1e-6) * (1 + c1) + s1
        qkv = functional.linear(n, b["multihead_attn.in_proj_weight"], b["multihead_attn.in_proj_bias"])
        q, k, v = (part.unflatten(-1, (2, 8)).transpose(1, 2) for part in qkv.chunk(3, -1))
        mixed = (q @ k.transpose(-1, -2) / 8**0.5).softmax(-1) @ v
        out = (b["multihead_attn.out_proj.weight"], b["multihead_attn.out_proj.bias"])
        h = h + g1 * functional.linear(mixed.transpose(1, 2).flatten(2), *out)
        n = functional.layer_norm(h, (16,), eps=1e-6) * (1 + c2) + s2
        n = functional.gelu(functional.linear(n, b["mlp.0.weight"], b["mlp.0.bias"]), approximate="tanh")
        h = h + g2 * functional.linear(n, b["mlp.2.weight"], b["mlp.2.bias"])
    expected = functional.linear(h, w["output_proj.weight"], w["output_proj.bias"])
    with torch.inference_mode(), Counted() as counted:
        found = module.denoiser(x, t, condition)
    assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


def test_a_whole_number_is_a_base(tmp_path: Path) -> None:
    """JSON written by hand says 10000."""
    assert type(dit_config(save_policy(tmp_path, rope_base=10000)).network.rope_base) is float


@pytest.mark.parametrize("separate", [False, True])
def test_condition_of_two_cameras(tmp_path: Path, separate: bool) -> None:
    """Each frame is [state, camera, camera, instruction], as transformers' CLIP and plain arithmetic make it."""
    transformers = pytest.importorskip("transformers")
    directory = save_policy(
        tmp_path,
        cameras=("top", "wrist"),
        modes=("MEAN_STD", "MEAN_STD", "MIN_MAX"),
        renamed={"arm": STATE},
        use_separate_rgb_encoder_per_camera=separate,
        image_resize_shape=[20, 18],
    )
    module, spec = load(directory)
    assert list(spec.observations) == ["arm", "observation.images.top", "observation.images.wrist", TOKENS, MASK]
    obs = observe(spec)
    statistics, w = (load_file(directory / f"{name}.safetensors") for name in ("before", "model"))

    def encoder(cls: Any, config: dict[str, Any], prefix: str) -> Any:
        made = cls(
            getattr(transformers, cls.__name__.replace("Model", "Config"))(**config, pad_token_id=0, bos_token_id=1)
        )
        own = {key.removeprefix(prefix): value for key, value in w.items() if key.startswith(prefix)}
        nested = any(key.startswith(("vision_model.", "text_model.")) for key in made.state_dict())
        level = {False: lambda key: key.partition(".")[2], True: lambda key: key}[nested]
        made.load_state_dict({level(key): value for key, value in own.items()})
        return made.eval()

    seen = []
    with torch.inference_mode():
        for i, name in enumerate(("top", "wrist")):
            part = f"vision_encoders.{i}" if separate else "vision_encoder"
            eye = encoder(transformers.CLIPVisionModel, VISION, f"observation_encoder.{part}.model.")
            key = f"observation.images.{name}"
            pixels = (obs[key] - statistics[f"{key}.mean"]) / (statistics[f"{key}.std"] + 1e-8)
            resized = functional.interpolate(pixels.flatten(0, 1), (20, 18), mode="bilinear", antialias=True)
            hidden = eye(pixel_values=resized[:, :, 2:18, 1:17]).last_hidden_state
            seen.append(hidden[:, 0].unflatten(0, (-1, TO)))
        text = encoder(transformers.CLIPTextModel, TEXT, "observation_encoder.text_encoder.text_encoder.")
        pooled = text(input_ids=obs[TOKENS], attention_mask=obs[MASK].long()).pooler_output
        said = functional.linear(
            pooled, *(w[f"observation_encoder.text_encoder.projection.{p}"] for p in ("weight", "bias"))
        )
        arm = (obs["arm"] - statistics[f"{STATE}.mean"]) / (statistics[f"{STATE}.std"] + 1e-8)
        expected = torch.cat((arm, *seen, said[:, None].expand(-1, TO, -1)), -1).flatten(1)
        with Counted() as counted:
            found = module.encoder({spec.arguments[key]: value for key, value in obs.items()})
    assert_equal_but_for_rounding(found, expected, counted.terms)


def test_resize_and_crop() -> None:
    """Against interpolate with antialiasing: up, down, uneven, and crops whose border is half a pixel."""
    images = torch.rand(2, 3, 21, 30)
    for resize, crop in (
        ((11, 17), (8, 10)),
        ((40, 33), (40, 33)),
        ((21, 30), (10, 9)),
        (None, (16, 27)),
        ((9, 9), None),
    ):
        whole = images if resize is None else functional.interpolate(images, resize, mode="bilinear", antialias=True)
        height, width = crop or whole.shape[2:]
        top, left = (round((n - m) / 2) for n, m in zip(whole.shape[2:], (height, width), strict=True))
        expected = whole[:, :, top : top + height, left : left + width]
        assert_equal_but_for_rounding(ResizeCrop(21, 30, resize, crop)(images), expected, terms=21 + 30)
    with pytest.raises(CheckpointError, match="larger than the image"):
        ResizeCrop(21, 30, (10, 10), (11, 8))


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10"])
def test_normalizers(mode: str) -> None:
    """LeRobot's rules, channels that never changed included: eps in one direction only, and only where they say."""
    first, second, x = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([3.0, 2.0, 0.5]), torch.randn(7, 3)
    if mode == "MEAN_STD":
        second = torch.tensor([3.0, 2.0, 0.0])
    statistics, eps = Statistics(mode, first, second, 1e-8), 1e-8
    found, back = Normalizer(statistics)(x), torch.from_numpy(statistics.inverse().unnormalize(x.numpy()))
    if mode == "MEAN_STD":
        assert torch.equal(found, (x - first) / (second + eps))
        expected = x * second + first  # bare: the mean, where there is no deviation
    else:
        width = torch.where(second == first, torch.tensor(eps), second - first)
        assert torch.equal(found, 2 * (x - first) / width - 1)
        expected = (x + 1) / 2 * width + first
        at_ends = Normalizer(statistics)(torch.stack((first, second)))
        assert at_ends.tolist() == [[-1, -1, -1], [1, 1, -1]]
    assert_equal_but_for_rounding(back, expected, terms=6)  # two operations, there and back, with eps


def test_identity_leaves_as_it_is(tmp_path: Path) -> None:
    """No normaliser where the mode is IDENTITY."""
    module, spec = load(save_policy(tmp_path, modes=("IDENTITY",) * 3))
    obs = observe(spec)
    with torch.inference_mode():
        condition = module.encoder({spec.arguments[key]: value for key, value in obs.items()})
    assert torch.equal(condition[:, :DS], obs[STATE][:, 0])
    assert spec.chunk.normalizer is None


@pytest.mark.parametrize(("objective", "options"), [("sample", {}), ("euler", {}), ("rk4", {}), ("rk4", {"steps": 2})])
def test_samplers_against_plain_loops(tmp_path: Path, objective: str, options: dict[str, int]) -> None:
    """The table against diffusers' own loop, and against textbook integration."""
    flow = objective != "sample"
    changes: dict[str, Any] = (
        {"objective": "flow_matching", "integration_method": objective} if flow else {"prediction_type": "sample"}
    )
    module, whole = load(save_policy(tmp_path, **PLAIN, **changes), **options)
    assert list(whole.loops) == ["rk4-2"] * bool(options)
    if flow:
        assert (whole.sampler.name, whole.sampler.steps) == (objective, 12 if objective == "rk4" else 3)
    spec = whole.in_loop("rk4-2") if options else whole
    obs, x = observe(spec), torch.randn(2, 8, DA, generator=torch.Generator().manual_seed(0))
    noise = x.numpy().copy()
    found = eager_policy(module, spec)(obs, Noise(noise))
    with torch.inference_mode(), Counted() as counted:
        condition = module.encoder({spec.arguments[key]: value for key, value in obs.items()})

        def network(value: torch.Tensor, t: Any) -> torch.Tensor:
            return module.denoiser(value, torch.full((2,), t), condition)

        if not flow:
            scheduler = DDIMScheduler(20, prediction_type="sample", beta_schedule="squaredcos_cap_v2")
            scheduler.set_timesteps(4)
            for t in scheduler.timesteps:
                x = scheduler.step(network(x, int(t)), t, x).prev_sample
            assert spec.sampler.steps == 4
        else:
            steps = options.get("steps", 3)
            h = 1 / steps
            for i in range(steps):
                t = i * h
                a = network(x, t)
                if objective == "euler":
                    x = x + h * a
                    continue
                b = network(x + h / 2 * a, t + h / 2)
                c = network(x + h / 2 * b, t + h / 2)
                x = x + h / 6 * (a + 2 * b + 2 * c + network(x + h * c, t + h))
            assert spec.sampler.steps == (4 * steps if objective == "rk4" else steps)
    # A clipped sample is smaller than the noise that it was computed from, whose rounding it has.
    atol = allowed(
        np.maximum(np.abs(noise).max(), np.abs(x.numpy())), amplified(counted.terms, spec.sampler), counted.angle
    )
    np.testing.assert_allclose(found, x, rtol=0, atol=atol)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:normaliser of observation.state")
def test_rk4_with_plain_attention_compiles(tmp_path: Path) -> None:
    """Four evaluations a step, each a step of the lattice, in both runtimes; and they agree on random plans."""
    directory = save_policy(tmp_path, **PLAIN, num_layers=1, objective="flow_matching", integration_method="rk4")
    module, spec = load(directory)
    ttscompile.convert(directory, tmp_path / "compiled", format="lerobot")
    obs = observe(spec)
    noise = Noise(np.random.default_rng(0).standard_normal((2, *spec.sample), dtype=np.float32))
    with Counted() as counted:
        expected = spec.chunk.normalizer.unnormalize(eager_policy(module, spec)(obs, noise).numpy())
    for name in ("onnxruntime", "reference"):
        policy = ttscompile.load(tmp_path / "compiled", runtime=name)
        found = policy.predict_action(obs, noise=noise, plan="dense")["action_pred"]
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)
        assert len(policy.info.blocks) == 2 and policy.info.K == 12
    assert_agreement_on_random_plans(tmp_path / "compiled", calls=3)


@pytest.mark.slow
def test_a_task_that_is_compiled_in_leaves_no_text_encoder(tmp_path: Path) -> None:
    """Its feature is a constant of the condition piece, for any number of streams."""
    directory = save_policy(tmp_path, num_layers=1)
    module, spec = load(directory)
    obs = observe(spec, streams=1)
    config = dit_config(directory)
    task = (obs[TOKENS], obs[MASK])
    network = Network(config, None, TextConfig(**TEXT))
    baked = with_inputs(network, config, read_processors(directory, config.features), None, task)
    for part in ("encoder.observation_encoder", "denoiser"):
        baked.get_submodule(part).load_state_dict(module.get_submodule(part).state_dict())
    told = replace(spec, observations={STATE: spec.observations[STATE]}, instruction=None)
    pieces = transform(baked.eval(), told).pieces
    assert not any("attention" in node.op or "embedding" in node.op for node in pieces.condition.nodes)
    states = observe(spec, streams=3)[STATE]
    with torch.inference_mode(), Counted() as counted:
        expected = module.encoder(
            {"observation_state": states, **{spec.arguments[key]: obs[key].expand(3, -1) for key in (TOKENS, MASK)}}
        )
    assert_equal_but_for_rounding(baked.encoder({"observation_state": states}), expected, counted.terms)


def test_observations(tmp_path: Path) -> None:
    """What the robot has to give, and what is random where somebody draws it."""
    _, spec = load(save_policy(tmp_path, cameras=("top",)))
    assert spec.observations["observation.images.top"] == ObservationSpec((TO, 3, SIDE, SIDE), bounds=(0, 1))
    low, high = (np.array(each) for each in spec.observations[STATE].bounds)
    assert (low[:-1] < high[:-1]).all() and low[-1] == high[-1]
    assert np.isin(spec.observations[STATE].draw(np.random.default_rng(0))[..., -1], np.float32(low[-1])).all()
    assert spec.observations[TOKENS] == ObservationSpec((9,), dtype="int64", window=False, bounds=(0, 19))
    assert spec.observations[MASK].frames is None and spec.observations[STATE].frames == TO
    assert spec.arguments["observation.images.top"] == "observation_images_top"
    assert (spec.chunk.start, spec.chunk.stop) == (1, 5)
    assert spec.source["format"] == "lerobot"


def test_other_actions_of_the_data_set_are_left_alone(tmp_path: Path) -> None:
    """LeRobot lists all features of a data set that begin with action, and its policies give one of them."""
    directory = save_policy(tmp_path)
    outputs = {key: {"type": "ACTION", "shape": [size]} for key, size in (("action.gripper", 1), ("action", DA))}
    change_json(directory / "config.json", output_features=outputs)
    assert load(directory)[1].chunk.action_dim == DA
    change_json(directory / "config.json", output_features={"action.gripper": outputs["action.gripper"]})
    assert_not_read(directory, "expected one vector, 'action'")


def test_released_encoders_need_no_files(tmp_path: Path) -> None:
    """OpenAI's models are known by name; the weights of this policy are of another network, which is found out."""
    directory = save_policy(tmp_path)
    change_json(directory / "config.json", text_encoder_name="openai/clip-vit-base-patch16")
    assert_not_read(directory, r"do not fit the configuration: missing .*text_encoder")


def test_an_encoder_that_is_named_by_its_whole_path_is_found(tmp_path: Path) -> None:
    """Policies that were trained with a local CLIP name it so. On another machine its copy has the same last part."""
    (tmp_path / "trained").mkdir()
    directory = save_policy(tmp_path / "trained")
    own = tmp_path / "models" / "clip"
    own.parent.mkdir()
    (tmp_path / "trained" / "clip-small").rename(own)
    names = {"vision_encoder_name": str(own), "text_encoder_name": str(own)}
    change_json(directory / "config.json", **names)
    load_checkpoint_policy(directory)
    own.rename(directory / "clip")  # copied beside the weights
    load_checkpoint_policy(directory)
    (directory / "clip" / "config.json").unlink()
    assert_not_read(directory, rf"'{own}' is not on this machine")
    own.mkdir()
    assert_not_read(directory, rf"{own}: expected a config.json of CLIP, .*found a directory without")


def test_encoders_folder(tmp_path: Path) -> None:
    """The encoder's directory is found beside the policy, in it, and in a folder that is named; else there is help."""
    directory = save_policy(tmp_path)
    elsewhere = tmp_path / "elsewhere" / "models"
    elsewhere.mkdir(parents=True)
    (tmp_path / "clip-small").rename(elsewhere / "clip-small")
    assert_not_read(directory, r"'somebody/clip-small' is not on this machine.*--encoders")
    for folder in (elsewhere, elsewhere / "clip-small"):
        load_checkpoint_policy(directory, options=LoadOptions(encoders=folder))
    assert_not_read(
        directory,
        r"tokenizer .*: .*clip-small has none.*merges.txt.*--encoders",
        options=LoadOptions(encoders=elsewhere, task="push"),
    )
    (elsewhere / "clip-small").rename(directory / "clip-small")
    load_checkpoint_policy(directory)
