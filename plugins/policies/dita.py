"""Dita, whole: from pictures and words to actions, read from a checkpoint and the configuration of its training.

The words' encoder, CLIP's, is in no checkpoint: it is read from a folder of its name. Where there is none, features of
words are observed.

Source: ``RobotTransformerNet.inference`` of RoboDita/Dita at 66350e7, and what its evaluations do to pictures and text.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ttscompile.core.spec import Affine, ChunkSpec, Instruction, ObservationSpec, PolicySpec
from ttscompile.core.tokenizer import find_tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.refusals import MERGE
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.settings import Settings

from .instruction import NAME_FOLDER, encoder_folders, find_encoder, language_model_folder, task_tokens
from .loops import ddim_loops
from .networks.clip import ClipText, TextConfig, encoder_config
from .networks.dita_head import DitaHead
from .networks.dita_tokens import IMAGE, MASK, TOKENS, WORDS, WRIST, Observed, PictureConfig, Pictures, Words
from .networks.qformer import CHANNELS
from .networks.timm_vit import DinoConfig, own_names
from .quantiles import STATISTICS, read_statistics
from .shards import read_part
from .yaml_files import read_yaml

CONFIG = Path(".hydra") / "config.yaml"
"""Hydra writes it into the folder of a training; checkpoints are in a folder of that."""

CLIP, LENGTH = "openai/clip-vit-large-patch14", 77
"""What makes features of words, and how many tokens these have, with their padding."""

_LLAMA, _PICTURES = "transformer.", "image_tokenizer."
_TOWER, _MAKER = f"{_PICTURES}tokenizer.", f"{_PICTURES}qformer."
_WRIST = f"{_TOWER}wrist_image_part."
_UNREAD = (".rotary_emb.inv_freq", ".qformer.num_iter")
"""Older versions of transformers saved the one, computed here; the other counts the steps of the training."""

_MOST_STEPS, _MOST_PIXELS = 4096, 4096
_ARM, _METRES = 7, 0.0768
"""Numbers of an action without a quaternion; and by what ``inference`` multiplies the pose of one that has it."""

_REMEDY = (
    f"Give the {CONFIG} that hydra wrote for this training. For a released checkpoint write one with dataset:"
    " {traj_length: N}, num_pred_action, scheduler_type, prediction_type and num_inference_steps, as its authors'"
    " command has them."
)


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from a checkpoint and the configuration of its training; see ``Family.load``."""
    where = next(each for each in config_files(path) if each.is_file())
    settings = Settings(read_yaml(where), f"{where}: ", _REMEDY)
    settings.require(use_action_head_diff=0, dim_align_type=0, abs_sup=0, cfg=0)
    if "model" in settings.values:
        settings.part("model").require(use_depth_img=False)
    horizon, predicted = _lengths(settings)
    frames = horizon - predicted + 1
    saved = _Saved(path)
    sizes = saved.head_sizes()
    pictures = _pictures(settings, saved, frames, sizes["width"])
    head = filled(lambda: DitaHead(**sizes), saved.part(_LLAMA), "A Llama of the width of its first layer", path)
    seen = own_names(saved.part(_TOWER)) | saved.part(_MAKER)
    seen = {name.removeprefix(_PICTURES): value for name, value in seen.items()}
    made = filled(lambda: Pictures(pictures), seen, "a network of its pictures' size", path)
    # Of the original's two schedules the one has a thousand timesteps, as diffusers has where nothing is said.
    linear = settings.number("scheduler_type", 0, least=0) == 1
    schedule: dict[str, Any] = {"beta_schedule": "linear"} if linear else {"num_train_timesteps": 100}
    schedule["prediction_type"] = settings.choice("prediction_type", "epsilon", "sample", "v_prediction")
    loops = ddim_loops(where, settings.number("num_inference_steps", 10), options, **schedule)
    image = ObservationSpec((frames, 3, *pictures.size), bounds=(0.0, 1.0))
    words = _words(path, sizes["width"], options)
    statistics, normalizer = _normalizer(path, sizes["actions"])
    source = {"format": "dita", "policy": "Dita", "frames": str(frames), "statistics": statistics, **loops.source}
    spec = PolicySpec(
        sample=(horizon, sizes["actions"]),
        observations={IMAGE: image, **({WRIST: image} if pictures.wrist else {}), **_told(words, sizes["width"])},
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(sizes["actions"], frames - 1, horizon, normalizer, ranged=False),
        source=source | ({} if options.task is None else {"task": options.task}),
        instruction=Instruction(TOKENS, MASK, False) if isinstance(words, Words) else None,
    )
    return EncodedDenoiser(Observed(made, words), head).eval(), spec


def config_files(path: Path) -> tuple[Path, Path]:
    """Where the configuration of a checkpoint may be."""
    return path.parent / CONFIG, path.parent.parent / CONFIG


