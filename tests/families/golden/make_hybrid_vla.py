"""Run HybridVLA's diffusion on seeded weights, and write what it gives: ``hybrid_vla.npz``.

Not run by the tests. Needs a clone of PKU-HMI-Lab/Hybrid-VLA (64ed480), and timm 0.9.10::

    pip install --no-deps --target timm-0.9.10 timm==0.9.10
    PYTHONPATH=timm-0.9.10 python -m tests.families.golden.make_hybrid_vla path/to/Hybrid-VLA
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from tests.policies import hybrid_vlas as tiny

from .originals import Arrays, absent, generator, noise_from, normal, package, timm

PATCHES, SEEN = 4, 6
"""Of a picture, and numbers of each."""
WORDS = ([1, 5, 9, 14], [1, 8])
"""Of two instructions, of which the second is shorter."""


class _Images(nn.Module):
    """In place of DINOv2 and SigLIP: features pass through it."""

    embed_dim = SEEN

    def image_transform(self, image: Any) -> dict[str, Tensor]:
        return {"dino": torch.from_numpy(image.features)}

    def forward(self, pixels: dict[str, Tensor]) -> Tensor:
        return pixels["dino"]


class _Picture(SimpleNamespace):
    """In place of one of Pillow's, of which the original asks whether it is there."""


class _Tokenizer:
    """In place of Llama's: a text is the number of one of ``WORDS``."""

    def __call__(self, text: str, **settings: Any) -> SimpleNamespace:
        return SimpleNamespace(input_ids=torch.tensor([WORDS[int(text[-2])]]))

    def encode(self, text: str, add_special_tokens: bool) -> list[int]:
        return [3]


class _Prompt:
    def __init__(self, *settings: Any, **more: Any) -> None:
        self.text = ""

    def add_turn(self, role: str, message: str) -> None:
        self.text = message

    def get_prompt(self) -> str:
        return self.text


class _Llama(nn.Module):
    """The original's around a Llama of transformers; keys and values are tuples, as older versions took them."""

    half_precision_dtype, prompt_builder_fn = torch.bfloat16, _Prompt

    def __init__(self, sizes: Any) -> None:
        super().__init__()
        turns: dict[str, Any] = {"rope_theta": 10000.0}
        config = LlamaConfig(
            vocab_size=32064,
            hidden_size=sizes.width,
            intermediate_size=sizes.hidden,
            num_hidden_layers=sizes.layers,
            num_attention_heads=sizes.width // 128,
            num_key_value_heads=sizes.groups,
            rms_norm_eps=1e-5,
            **turns,
        )
        self.llm, self.tokenizer, self.embed_dim = LlamaForCausalLM(config), _Tokenizer(), sizes.width

    def embed_input_ids(self, ids: Tensor) -> Tensor:
        return self.llm.get_input_embeddings()(ids)

    def forward(
        self, inputs_embeds: Tensor, past_key_values: Any = None, input_ids: Any = None, **more: Any
    ) -> SimpleNamespace:
        cache = DynamicCache()
        for index, (keys, values) in enumerate(past_key_values or ()):
            cache.update(keys, values, index)
        made = self.llm(inputs_embeds=inputs_embeds, past_key_values=cache, use_cache=True, output_hidden_states=True)
        kept = tuple((layer.keys, layer.values) for layer in made.past_key_values.layers)
        return SimpleNamespace(hidden_states=made.hidden_states, past_key_values=kept)


class _VLM(nn.Module):
    """What ``PrismaticVLM`` is derived from, without the functions that generate words."""

    def __init__(self, family: str, model: str, images: nn.Module, llama: nn.Module, **settings: Any) -> None:
        super().__init__()
        self.model_family, self.model_id = family, model
        self.vision_backbone, self.llm_backbone = images, llama
        self.enable_mixed_precision_training, self.device = False, torch.device("cpu")


