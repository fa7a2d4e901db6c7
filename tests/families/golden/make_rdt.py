"""Run RDT's runner on seeded weights, and write what it gives: ``rdt.npz``, and of pictures ``rdt_pictures.npz``.

Not run by the tests. Needs a clone of thu-ml/RoboticsDiffusionTransformer (deb71d8), and timm 1.0.3::

    pip install --no-deps --target timm-1.0.3 timm==1.0.3
    PYTHONPATH=timm-1.0.3 python -m tests.families.golden.make_rdt path/to/RoboticsDiffusionTransformer
"""

import importlib
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import transformers
from PIL import Image

from tests.policies import rdts

from .originals import Arrays, absent, generator, noise_from, normal, seeded, timm

SEED, BATCH, HORIZON, ACTIONS = 7, 2, 6, 5
LANGUAGE, IMAGE, HZ = 12, 10, (25.0, 10.0)
"""Width of the tokens, and the rate of control of each sample."""


def run(folder: Path) -> dict[str, Arrays]:
    """What is made of tokens, and what of pictures."""
    timm("1.0.3")
    sys.path.insert(0, str(folder))
    return {"rdt": _of_tokens(), "rdt_pictures": _of_pictures()}


def _runner(actions: int, horizon: int, image: int, length: int, seed: int) -> Any:
    """Small, with random weights; tokens of pictures are so wide, and so many."""
    runner = importlib.import_module("models.rdt_runner").RDTRunner(
        action_dim=actions,
        pred_horizon=horizon,
        config={
            "rdt": {"hidden_size": 32, "depth": 4, "num_heads": 4},
            "lang_adaptor": "mlp2x_gelu",
            "img_adaptor": "mlp2x_gelu",
            "state_adaptor": "mlp3x_gelu",
            "noise_scheduler": {
                "type": "ddpm",
                "num_train_timesteps": 1000,
                "num_inference_timesteps": 5,
                "beta_schedule": "squaredcos_cap_v2",
                "prediction_type": "sample",
                "clip_sample": False,
            },
        },
        lang_token_dim=LANGUAGE,
        img_token_dim=image,
        state_token_dim=actions,
        max_lang_cond_len=9,
        img_cond_len=length,
        dtype=torch.float32,
    )
    seeded(runner, seed)
    return runner


def _of_tokens() -> Arrays:
    """A prediction at two timesteps, and the actions of ``predict_action``; language of two lengths."""
    runner = _runner(ACTIONS, HORIZON, IMAGE, 8, SEED)
    draw = normal(8)
    language, image, state = draw(BATCH, 7, LANGUAGE), draw(BATCH, 8, IMAGE), draw(BATCH, 1, ACTIONS)
    language_mask = np.ones((BATCH, 7), bool)
    language_mask[1, 5:] = False
    action_mask = np.ones((BATCH, 1, ACTIONS), np.float32)
    action_mask[:, :, 4] = 0
    noise, timesteps, frequency = draw(BATCH, HORIZON, ACTIONS), np.array([999, 400]), np.array(HZ, np.float32)

    mask, rate, valid = torch.from_numpy(language_mask), torch.from_numpy(frequency), torch.from_numpy(action_mask)
    placed = torch.cat([torch.from_numpy(state), valid], 2)
    words, patches, start = runner.adapt_conditions(torch.from_numpy(language), torch.from_numpy(image), placed)
    tokens = runner.state_adaptor(torch.cat([torch.from_numpy(noise), valid.expand(-1, HORIZON, -1)], 2))
    tokens = torch.cat([start, tokens], 1)
    prediction = runner.model(tokens, rate, torch.from_numpy(timesteps), words, patches, lang_mask=mask)
    with noise_from(noise):
        actions = runner.predict_action(
            torch.from_numpy(language), mask, torch.from_numpy(image), torch.from_numpy(state), valid, rate
        )
    return {
        "seed": SEED,
        "lang_tokens": language,
        "lang_attn_mask": language_mask,
        "img_tokens": image,
        "state_tokens": state,
        "action_mask": action_mask,
        "ctrl_freqs": frequency[:, None],  # an observation has an axis besides the batch
        "noise": noise,
        "timesteps": timesteps,
        "prediction": prediction.numpy(),
        "actions": actions.numpy(),
    }


