"""What Dita's Llama reads before the actions: the words of the instruction, and a few tokens of each picture.

Parameters are called as in the original, ``scripts/vision_tokenizers/vit_tokenizer.py`` of RoboDita/Dita, but for those
of the image encoder (``timm_vit.own_names``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .clip import ClipText
from .qformer import QFormer, Resampler
from .timm_vit import DinoConfig, TimmVit

IMAGE, WRIST, WORDS = "image", "wrist_image", "natural_language_embedding"
TOKENS, MASK = "language_instruction.input_ids", "language_instruction.attention_mask"

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet


@dataclass(frozen=True)
class PictureConfig:
    """Sizes and variant.

    Attributes:
        vision: of the image encoder, or of both; tokens have its width.
        frames: of a camera.
        depth: layers that make them.
        queries: tokens that are made of a frame.
        wrist: whether there is a camera at the wrist, which has an encoder of its own.
        places: of the resampler, see there; None for the Q-former.
    """

    vision: DinoConfig
    frames: int
    depth: int
    queries: int
    wrist: bool = False
    places: int | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of a picture."""
        height, width = self.vision.grid
        return height * self.vision.patch_size, width * self.vision.patch_size


class Pictures(nn.Module):
    """Pictures of 0..1 ``[B, F, 3, H, W]`` of one camera or two, and the words' mean ``[B, E]`` -> ``[B, F * Q, E]``.

    Of the wrist's pictures the original looks at half of the patches, drawn anew at each call, in evaluation as in
    training: the dropout that it makes there is never told that the training is over. Here it is every second one, as
    on a chessboard, which is one of its draws.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, config: PictureConfig) -> None:
        super().__init__()
        self.tokenizer, width = TimmVit(config.vision), config.vision.hidden_size
        rows, columns = config.vision.grid
        if config.wrist:
            places = [row * columns + column for row in range(rows) for column in range(columns) if (row + column) % 2]
            self.tokenizer.wrist_image_part = TimmVit(config.vision, places)
        if config.places is None:
            self.qformer: nn.Module = QFormer(width, config.depth, config.queries, config.frames)
        else:
            self.qformer = Resampler(width, config.depth, config.queries, config.places)
        self.frames, self.before = config.frames, config.vision.before
        for name, values in (("mean", _MEAN), ("deviation", _DEVIATION)):
            self.register_buffer(name, torch.tensor(values, device="cpu")[:, None, None], persistent=False)

    def forward(self, image: Tensor, wrist: Tensor | None, words: Tensor) -> Tensor:
        """See the class."""
        seen = self.tokenizer(self._normalised(image))[:, self.before :]
        if wrist is not None:
            own: nn.Module = self.tokenizer.wrist_image_part  # type: ignore[assignment]
            seen = torch.cat([seen, own(self._normalised(wrist))[:, self.before :]], 1)
        return self.qformer(seen, words).unflatten(0, (-1, self.frames)).flatten(1, 2)  # type: ignore[no-any-return]

    def _normalised(self, images: Tensor) -> Tensor:
        return (images.flatten(0, 1) - self.mean) / self.deviation


class Words(nn.Module):
    """Tokens int64 ``[B, L]`` and their mask to the features of all, ``[B, L, E]``, those of the padding, too.

    Args:
        padding: the token that the original pads with.
    """

    def __init__(self, text: ClipText, padding: int) -> None:
        super().__init__()
        self.text_model, self.padding = text, padding

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """See the class."""
        return self.text_model.features(torch.where(mask, tokens, self.padding), mask)


class Observed(nn.Module):
    """What the original evaluates once a call, of observations by name: words and pictures ``[B, P, E]``.

    An instruction that is compiled in is apart, ``[1, L, E]``: keys and values of its words are constants then.

    Args:
        words: makes features of the instruction's tokens; or its features ``[1, L, E]``, of the one that is compiled
            in; None where features are observed.
    """

    def __init__(self, pictures: Pictures, words: Words | Tensor | None) -> None:
        super().__init__()
        self.image_tokenizer = pictures
        self.words = words if isinstance(words, Words) else None
        self.register_buffer("told", words if isinstance(words, Tensor) else None, persistent=False)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor | tuple[Tensor, Tensor]:
        """See the class."""
        if self.told is not None:
            words: Tensor = self.told  # type: ignore[assignment]
        elif self.words is not None:
            words = self.words(*(observations[key.replace(".", "_")] for key in (TOKENS, MASK)))
        else:
            words = observations[WORDS]
        pictures = self.image_tokenizer(observations[IMAGE], observations.get(WRIST), words.mean(1))
        return torch.cat([words, pictures], 1) if self.told is None else (words, pictures)
