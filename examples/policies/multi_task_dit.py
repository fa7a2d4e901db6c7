"""Training LeRobot's ``multi_task_dit`` on the demonstrations of Push-T with lerobot's own code, on a CPU.

What both recipes share: tiny CLIP encoders from a configuration with random weights, the loop, and the averaged weights
saved as lerobot saves a policy. lerobot has to be importable; none of its code is here.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
from lerobot.policies.multi_task_dit.processor_multi_task_dit import make_multi_task_dit_pre_post_processors
from lerobot_training import average, saving, statistics
from torch.optim.swa_utils import AveragedModel

TASK = "push the T onto its place"
"""The instruction of every episode: the policy wants one. Its encoder stays random, its projection is learned."""

TOKENS = 8
"""Length of the tokenised instruction; its words are single tokens."""

ENCODER = "clip-tiny"

WINDOW, HORIZON, EXECUTED, STEPS = 2, 10, 8, 10
"""Frames that are observed, actions that are predicted and executed, integration steps."""

STATE = "observation.state"


def configuration(inputs: dict[str, PolicyFeature]) -> MultiTaskDiTConfig:
    """4 layers of width 128, and Euler's method, for a policy of two actions that observes these features."""
    return MultiTaskDiTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        device="cpu",
        push_to_hub=False,
        n_obs_steps=WINDOW,
        horizon=HORIZON,
        n_action_steps=EXECUTED,
        objective="flow_matching",
        num_integration_steps=STEPS,
        hidden_dim=128,
        num_layers=4,
        num_heads=4,
        dropout=0.0,
        timestep_embed_dim=64,
        vision_encoder_name=ENCODER,
        text_encoder_name=ENCODER,
        image_crop_shape=None,
        tokenizer_max_length=TOKENS,
    )


def make_encoder(folder: Path, vision: Mapping[str, int], seed: int) -> None:
    """A tiny CLIP with random weights, and a tokenizer of letters and of the words of ``TASK``.

    Args:
        folder: is made.
        vision: of ``CLIPVisionConfig``.
        seed: of the weights.
    """
    from transformers import CLIPConfig, CLIPModel

    folder.mkdir(parents=True, exist_ok=True)
    symbols = [chr(c) for c in range(ord("!"), ord("~") + 1)]
    merges: list[str] = []
    vocabulary = symbols + [f"{symbol}</w>" for symbol in symbols]
    for word in dict.fromkeys(TASK.lower().split()):
        left = word[0]
        for i, letter in enumerate(word[1:], start=1):
            right = letter if i < len(word) - 1 else f"{letter}</w>"
            if f"{left} {right}" not in merges:
                merges.append(f"{left} {right}")
                vocabulary.append(left + right)
            left += right
    vocabulary = [*dict.fromkeys(vocabulary), "<|startoftext|>", "<|endoftext|>"]
    end = len(vocabulary) - 1
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *merges, ""]))
    (folder / "tokenizer_config.json").write_text(
        json.dumps(
            {
                "tokenizer_class": "CLIPTokenizer",
                "bos_token": "<|startoftext|>",
                "eos_token": "<|endoftext|>",
                "pad_token": "<|endoftext|>",
                "unk_token": "<|endoftext|>",
                "model_max_length": TOKENS,
            }
        )
    )
    text = {
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "max_position_embeddings": TOKENS,
        "vocab_size": len(vocabulary),
        "bos_token_id": end - 1,
        "eos_token_id": end,
        "pad_token_id": end,
    }
    torch.manual_seed(seed)
    CLIPModel(CLIPConfig(text_config=text, vision_config=dict(vision), projection_dim=16)).save_pretrained(folder)


