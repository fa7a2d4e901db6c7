"""lerobot's ``multi_task_dit`` with a CLIP of a few layers, DDPM of 100 steps, and how ``train.py`` trains it.

lerobot takes the text encoder as CLIP's training left it. So that of this CLIP learns which task a text is about before
the policy is made; its image encoder is trained with the policy.
"""

from __future__ import annotations

from pathlib import Path

import torch
from environments.fetch_blocks import COLOURS, KINDS, LENGTH, SEEN, SIZE, TASKS, instruction
from learner import CHUNK, EXECUTED, PATCH, REPEATS, Learner, Places, Statistics, features, tokenizer
from lerobot.configs import NormalizationMode
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
from lerobot.policies.multi_task_dit.processor_multi_task_dit import make_multi_task_dit_pre_post_processors
from torch import Tensor, nn
from torch.nn import functional
from transformers import CLIPConfig, CLIPModel, PreTrainedTokenizerFast

NAME = "clip-blocks"
"""Folder of CLIP's configuration, tokenizer and first weights, beside the policy's own."""
WIDTH, LAYERS, TEXT = 96, 4, 64
TEXT_UPDATES = 300


class MultiTaskDiT(Learner):
    """See ``Learner``."""

    @staticmethod
    def prepare() -> None:
        """Write CLIP into the working directory, its text encoder trained."""
        save_clip(Path(NAME))

    def __init__(self, statistics: Statistics) -> None:
        self.policy = MultiTaskDiTPolicy(configuration()).train()
        encoder = self.policy.observation_encoder
        self.places = Places(encoder.conditioning_dim, WIDTH)
        self.processors = make_multi_task_dit_pre_post_processors(self.policy.config, statistics)
        encoder.vision_encoder.register_forward_hook(self._keep)
        self._pictures = torch.empty(0)

    def _keep(self, _: nn.Module, __: tuple[Tensor], made: Tensor) -> None:
        self._pictures = made.flatten(1).unflatten(0, (-1, 2))

    def losses(self, batch: dict[str, Tensor], padding: Tensor, offsets: Tensor, grip: Tensor) -> list[Tensor]:
        """Of the noise that was added, and of both of ``Places``."""
        seen = self.policy.observation_encoder.encode(self.policy._prepare_batch(of_one_frame(batch)))
        repeated = {"action": batch["action"], "action_is_pad": padding}
        repeated = {name: value.repeat_interleave(REPEATS, 0) for name, value in repeated.items()}
        conditions = seen.repeat_interleave(REPEATS, 0)
        loss = self.policy.objective.compute_loss(self.policy.noise_predictor, repeated, conditions)
        return [loss, *self.places(seen, list(self._pictures.unbind(1)), offsets, grip)]


def of_one_frame(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """A batch ``[B, ...]`` as windows of one frame, which lerobot tells by the axes of the state alone."""
    return batch | {"observation.state": batch["observation.state"][:, None]}


def save_clip(directory: Path) -> None:
    """Write what ``text_encoder_name`` and ``vision_encoder_name`` name."""
    words = tokenizer()
    words.save_pretrained(directory)
    text = {
        "hidden_size": TEXT,
        "intermediate_size": 4 * TEXT,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "max_position_embeddings": LENGTH,
        "vocab_size": len(words),
        "bos_token_id": words.bos_token_id,
        "eos_token_id": words.pad_token_id,  # the first of them ends a text, and is where CLIP pools
        "pad_token_id": words.pad_token_id,
    }
    vision = {
        "image_size": SIZE,
        "patch_size": PATCH,
        "hidden_size": WIDTH,
        "intermediate_size": 4 * WIDTH,
        "num_hidden_layers": LAYERS,
        "num_attention_heads": 4,
    }
    clip = CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=TEXT))
    learn_words(clip.text_model, words)
    clip.save_pretrained(directory)


def learn_words(text_model: nn.Module, words: PreTrainedTokenizerFast) -> None:
    """Teach a text encoder which kind of task, which direction and which colour all seen phrasings are about."""
    texts, kinds, colours = [], [], []
    for task in TASKS:
        kind, _, colour = task.rpartition(" ")
        for phrasing in range(len(SEEN[task.split()[0]])):
            texts.append(instruction(task, phrasing))
            kinds.append(KINDS.index(kind))
            colours.append(list(COLOURS).index(colour))
    given = words(texts, padding="max_length", max_length=LENGTH, return_tensors="pt")
    told = nn.Linear(TEXT, len(KINDS) + len(COLOURS))
    optimizer = torch.optim.AdamW([*text_model.parameters(), *told.parameters()], 1e-3)
    text_model.train()
    for _ in range(TEXT_UPDATES):
        guessed = told(text_model(given["input_ids"], given["attention_mask"]).pooler_output)
        guessed_kinds, guessed_colours = guessed.split([len(KINDS), len(COLOURS)], 1)
        wrong = functional.cross_entropy(guessed_kinds, torch.tensor(kinds))
        wrong = wrong + functional.cross_entropy(guessed_colours, torch.tensor(colours))
        optimizer.zero_grad()
        wrong.backward()
        optimizer.step()
    print(f"cross entropy of words: {wrong.item():.4f}", flush=True)


def configuration() -> MultiTaskDiTConfig:
    """Of the policy; ``NAME`` has to be in the working directory when it is built."""
    return MultiTaskDiTConfig(
        **features(),
        device="cpu",
        push_to_hub=False,
        n_obs_steps=1,
        horizon=CHUNK,
        n_action_steps=EXECUTED,
        objective="diffusion",
        noise_scheduler_type="DDPM",
        num_train_timesteps=100,
        hidden_dim=128,
        num_layers=4,
        num_heads=4,
        dropout=0.0,
        timestep_embed_dim=64,
        vision_encoder_name=NAME,
        text_encoder_name=NAME,
        image_crop_shape=None,
        tokenizer_max_length=LENGTH,
        do_mask_loss_for_padding=True,
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MIN_MAX,
        },
    )
