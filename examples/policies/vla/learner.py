"""What ``train.py`` asks of a policy, and what all of them have: features, tokenizer, and what helps them to see."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeAlias

import torch
from environments.fetch_blocks import BEFORE, SIZE, WORDS
from lerobot.configs import FeatureType, PolicyFeature
from tokenizers import Tokenizer, models, pre_tokenizers
from torch import Tensor, nn
from torch.nn import functional
from transformers import PreTrainedTokenizerFast

Statistics: TypeAlias = dict[str, dict[str, Tensor]]

PATCH, CHUNK, EXECUTED = 12, 16, 8
"""Pixels of a patch; actions of a chunk, and how many of them are executed."""
REPEATS = 4
"""Noises and times for one observation."""
UNIT, MIDDLE = 0.1, (1.31, 0.75, 0.42)
"""Metres, of what a network says about blocks."""

_SPECIAL = {
    "pad_token": "<|im_end|>",
    "bos_token": "<|im_start|>",
    "unk_token": "<|endoftext|>",
    "eos_token": "<end_of_utterance>",
    "fake_image_token": "<fake_token_around_image>",
    "image_token": "<image>",
    "global_image_token": "<global-img>",
    "video_token": "<video>",
}


class Learner(ABC):
    """A policy, and how it is trained.

    Attributes:
        policy: of lerobot.
        places: of training alone.
        processors: before and after the policy.
    """

    policy: Any
    places: nn.Module
    processors: Any

    @abstractmethod
    def __init__(self, statistics: Statistics) -> None:
        """From nothing, with the statistics of the demonstrations."""

    @staticmethod
    @abstractmethod
    def prepare() -> None:
        """Write the files that the policy is made from into the working directory, once."""

    @abstractmethod
    def losses(self, batch: dict[str, Tensor], padding: Tensor, offsets: Tensor, grip: Tensor) -> list[Tensor]:
        """That of the policy, and both of ``Places``.

        Args:
            batch: processed, by lerobot's key.
            padding: ``[B, T]``, which actions are none.
            offsets: see ``Places``.
            grip: see ``Places``.
        """


def features() -> dict[str, dict[str, PolicyFeature]]:
    """``input_features`` and ``output_features`` of lerobot's configurations."""
    camera = PolicyFeature(type=FeatureType.VISUAL, shape=(3, SIZE, SIZE))
    seen = {"observation.images.front": camera, "observation.images.wrist": camera}
    state, action = (PolicyFeature(type=kind, shape=(4,)) for kind in (FeatureType.STATE, FeatureType.ACTION))
    return {"input_features": {**seen, "observation.state": state}, "output_features": {"action": action}}


def tokenizer() -> PreTrainedTokenizerFast:
    """A token a word, as ``fetch_blocks.tokens`` has them."""
    vocabulary = {token: number for number, token in enumerate([*_SPECIAL.values(), *WORDS])}
    assert vocabulary[WORDS[0]] == BEFORE
    made = Tokenizer(models.WordLevel(vocabulary, unk_token=_SPECIAL["unk_token"]))
    made.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    extra = {name: token for name, token in _SPECIAL.items() if not name.startswith(("pad", "bos", "unk", "eos"))}
    named: dict[str, Any] = {name: token for name, token in _SPECIAL.items() if name not in extra}
    return PreTrainedTokenizerFast(tokenizer_object=made, extra_special_tokens=extra, **named)


class Places(nn.Module):
    """Says where the blocks are: of training alone.

    From what a policy makes of everything, and, so that the eyes learn first, from what it makes of each picture.

    Args:
        width: of what is made of everything.
        picture: of what is made of a picture.
    """

    def __init__(self, width: int, picture: int) -> None:
        super().__init__()
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 12))
        self.eyes = nn.ModuleList(nn.Sequential(nn.LayerNorm(picture), nn.Linear(picture, 9)) for _ in range(2))

    def forward(self, read: Tensor, pictures: list[Tensor], offsets: Tensor, grip: Tensor) -> tuple[Tensor, Tensor]:
        """Errors of both.

        Args:
            read: ``[B, width]``.
            pictures: ``[B, picture]`` each. The fixed camera says where blocks are, that on the gripper where from it.
            offsets: ``[B, 4, 3]``, in ``UNIT``: from the grip to the block that was asked for, and to all three.
            grip: ``[B, 3]``, metres.
        """
        told = functional.smooth_l1_loss(self.head(read), offsets.flatten(1))
        from_grip = offsets[:, 1:]
        fixed = from_grip + (grip - torch.tensor(MIDDLE))[:, None] / UNIT
        pairs = zip(self.eyes, pictures, (fixed, from_grip), strict=True)
        seen = sum(functional.smooth_l1_loss(eye(picture), wanted.flatten(1)) for eye, picture, wanted in pairs)
        return told, torch.as_tensor(seen)