def tokenizer_file(path: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The tokenizer of CLIP, if it is on this machine, in the folder of its text encoder."""
    folder = find_encoder(CLIP, encoder_folders(encoders, path.parent))
    return None if folder is None else find_tokenizer(folder)


def _lengths(settings: Settings) -> tuple[int, int]:
    """Steps of the sample, and those of them that are actions to come; the others are of the frames before the last."""
    own = settings.part("dataset")
    predicted = settings.number("num_pred_action", 1, _MOST_STEPS)
    wrapped = settings.number("wrap_grmg_data", 0, 2, least=0)
    horizon = predicted + wrapped - 1 if wrapped else own.number("traj_length", most=_MOST_STEPS)
    if predicted > horizon:
        raise settings.refusal("num_pred_action", f"{horizon} at most, of dataset.traj_length")
    return horizon, predicted


class _Saved:
    """What was saved of the network, under ``parameter`` or alone, and what its sizes are."""

    def __init__(self, path: Path) -> None:
        payload = read_checkpoint(path, mapped=True)
        self.path, saved = path, payload.get("parameter", payload)
        if not isinstance(saved, dict):
            raise CheckpointError(
                f"{path}: its entry 'parameter' is a {type(saved).__name__}; expected weights by name. Give what was"
                " saved."
            )
        names = [str(name) for name in saved]
        if adapted := next((name for name in names if ".lora_A." in name), None):
            raise CheckpointError(f"{path}: holds an adapter (LoRA: {adapted:.120}). {MERGE}")
        plain = {str(name).replace("_orig_mod.", "").removeprefix("module."): value for name, value in saved.items()}
        self.weights: Mapping[str, Any] = {name: each for name, each in plain.items() if not name.endswith(_UNREAD)}
        self.shape(f"{_LLAMA}lm_head.weight", 2)
        for name in self.weights:
            if not name.startswith((_LLAMA, _TOWER, _MAKER)) or name.startswith(f"{_TOWER}patch_embed_depth."):
                why = "expected a network without use_action_head_diff, dim_align_type and use_depth_img"
                raise self.error(f"holds the weight {name:.120}; {why}: another is not rebuilt here")

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The weights whose names begin so, as float32."""
        part = {name: value for name, value in self.weights.items() if name.startswith(prefix)}
        return as_float32(part, f"{self.path}: ")

    def shape(self, name: str, axes: int) -> tuple[int, ...]:
        """Of a weight that has so many axes, none of them empty."""
        value = self.weights.get(name)
        if not isinstance(value, Tensor) or value.ndim != axes or not value.numel():
            found = f"one of {tuple(value.shape)}" if isinstance(value, Tensor) else "none"
            raise self.error(
                f"no weight {name} of {axes} axes (found {found}); expected a checkpoint of Dita's network"
            )
        return tuple(value.shape)

    def count(self, prefix: str) -> int:
        """How many layers have names that begin so."""
        return len({name.removeprefix(prefix).split(".")[0] for name in self.weights if name.startswith(prefix)})

    def head_sizes(self) -> dict[str, int]:
        """Of the Llama: width, heads, width inside the feed-forward layers, layers, and numbers of an action."""
        first = f"{_LLAMA}model.layers.0.mlp.gate_proj.weight"
        hidden, width = self.shape(first, 2)
        if width % CHANNELS:
            raise self.error(f"weight {first} is {width} wide; expected a multiple of {CHANNELS}")
        layers, actions = self.count(f"{_LLAMA}model.layers."), self.shape(f"{_LLAMA}lm_head.weight", 2)[0]
        return {"width": width, "heads": width // CHANNELS, "hidden": hidden, "layers": layers, "actions": actions}

    def error(self, what: str) -> CheckpointError:
        """The error for what is wrong with it."""
        return CheckpointError(f"{self.path}: {what}. {_REMEDY}")


def _pictures(settings: Settings, saved: _Saved, frames: int, width: int) -> PictureConfig:
    """Sizes of what makes tokens of pictures; of these the weights say all but the height."""
    queries, latents = (saved.weights.get(f"{_MAKER}{name}") for name in ("queries", "latents"))
    if not isinstance(queries if latents is None else latents, Tensor):
        raise saved.error(
            f"neither weight {_MAKER}queries nor {_MAKER}latents, whose rows are the tokens of a frame; expected a Dita"
            " with use_qformer"
        )
    own, _, patch, across = saved.shape(f"{_TOWER}patch_embed.proj.weight", 4)
    if own != width or patch != across:
        raise saved.error(
            f"its image encoder is {own} wide, with patches of {patch} x {across}; expected the width of its Llama,"
            f" {width}, and square patches"
        )
    vision = DinoConfig(
        hidden_size=width,
        intermediate_size=saved.shape(f"{_TOWER}blocks.0.mlp.fc1.weight", 2)[0],
        num_hidden_layers=saved.count(f"{_TOWER}blocks."),
        num_attention_heads=width // CHANNELS,
        grid=_grid(settings, saved.shape(f"{_TOWER}pos_embed", 3)[1], patch),
        patch_size=patch,
        before=1 + saved.shape(f"{_TOWER}reg_token", 3)[1],
    )
    wrist = any(name.startswith(_WRIST) for name in saved.weights)
    if latents is None:
        count = saved.shape(f"{_MAKER}queries", 3)[1]
        return PictureConfig(vision, frames, saved.count(f"{_MAKER}blocks."), count, wrist)
    count, places = saved.shape(f"{_MAKER}latents", 2)[0], saved.shape(f"{_MAKER}media_pos_emb", 3)[0]
    return PictureConfig(vision, frames, saved.count(f"{_MAKER}layers."), count, wrist, places)


def _grid(settings: Settings, patches: int, patch: int) -> tuple[int, int]:
    """Patches along height and width. Of ``input_size`` a training reads one side, and the network both, as a text."""
    side = math.isqrt(patches)
    given = settings.values.get("input_size")
    both = re.fullmatch(r"\(\s*(\d{1,4})\s*,\s*(\d{1,4})\s*\)", given) if isinstance(given, str) else None
    if both is not None:
        height, width = (int(each) for each in both.groups())
    else:
        height = width = side * patch if given is None else settings.number("input_size", most=_MOST_PIXELS)
    rows, columns = height // patch, width // patch
    if rows * columns != patches or height % patch or width % patch:
        what = f"'(height, width)' in pixels, of {patches} patches of {patch} x {patch}, which its weights are for"
        raise settings.refusal("input_size", what)
    return rows, columns


def _words(path: Path, width: int, options: LoadOptions) -> Words | Tensor | None:
    """What makes features of words; or those of the one instruction that is compiled in; or neither, with a warning."""
    folders = encoder_folders(options.encoders, path.parent)
    folder = find_encoder(CLIP, folders)
    if folder is None and options.task is None and options.encoders is None:
        warnings.warn(
            f"{path}: the text encoder {CLIP} is in no checkpoint of Dita, and not on this machine, so the features of"
            f" the words are observed: {WORDS} [{LENGTH}, {width}]. To give the policy words: {NAME_FOLDER}",
            stacklevel=5,
        )
        return None
    try:
        folder = language_model_folder(CLIP, folders, "clip", "text encoder")
        config = encoder_config(CLIP, "text_config", TextConfig, folders)
        if config.hidden_size != width or config.max_position_embeddings < LENGTH:
            found = f"{config.hidden_size} wide, for {config.max_position_embeddings} tokens"
            raise CheckpointError(f"the text encoder in {folder} is {found}; expected {width}, and {LENGTH}: {CLIP}.")
        weights = {name: value for name, value in read_part(folder, "text_model.").items() if value.is_floating_point()}
        text = filled(lambda: ClipText(config), as_float32(weights, f"{folder}: "), "its config.json", folder)
        # In old configurations the end is wrongly 2; the real one, which the original pads with, is the last token.
        made = Words(text, config.vocab_size - 1 if config.eos_token_id == 2 else config.eos_token_id).eval()
        if options.task is None:
            return made
        tokens = task_tokens(options.task, CLIP, folder, LENGTH, config.vocab_size)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    with torch.no_grad():
        return made(*map(torch.from_numpy, padded([tokens], LENGTH)))  # type: ignore[no-any-return]


def _told(words: Words | Tensor | None, width: int) -> dict[str, ObservationSpec]:
    """What is observed of the instruction."""
    if words is None:
        return {WORDS: ObservationSpec((LENGTH, width), window=False)}
    if isinstance(words, Tensor):
        return {}
    last = float(words.text_model.embeddings.token_embedding.num_embeddings - 1)
    return {
        TOKENS: ObservationSpec((LENGTH,), dtype="int64", window=False, bounds=(0.0, last)),
        MASK: ObservationSpec((LENGTH,), dtype="bool", window=False, bounds=(0.0, 1.0)),
    }


def _normalizer(path: Path, actions: int) -> tuple[str, Affine | None]:
    """Whose statistics actions have, and how they are undone.

    The original's own code multiplies poses with a quaternion, and leaves others to whoever evaluates it: its scripts
    undo quantiles of a data set. They are read where somebody has put them in the folder of the training.
    """
    if actions != _ARM:
        scale = np.ones(actions, np.float32)
        scale[:_ARM] = 1 / _METRES
        return "none", Affine(scale, np.zeros(actions, np.float32))
    if not (path.absolute().parents[1] / STATISTICS).is_file():
        return "none", None
    found = read_statistics(path, actions, ())
    return found.name, found.normalizer
