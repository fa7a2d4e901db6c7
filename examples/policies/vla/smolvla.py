"""lerobot's ``smolvla`` with a language model and a vision transformer of a few layers, and how ``train.py`` trains it.

The loss is that of ``SmolVLAPolicy.forward``, computed as inference does it, the prefix first: so one prefix, which is
most of the work, serves several noises and times.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from environments.fetch_blocks import LENGTH, SIZE
from learner import CHUNK, EXECUTED, PATCH, REPEATS, Learner, Places, Statistics, features, tokenizer
from lerobot.policies.common.vla_utils import make_att_2d_masks
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors
from torch import Tensor, nn
from torch.nn import functional
from transformers import SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

NAME = "language-model"
"""Folder of the language model's configuration and tokenizer, beside the policy's own."""
WIDTH, LAYERS = 96, 4


class SmolVLA(Learner):
    """See ``Learner``."""

    @staticmethod
    def prepare() -> None:
        """Write the language model's files into the working directory."""
        save_language_model(Path(NAME), WIDTH, LAYERS, PATCH)

    def __init__(self, statistics: Statistics) -> None:
        self.policy = SmolVLAPolicy(configuration(LAYERS)).train()
        self.policy.requires_grad_(True)  # lerobot would leave the last layer of the language model as it was drawn
        self.places = Places(WIDTH, WIDTH)
        self.processors = make_smolvla_pre_post_processors(self.policy.config, statistics)
        model: Any = self.policy.model.vlm_with_expert.vlm.model
        model.text_model.layers[-1].input_layernorm.register_forward_pre_hook(self._keep)
        model.connector.register_forward_hook(self._keep_picture)
        self._read: Tensor | None = None
        self._pictures: list[Tensor] = []

    def _keep(self, _: nn.Module, given: tuple[Tensor]) -> None:
        """What the last layer of the language model reads of the state's token, which has heard the instruction."""
        self._read = given[0][:, -1]

    def _keep_picture(self, _: nn.Module, __: tuple[Tensor], tokens: Tensor) -> None:
        self._pictures = [*self._pictures[-1:], tokens.mean(1)]

    def losses(self, batch: dict[str, Tensor], padding: Tensor, offsets: Tensor, grip: Tensor) -> list[Tensor]:
        """Of the flow, and of both of ``Places``."""
        loss = flow_loss(self.policy, batch, padding)
        assert self._read is not None
        return [loss, *self.places(self._read, self._pictures, offsets, grip)]


def flow_loss(policy: SmolVLAPolicy, batch: dict[str, Tensor], padding: Tensor) -> Tensor:
    """Mean squared error of the velocity, over actions that are some."""
    model = policy.model
    actions = policy.prepare_action(batch)
    images, seen = policy.prepare_images(batch)
    tokens, counted = (batch[f"observation.language.{name}"] for name in ("tokens", "attention_mask"))
    embedded, valid, groups = model.embed_prefix(images, seen, tokens, counted, state=policy.prepare_state(batch))
    _, cache = model.vlm_with_expert.forward(
        attention_mask=make_att_2d_masks(valid, groups),
        position_ids=torch.cumsum(valid, dim=1) - 1,
        past_key_values=None,
        inputs_embeds=[embedded, None],
        use_cache=True,
    )
    cache.batch_repeat_interleave(REPEATS)
    actions, valid, padding = (value.repeat_interleave(REPEATS, 0) for value in (actions, valid, padding))
    times, noise = model.sample_time(len(actions), actions.device), torch.randn_like(actions)
    shares = times[:, None, None]
    velocity = model.denoise_step(valid, cache, shares * noise + (1 - shares) * actions, times)
    errors = functional.mse_loss(velocity, noise - actions, reduction="none")[
        :, :, : policy.config.action_feature.shape[0]
    ]
    return (errors.mean(2) * ~padding).sum() / (~padding).sum()


def save_language_model(directory: Path, width: int, layers: int, patch: int) -> None:
    """Write what ``vlm_model_name`` names: configuration, tokenizer with a token a word, and the processor's files."""
    parts = SmolVLMImageProcessor(), tokenizer(), SmolVLMVideoProcessor()
    SmolVLMProcessor(*parts, image_seq_len=(SIZE // patch) ** 2).save_pretrained(directory)
    text: dict[str, Any] = {
        "model_type": "llama",
        "hidden_size": width,
        "intermediate_size": 3 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": width // 4,
        "vocab_size": 64,
        "pad_token_id": 0,
        "bos_token_id": 1,
        "eos_token_id": 3,
        "rms_norm_eps": 1e-5,
        "tie_word_embeddings": False,
    }
    vision: dict[str, Any] = {
        "model_type": "smolvlm_vision",
        "hidden_size": width,
        "intermediate_size": 3 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": 4,
        "image_size": SIZE,
        "patch_size": patch,
    }
    config = {
        "model_type": "smolvlm",
        "scale_factor": 1,
        "image_token_id": 5,
        "pad_token_id": 0,
        "tie_word_embeddings": False,
        "text_config": text,
        "vision_config": vision,
    }
    (directory / "config.json").write_text(json.dumps(config, indent=1))


def configuration(layers: int) -> SmolVLAConfig:
    """Of the policy; ``NAME`` has to be in the working directory when it is built."""
    return SmolVLAConfig(
        **features(),
        device="cpu",
        push_to_hub=False,
        chunk_size=CHUNK,
        n_action_steps=EXECUTED,
        max_state_dim=8,
        max_action_dim=8,
        resize_imgs_with_padding=(SIZE, SIZE),
        tokenizer_max_length=LENGTH,
        pad_language_to="max_length",
        num_steps=10,
        freeze_vision_encoder=False,
        train_expert_only=False,
        vlm_model_name=NAME,
        num_vlm_layers=layers,
        self_attn_every_n_layers=2,
        expert_width_multiplier=0.75,
    )