def _of_pictures() -> Arrays:
    """What ``step`` gives, with all cameras and without one: the actions, and what ``predict_action`` is told."""
    # The processor as it was, which resizes with Pillow; today's of this name needs torchvision.
    transformers.__dict__["SiglipImageProcessor"] = transformers.SiglipImageProcessorPil
    importlib.import_module("models.multimodal_encoder.siglip_encoder")
    importlib.import_module("models.multimodal_encoder.t5_encoder")
    absent("torchvision")
    robot = importlib.import_module("scripts.agilex_model").RoboticDiffusionTransformerModel
    length = rdts.CHANGES["img_cond_len"]
    policy = object.__new__(robot)
    policy.policy = _runner(rdts.ACTIONS, rdts.HORIZON, rdts.VISION["hidden_size"], length, rdts.SEED)
    policy.vision_model = _tower()
    policy.image_processor, policy.image_size = policy.vision_model.image_processor, None
    policy.args = {"model": {"state_token_dim": rdts.ACTIONS}, "dataset": {"image_aspect_ratio": "pad"}}
    policy.device, policy.dtype, policy.control_frequency = "cpu", torch.float32, 25
    policy.policy.predict_action = kept = _Kept(policy.policy.predict_action)

    draw = normal(rdts.SEED)
    noise = draw(rdts.STREAMS, rdts.HORIZON, rdts.ACTIONS)
    words, joints = draw(rdts.STREAMS, rdts.WORDS, LANGUAGE), draw(rdts.STREAMS, 1, 14)
    found: Arrays = {"noise": noise, "lang_tokens": words}
    for name, without in (("actions", ""), ("actions_without", rdts.CAMERAS[-1])):
        kept.calls.clear()
        for stream in range(rdts.STREAMS):
            given = [(frame, camera) for frame in range(rdts.FRAMES) for camera in rdts.CAMERAS]
            shown = [None if camera == without else rdts.shown(stream, frame, camera) for frame, camera in given]
            pictures = [None if one is None else Image.fromarray(one) for one in shown]
            own = (torch.from_numpy(each[stream : stream + 1]) for each in (joints[:, 0], words))
            with noise_from(noise[stream : stream + 1]):
                policy.step(next(own), pictures, next(own))
        found[name] = torch.cat([actions for _, actions in kept.calls]).numpy()
    for key in ("state_tokens", "action_mask", "ctrl_freqs"):
        found[key] = torch.cat([told[key] for told, _ in kept.calls]).float().numpy()
    found["ctrl_freqs"] = found["ctrl_freqs"][:, None]
    return found


def _tower() -> Any:
    """``SiglipVisionTower`` of a small SigLIP, as transformers saves one."""
    text = {"hidden_size": 8, "intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1}
    model = transformers.SiglipModel(transformers.SiglipConfig(text_config=text, vision_config=rdts.VISION))
    seeded(model.vision_model, rdts.SEED, "head")
    half = [0.5, 0.5, 0.5]
    size = {"height": rdts.SIDE, "width": rdts.SIDE}
    with TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        transformers.SiglipImageProcessorPil(size=size, image_mean=half, image_std=half).save_pretrained(folder)
        tower = importlib.import_module("models.multimodal_encoder.siglip_encoder").SiglipVisionTower(folder, None)
    return tower


class _Kept:
    """Calls a function, and keeps what it was given and gave."""

    def __init__(self, function: Any) -> None:
        self._function = function
        self.calls: list[tuple[dict[str, Any], Any]] = []

    def __call__(self, **given: Any) -> Any:
        made = self._function(**given)
        self.calls.append((given, made))
        return made


main = generator(run, "deb71d8", "models", "configs/state_vec.py", "scripts/agilex_model.py")

if __name__ == "__main__":
    main()