def picture_statistics(pictures: np.ndarray) -> dict[str, torch.Tensor]:
    """The same of pictures uint8 ``[N, H, W, 3]`` as 0..1, a number a channel: ``[3, 1, 1]`` each."""
    some = pictures[:: max(1, len(pictures) // 2000)].reshape(-1, 3) / 255
    return {name: value.reshape(3, 1, 1) for name, value in statistics(some).items()}


class Policy:
    """lerobot's policy with its processors, trained for a number of steps.

    Attributes:
        network: lerobot's module.
        averaged: the average of its weights that is evaluated and saved.
    """

    def __init__(self, config: MultiTaskDiTConfig, stats: dict[str, dict[str, torch.Tensor]], seed: int) -> None:
        torch.manual_seed(seed)
        self.network = MultiTaskDiTPolicy(config)
        self.before, self.after = make_multi_task_dit_pre_post_processors(config, stats)
        self.average_from_here()

    @property
    def eyes(self) -> torch.nn.Module:
        """The image encoder."""
        return self.network.observation_encoder.vision_encoder

    def average_from_here(self) -> None:
        """Forget what was averaged."""
        self.averaged = AveragedModel(self.network, avg_fn=average)

    @torch.no_grad()
    def look(self, frames: torch.Tensor) -> torch.Tensor:
        """What the image encoder makes of prepared pictures ``[N, 3, H, W]``: ``[N, width, 1, 1]``."""
        made: torch.Tensor = self.eyes(frames)
        return made

    @contextmanager
    def looked(self) -> Iterator[None]:
        """Meanwhile batches have what ``look`` made of pictures in their place, and the image encoder stays so."""
        self.eyes.requires_grad_(False)
        self.eyes.forward = _identity
        try:
            yield
        finally:
            del self.eyes.forward
            self.eyes.requires_grad_(True)
            self.network.load_state_dict(self.averaged.module.state_dict())

    def prepare(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Raw observations and actions ``[N, ...]`` as the network wants them, with the task: lerobot's processor."""
        count, done = len(batch["action"]), self.before({**batch, "task": [TASK]})
        tensors = {name: value for name, value in done.items() if isinstance(value, torch.Tensor)}
        return {name: value.expand(count, -1) if ".language." in name else value for name, value in tensors.items()}

    def train(
        self,
        batches: Iterator[dict[str, torch.Tensor]],
        steps: int,
        rate: float,
        save: Callable[[], None],
        every: int = 500,
    ) -> None:
        """Minimise lerobot's loss with AdamW: a linear warm-up, then a cosine to zero.

        Args:
            batches: prepared.
            steps: of the optimiser.
            rate: learning rate at its highest.
            save: called every so many steps, and at the end.
            every: see ``save``.
        """
        others, vision = self.network.get_optim_params()
        groups = [{**others, "lr": rate}, {**vision, "lr": rate * self.network.config.vision_encoder_lr_multiplier}]
        optimizer = torch.optim.AdamW(groups, betas=(0.95, 0.999), weight_decay=1e-4)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda k: min((k + 1) / (steps / 15), 0.5 + 0.5 * math.cos(math.pi * min(1.0, k / steps)))
        )
        self.network.train()
        self.average_from_here()
        begun, recent = time.monotonic(), 0.0
        for step in range(1, steps + 1):
            loss, _ = self.network.forward(next(batches))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            self.averaged.update_parameters(self.network)
            recent += loss.item()
            if step % 100 == 0:
                print(f"step {step} loss {recent / 100:.4f} minutes {(time.monotonic() - begun) / 60:.1f}", flush=True)
                recent = 0.0
            if step % every == 0 or step == steps:
                save()

    def save(self, folder: Path, encoder: Path) -> None:
        """The averaged policy as lerobot saves one, its weights in half precision, beside its encoder's configuration.

        The folder appears at once: there is never half a policy in it.
        """
        network: Any = self.averaged.module
        with saving(folder) as beside:
            for each in (network, self.before, self.after):
                each.save_pretrained(beside)
            (beside / ENCODER).mkdir()
            for file in ("config.json", "vocab.json", "merges.txt", "tokenizer_config.json"):
                shutil.copy(encoder / file, beside / ENCODER)


def _identity(frames: torch.Tensor) -> torch.Tensor:
    return frames
