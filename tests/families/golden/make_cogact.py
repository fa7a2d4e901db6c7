"""Run CogACT's action model on seeded weights, and write what it gives: ``cogact.npz``, ``cogact_robot.npz``.

The second is of its ``predict_action_batch``, statistics and all, around a language model that gives random features.

Not run by the tests. Needs a clone of microsoft/CogACT (b174a1b), and timm 0.9.10::

    pip install --no-deps --target timm-0.9.10 timm==0.9.10
    PYTHONPATH=timm-0.9.10 python -m tests.families.golden.make_cogact path/to/CogACT
"""

import importlib
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import nn

from .originals import Arrays, absent, generator, noise_from, normal, package, seeded, timm

SEED, BATCH, HORIZON, ACTIONS, COGNITION, GUIDANCE = 14, 2, 6, 5, 18, 1.5
ROBOT_SEED, ROBOT_ACTIONS, ROBOT_COGNITION, SMALL = 15, 7, 4096, np.float32(0.1)
"""The original asserts the two sizes. With small noise and a small last layer most actions are in -1..1."""
LOW, HIGH = [-0.5, -1.0, 0.0, -2.0, 0.25, 0.5, 0.0], [0.5, 3.0, 0.5, -1.0, 0.25, 1.0, 1.0]
MASK = [True, True, True, True, True, True, False]


def run(folder: Path) -> dict[str, Arrays]:
    """A guided prediction at two timesteps, and the actions of the guided DDIM loop, 10 of 100 steps."""
    timm("0.9.10")
    sys.path.insert(0, str(folder))
    from action_model import action_model

    tiny = partial(action_model.DiT, depth=2, hidden_size=24, num_heads=3)
    with patch.dict(action_model.DiT_models, {"tiny": tiny}):
        model = action_model.ActionModel(COGNITION, "tiny", ACTIONS, HORIZON - 1, 0)
    # The original builds it 4096 wide whatever the width of the token, and reads it from the checkpoint.
    model.net.z_embedder.uncondition = nn.Parameter(torch.zeros(1, COGNITION))
    seeded(model.net, SEED)
    draw = normal(114)
    cognition, noise = draw(BATCH, 1, COGNITION), draw(BATCH, HORIZON, ACTIONS)
    none = model.net.z_embedder.uncondition[None].expand(BATCH, 1, -1)
    both = torch.cat([torch.from_numpy(cognition), none], 0)
    sample = torch.cat([torch.from_numpy(noise)] * 2, 0)
    timesteps = torch.tensor([90, 30])
    predict = model.net.forward_with_cfg
    prediction = predict(sample, torch.cat([timesteps, timesteps]), both, GUIDANCE)
    actions = model.create_ddim(10).ddim_sample_loop(
        predict,
        sample.shape,
        sample,
        clip_denoised=False,
        model_kwargs={"z": both, "cfg_scale": GUIDANCE},
        progress=False,
        device="cpu",
        eta=0.0,
    )
    return {
        "cogact_robot": robot(tiny, folder),
        "cogact": {
            "seed": SEED,
            "cognition": cognition,
            "noise": noise,
            "timesteps": timesteps.numpy(),
            "prediction": prediction[:BATCH].numpy(),
            "actions": actions[:BATCH].numpy(),
        },
    }


class _Base:
    """What ``PrismaticVLM`` is derived from: its ``generate`` gives random features in place of a language model's."""

    features: torch.Tensor

    def generate(self, input_ids: torch.Tensor, **_: Any) -> SimpleNamespace:
        """Hidden states ``[B, L, E]``, of which the last is read."""
        hidden = self.features[:, None].expand(-1, input_ids.shape[1], -1)
        return SimpleNamespace(hidden_states=[[hidden]])


class _Tokenizer:
    """Gives one token, whatever it is told."""

    model_max_length, pad_token_id = 8, 0

    def __call__(self, text: str, **_: Any) -> SimpleNamespace:
        """As transformers' give it."""
        return SimpleNamespace(input_ids=torch.ones(1, 1, dtype=torch.long))


class _Prompt:
    def add_turn(self, **_: Any) -> None:
        """Nothing is kept."""

    def get_prompt(self) -> str:
        """Nothing was."""
        return ""


def robot(tiny: Any, folder: Path) -> Arrays:
    """The robot's actions, of ``predict_action_batch`` by DDIM in 10 steps."""
    names = ("models.backbones.llm", "models.backbones.llm.prompting", "models.backbones.vision", "models.vlms")
    absent("prismatic", *(f"prismatic.{name}" for name in (*names, "models", "models.vlms.base_vlm", "overwatch")))
    absent("prismatic.util", "prismatic.util.nn_utils", "transformers", "transformers.modeling_outputs")
    prismatic = sys.modules["prismatic.models.vlms.prismatic"] = ModuleType("prismatic.models.vlms.prismatic")
    vlm_class: Any = type("PrismaticVLM", (_Base,), {})
    prismatic.PrismaticVLM = vlm_class  # type: ignore[attr-defined]
    package("vla", folder / "vla")
    from action_model import action_model

    cogactvla: Any = importlib.import_module("vla.cogactvla")

    cogactvla.LlamaTokenizerFast = _Tokenizer
    whole = cogactvla.CogACT.__new__(cogactvla.CogACT)
    nn.Module.__init__(whole)
    with patch.dict(action_model.DiT_models, {"tiny": tiny}):
        whole.action_model = action_model.ActionModel(ROBOT_COGNITION, "tiny", ROBOT_ACTIONS, HORIZON - 1, 0)
    seeded(whole.action_model.net, ROBOT_SEED)
    whole.action_model.net.final_layer.linear.weight *= SMALL
    whole.future_action_window_size = HORIZON - 1
    whole.norm_stats = {"own": {"action": {"q01": LOW, "q99": HIGH, "mask": MASK}}}
    draw = normal(ROBOT_SEED)
    vlm = whole.vlm = vlm_class()
    vlm.features, noise = torch.from_numpy(draw(BATCH, ROBOT_COGNITION)), SMALL * draw(BATCH, HORIZON, ROBOT_ACTIONS)
    featurizer = SimpleNamespace(patch_embed=SimpleNamespace(num_patches=0))
    vlm.vision_backbone = SimpleNamespace(image_transform=lambda image: torch.zeros(1), featurizer=featurizer)
    vlm.llm_backbone = SimpleNamespace(tokenizer=_Tokenizer(), half_precision_dtype=torch.bfloat16)
    vlm.get_prompt_builder, vlm.device, vlm.enable_mixed_precision_training = _Prompt, "cpu", False
    with noise_from(noise):
        actions, normalized = whole.predict_action_batch([None] * BATCH, [""] * BATCH, use_ddim=True)
    statistics = {"q01": np.array(LOW), "q99": np.array(HIGH), "mask": np.array(MASK)}
    return {"seed": ROBOT_SEED, "noise": noise, "actions": actions, "normalized": normalized, **statistics}


main = generator(run, "b174a1b", "action_model", "vla")

if __name__ == "__main__":
    main()