def originals(folder: Path) -> tuple[Any, Any]:
    """Its modules, without what they import of tokenizers, trackers and data sets."""
    timm("0.9.10")
    sys.path.insert(0, str(folder))
    absent("overwatch", "vla", "models.backbones", "models.backbones.llm", "models.backbones.vision")
    absent("models.backbones.llm.prompting")
    for name in ("models", "models.vlms", "models.vlas", "util"):
        package(name, folder / name.replace(".", "/"))
    base = ModuleType("models.vlms.base_vlm")
    base.__dict__["VLM"] = _VLM
    sys.modules[base.__name__] = base
    for inner in ("util.diffusion_utils", "util.nn_utils"):
        sys.modules["util"].__dict__.update(vars(importlib.import_module(inner)))
    prismatic = importlib.import_module("models.vlms.prismatic")
    sys.modules["models.vlms"].__dict__["PrismaticVLM"] = prismatic.PrismaticVLM
    hybrid: Any = importlib.import_module("models.vlas.hybridvla")
    hybrid.LlamaTokenizerFast = _Tokenizer
    return prismatic, hybrid


def run(folder: Path) -> dict[str, Arrays]:
    """Predictions of three actions at two timesteps, and the actions of ``predict_action``, DDIM 4 of 100 steps."""
    prismatic, hybrid = originals(folder)
    count = tiny.SIZES.actions
    torch.manual_seed(0)
    vlm = prismatic.PrismaticVLM(
        "prism-dinosiglip-224px+7b",
        _Images(),
        _Llama(tiny.SIZES),
        arch_specifier="linear",
        action_dim=count,
        token_size=tiny.SIZES.width,
        use_diff=True,
    )
    named = {f"llm_backbone.{name}" if name.startswith("llm.") else name: v for name, v in tiny.weights().items()}
    left = vlm.load_state_dict(named, strict=False)
    assert not left.unexpected_keys
    read = ("llm_backbone.llm.model.layers", "llm_backbone.llm.model.norm", *tiny.PARTS)
    assert not [name for name in left.missing_keys if name.startswith(read)], left.missing_keys
    model = hybrid.HybridVLA(
        vlm, None, action_dim=count, future_action_window_size=0, norm_stats=tiny.STATISTICS, use_diff=True
    ).eval()
    draw = normal(tiny.SEED + 1)
    states, features = tiny.states(), draw(tiny.STREAMS, 1, PATCHES, SEEN)
    # So that few actions are clipped.
    one, several = draw(tiny.STREAMS, 1, count) * np.float32(0.2), draw(tiny.STREAMS, 3, count)
    prefixes, predictions, actions = [], [], []
    for stream in range(tiny.STREAMS):
        image = _Picture(features=features[stream, 0])
        with noise_from(one[stream : stream + 1]):
            made = model.predict_action(
                front_image=image,
                instruction=f"{stream}",
                use_ddim=True,
                num_ddim_steps=4,
                cur_robot_state=states[stream].astype(np.float64),
                predict_mode="diff",
            )
        actions.append(made)
        ids = torch.tensor([[*WORDS[stream], 29871, 32001]])
        pixels = {"front_dino": torch.from_numpy(features[stream])}
        prefixes.append(vlm._prepare_multimodal_inputs(ids, pixels)[0][0].numpy())
        vlm.future_action_window_size = 2
        scaled = torch.from_numpy(tiny.scaled(states[stream]))[None, None]
        given = {"input_ids": ids, "pixel_values": pixels, "proprio": scaled, "x": torch.from_numpy(several[[stream]])}
        predictions.append(vlm(t=torch.tensor([(90, 30)[stream]]), **given)[1].numpy())
        vlm.future_action_window_size = 0
    longest = max(map(len, prefixes))
    padded = [np.pad(each, ((longest - len(each), 0), (0, 0))) for each in prefixes]
    return {
        "hybrid_vla": {
            "prefix": np.stack(padded),
            "lengths": np.array([len(each) for each in prefixes]),
            "noise": one,
            "several": several,
            "prediction": np.concatenate(predictions),
            "actions": np.stack(actions).astype(np.float32),
        }
    }


main = generator(run, "64ed480", "models", "util")

if __name__ == "__main__":
    main()
