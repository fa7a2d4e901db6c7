"""What a CLIP encoder is beside its weights, and where it is found: on this machine, never downloaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from ..errors import CheckpointError
from .settings import Settings, read_json

_MOST = {"num_hidden_layers": 512, "image_size": 4096, "patch_size": 4096}
_MOST_OTHERWISE = 2**20
_MOST_LETTERS = 200

NAME_FOLDER = "Name the folder that has it: encoders= in Python, --encoders on the command line."


@dataclass(frozen=True)
class TowerConfig:
    """One encoder; the names are those of transformers' configuration.

    Attributes:
        hidden_size: width.
        intermediate_size: width inside the feed-forward layers.
        num_hidden_layers: layers.
        num_attention_heads: attention heads.
        hidden_act: ``quick_gelu`` or ``gelu``.
        layer_norm_eps: of every layer normalisation.
    """

    hidden_size: int
    intermediate_size: int
    num_hidden_layers: int
    num_attention_heads: int
    hidden_act: str = "quick_gelu"
    layer_norm_eps: float = 1e-5

    def __post_init__(self) -> None:
        settings = Settings(vars(self), "CLIP's ")
        for field in fields(self):
            if field.type == "int":
                settings.number(field.name, most=_MOST.get(field.name, _MOST_OTHERWISE))
        settings.choice("hidden_act", "quick_gelu", "gelu")
        if self.hidden_size % self.num_attention_heads:
            raise settings.refusal("hidden_size", f"a multiple of num_attention_heads = {self.num_attention_heads}")
        if not isinstance(self.layer_norm_eps, float) or not 0 < self.layer_norm_eps < 1:
            raise settings.refusal("layer_norm_eps", "a small positive number")


@dataclass(frozen=True)
class VisionConfig(TowerConfig):
    """The image encoder: square images of ``image_size`` pixels in patches of ``patch_size``.

    Defaults are what transformers takes for an entry that its file leaves out.
    """

    hidden_size: int = 768
    intermediate_size: int = 3072
    num_hidden_layers: int = 12
    num_attention_heads: int = 12
    image_size: int = 224
    patch_size: int = 32
    num_channels: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_channels != 3 or self.patch_size > self.image_size:
            found = f"{self.num_channels}, its patch_size {self.patch_size} and its image_size {self.image_size}"
            expected = "3 channels, and patches that are no larger than the image"
            raise CheckpointError(f"CLIP's num_channels is {found}; expected {expected}.")

    @property
    def patches(self) -> int:
        """Tokens of an image, without the class token."""
        return (self.image_size // self.patch_size) ** 2


@dataclass(frozen=True)
class TextConfig(TowerConfig):
    """The text encoder; defaults as for ``VisionConfig``."""

    hidden_size: int = 512
    intermediate_size: int = 2048
    num_hidden_layers: int = 12
    num_attention_heads: int = 8
    vocab_size: int = 49408
    max_position_embeddings: int = 77
    eos_token_id: int = 49407


def _openai(layers: int, width: int, text: int, patch: int, size: int = 224) -> dict[str, Any]:
    """A released model: layers and width of the image encoder, width of the text encoder, pixels of patch and image."""
    vision = {"hidden_size": width, "num_hidden_layers": layers, "image_size": size, "patch_size": patch}
    # The end token is 2 in their configurations; the real one, 49407, is the largest there is.
    parts = {"vision_config": vision, "text_config": {"hidden_size": text, "eos_token_id": 2}}
    for part in parts.values():
        part |= {"intermediate_size": 4 * part["hidden_size"], "num_attention_heads": part["hidden_size"] // 64}
    return parts


RELEASED: Mapping[str, Mapping[str, Any]] = {
    "openai/clip-vit-base-patch16": _openai(12, 768, 512, 16),
    "openai/clip-vit-base-patch32": _openai(12, 768, 512, 32),
    "openai/clip-vit-large-patch14": _openai(24, 1024, 768, 14),
    "openai/clip-vit-large-patch14-336": _openai(24, 1024, 768, 14, 336),
}
"""Configurations of the released models: with these names nothing but the policy's own weights is needed."""

Tower = TypeVar("Tower", bound=TowerConfig)


def find_encoder(name: str, folders: Sequence[Path]) -> Path | None:
    """The local directory of an encoder: ``name``, or its last part, in one of ``folders``, or one of them itself.

    The name is as the policy's configuration says it, ``openai/clip-vit-base-patch16`` or a path of another machine.
    """
    relative = Path(name)
    if max(map(len, relative.parts), default=0) > _MOST_LETTERS:
        return None  # no file system has such a name, and some say so with an error
    names = [relative.name]
    if not relative.is_absolute() and ".." not in relative.parts:
        names.insert(0, name)
    for folder in folders:
        for candidate in (*(folder / each for each in names if each), folder):
            path = candidate / "config.json"
            # The policy's own directory has one, too.
            if path.is_file() and str(read_json(path).get("model_type")).startswith("clip"):
                return candidate
    return None


def encoder_config(name: str, part: str, cls: type[Tower], folders: Sequence[Path]) -> Tower:
    """The configuration of one encoder: its ``part``, ``vision_config`` or ``text_config``, as a ``cls``.

    Raises:
        CheckpointError: there is none on this machine, or it is not CLIP's.
    """
    found = find_encoder(name, folders)
    if found is not None:
        where, settings = str(found / "config.json"), read_json(found / "config.json")
    elif name in RELEASED:
        where, settings = name, dict(RELEASED[name])
    else:
        looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
        raise CheckpointError(
            f"the observation encoder {name!r} is not on this machine, and nothing is ever downloaded. Looked for a"
            f" directory {name!r} or {Path(name).name!r} with a config.json in {looked}. Copy it there (and the files"
            f" of its tokenizer, to compile for one task). {NAME_FOLDER}"
        )
    alone = settings.get("model_type") == f"clip_{part.split('_')[0]}_model"
    inner: Any = settings if alone else settings.get(part)
    if not isinstance(inner, dict):
        raise CheckpointError(f"{where}: has no {part}; expected the configuration of a CLIP model.")
    names = {field.name for field in fields(cls)}
    try:
        return cls(**{key: value for key, value in inner.items() if key in names})
    except CheckpointError as error:
        raise CheckpointError(f"{where}: {error}") from error
