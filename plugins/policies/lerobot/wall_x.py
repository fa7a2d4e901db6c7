"""LeRobot's ``wall_x``: its directory to module and ``PolicySpec``; cameras, instruction and state to robot actions.

Of its two modes the one that denoises is rebuilt. Neither lerobot nor transformers is needed. Source:
``WallXPolicy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ttscompile.core.spec import Instruction, PolicySpec, SamplerTable
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import filled, renamed
from ttscompile.frontends.settings import Settings, is_shape, read_json

from ..instruction import encoder_folders, language_model_folder
from ..networks.language_layers import LanguageConfig
from ..networks.qwen25_vl import Piece, Qwen25VLConfig, rebuilt_weights
from ..networks.wall_x import Denoiser, Prefix, WallX, WallXConfig
from . import vla
from .config import CONFIG, MOST, MOST_LETTERS, MOST_VOCABULARY, LeRobotConfig
from .policy import MASK, TOKENS, integration_steps, read_weights
from .processors import SENTENCE
from .qwen3_vl import END, IMAGE, TURN, Resizing
from .qwen25_vl import DEVIATION, KIND, MEAN, pieces, read_pictures, read_qwen25
from .resized_bytes import Shown

_MODEL = "x-square-robot/wall-oss-flow"
_LENGTH = 64
"""Tokens of an instruction, of a policy that none is compiled into, where the prompt has room for as many."""
_MOST_TOKENS = 768
"""Of a prompt, its actions counted. LeRobot cuts a longer one at its end, where the actions are, and then fails."""
_LONGER_SIDE, _MOST_RATIO, _MULTIPLE = 256, 200, 28
"""An image is resized to this longer side, and then to multiples along each."""
_PIXELS, _MOST_PIXELS = {"shortest_edge": 56 * 56, "longest_edge": 28 * 28 * 1280}, 2**31
"""Least and most, where the base does not say; older files have other names for them, in the order of these."""
_OLDER = ("min_pixels", "max_pixels")
_STATE, _ACTION = "<|propri|>", "<|action|>"
_SYSTEM = f"<|im_start|>system\nYou are a helpful assistant.{END}\n{TURN}\nObservation:"
_LATER = f"Predict the next action in robot action.\nProprioception: {_STATE}\n{END}\n<|im_start|>assistant\n"
_NEVER = ("<point>", "<|")
"""In an instruction: lerobot computes such coordinates anew, and takes the other for an image, the state or actions."""
_TOLD = Instruction(TOKENS, MASK, True, ("",), around=("Instruction: ", ""), end=".", never=_NEVER)
_VIEWS = {"face_view": "front view", "move1_view": "move view", "move2_view": "move view"}
_EMBEDDING, _HEAD = "model.embed_tokens.weight", "lm_head.weight"
_RENAMED = (
    (r"^visual\.", "backbone.visual."),
    (r"^model\.layers\.(\d+)\.moe\.experts\.1\.", r"experts.\1."),
    (r"^model\.(layers\.\d+)\.moe\.experts\.0\.", r"model.\1.mlp."),
    (r"^model\.", "backbone.language_model."),
    (r"^action_preprocessor\.", ""),
)


class _Base(NamedTuple):
    """The model that a policy was trained from: the entries of its ``config.json``, and its tokenizer."""

    folder: Path
    model: Settings
    tokenizer: Tokenizer


class _Prompt(NamedTuple):
    """What the language model reads.

    Attributes:
        length: tokens of an instruction, with what is around it in its lines.
        task: those of the one that is compiled in, int64 ``[1, L]``; None where it is an observation.
    """

    pieces: list[Piece]
    length: int
    task: Tensor | None


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, {"chunk_size": 32, "n_action_steps": 32, **entries}, options)
    shared, processors = vla.read_vla_processors(shared)
    if SENTENCE not in processors.own:
        raise CheckpointError(f"{directory}: its preprocessor has no {SENTENCE}. Save it again.")
    settings = shared.settings
    settings.choice("prediction_mode", "diffusion")
    name = settings.text("pretrained_name_or_path", _MODEL, MOST_LETTERS)
    base = _read_base(language_model_folder(name, encoder_folders(options.encoders, directory), KIND))
    language = replace(read_qwen25(base.model), rounded=True)
    text, expert = _read_experts(vla.part_of(base.model, "text_config"), language.text)
    pictures = read_pictures(base.folder, language, base.model)
    sizes = _read_sizes(shared, pictures, language)
    language = replace(language, text=text).of_images([each[-1] for each in sizes])
    prompt, config = _read_prompt(shared, base, language, options.task), _read_config(shared, language, expert)
    weights = _read_weights(shared, options, base.model)
    network = filled(lambda: WallX(config, prompt.pieces), weights, "config.json, or the base's,", directory)
    colours = _read_colours(pictures, "image_mean", MEAN, 0.0), _read_colours(pictures, "image_std", DEVIATION, 1e-6)
    prefix = Prefix(network, Shown(sizes, "card", *colours, lower=True))
    encoder = vla.Gathered(shared, processors, prefix, config.state, prompt.task)
    numbers = {"actions": config.actions, "tokens": prompt.length, "vocabulary": language.vocabulary}
    spec = vla.vla_spec(shared, processors, None, "stretch", numbers, options, partial(_sampler, settings), _TOLD)
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def _read_config(shared: LeRobotConfig, language: Qwen25VLConfig, expert: LanguageConfig | None) -> WallXConfig:
    return WallXConfig(
        language=language,
        expert=expert,
        given=shared.state_dim,
        state=vla.padded_size(shared.settings, "max_state_dim", shared.state_dim, 20),
        moved=shared.action_dim,
        actions=vla.padded_size(shared.settings, "max_action_dim", shared.action_dim, 20),
    )


def _read_base(folder: Path) -> _Base:
    """Of a folder. Entries of the text come to be in a part of their own, as newer files have them."""
    path, tokenizer = folder / CONFIG, Tokenizer(folder, CheckpointError)
    found = read_json(path)
    inner = found.get("text_config")
    text = inner if isinstance(inner, dict) else {key: each for key, each in found.items() if key != "vision_config"}
    # LeRobot gives the language model as many tokens as the tokenizer has, whatever its configuration says.
    text = {"rms_norm_eps": 1e-5, **text, "vocab_size": tokenizer.size}
    model = Settings({**found, "text_config": text}, f"{path}: ")
    model.require(use_lora=False)
    own = vla.part_of(model, "text_config")
    width, heads = own.number("hidden_size", None, MOST), own.number("num_attention_heads", None, MOST)
    if width % heads or width < 4:  # of fewer numbers the waves of a time are none
        raise own.refusal("hidden_size", f"a multiple of num_attention_heads, {heads}, and 4 at least")
    own.require(head_dim=width // heads)
    return _Base(folder, model, tokenizer)


def _read_experts(text: Settings, own: LanguageConfig) -> tuple[LanguageConfig, LanguageConfig | None]:
    """The language model as it reads a prompt, and the feed-forward layers of actions; None where they are the same.

    What a token is decides which expert reads it, never its numbers: the first reads all but actions, and the second
    those. There may be others, which read nothing.
    """
    if not text.flag("mlp_moe", False):
        return own, None
    widths, experts = text.values.get("dim_inputs", [1536, 1536]), text.values.get("experts")
    count = text.number("num_experts", 4, MOST)
    if count < 2:
        raise text.refusal("num_experts", "2 at least, of which the second reads actions")
    if not is_shape(widths, own.width) or len(widths) < 2 or widths[0] != own.width:
        raise text.refusal("dim_inputs", f"{own.width}, all numbers of a token, and then as many at most", [1536, 1536])
    if not isinstance(experts, list) or len(experts) < count or not all(isinstance(one, dict) for one in experts):
        raise text.refusal("experts", f"the entries of {count}")
    both = [Settings(experts[number], f"{text.where}experts.{number}.") for number in (0, 1)]
    for expert, width in zip(both, widths, strict=False):
        expert.require(hidden_size=width, hidden_act="silu")
    first, second = (expert.number("intermediate_size", None, MOST) for expert in both)
    return replace(own, hidden=first), replace(own, width=widths[1], hidden=second)


def _read_sizes(
    shared: LeRobotConfig, pictures: Settings, language: Qwen25VLConfig
) -> list[tuple[tuple[int, int], ...]]:
    """Of each camera the height and width of its images, and all to which they are resized, in turn."""
    size = _PIXELS if pictures.values.get("size") is None else vla.part_of(pictures, "size").values
    older = {name: pictures.values.get(old) for name, old in zip(_PIXELS, _OLDER, strict=True)}
    both = Settings({**size, **{name: each for name, each in older.items() if each is not None}}, pictures.where)
    least, most = (both.number(name, None, _MOST_PIXELS) for name in _PIXELS)
    last, found = Resizing(language.patch * language.merge, least, most), list[tuple[tuple[int, int], ...]]()
    for key, (_, height, width) in shared.cameras.items():
        wide = width > height
        other = int(_LONGER_SIDE * height / width) if wide else int(_LONGER_SIDE * width / height)
        if _MOST_RATIO * other < _LONGER_SIDE:
            told = f"images of {key} have {height} x {width} pixels, of which lerobot makes {other} x {_LONGER_SIDE}"
            told += f"; expected sides of a ratio of {_MOST_RATIO} at most"
            raise shared.settings.error(told)
        first = (other, _LONGER_SIDE) if wide else (_LONGER_SIDE, other)
        rows, columns = (max(_MULTIPLE, round(side / _MULTIPLE) * _MULTIPLE) for side in first)
        found.append(((height, width), first, (rows, columns), last(rows, columns)))
    return found


def _read_colours(pictures: Settings, name: str, own: tuple[float, ...], least: float) -> tuple[float, ...]:
    """Mean or deviation of red, green and blue in 0..1."""
    found = pictures.values.get(name, list(own))
    numbers = isinstance(found, list) and len(found) == 3 and all(type(each) in (int, float) for each in found)
    if not numbers or not least <= min(found) <= max(found) <= 1:
        raise pictures.refusal(name, f"three numbers from {least} to 1")
    return tuple(map(float, found))


def _read_prompt(shared: LeRobotConfig, base: _Base, language: Qwen25VLConfig, task: str | None) -> _Prompt:
    """Cameras by name, each with its image, an instruction, and the state."""
    tokenizer = base.tokenizer
    image, state = _read_words(base)
    cameras = _SYSTEM + "".join(f" {_view(key)}: {IMAGE}" for key in shared.cameras)
    before, words, later = tokenizer(cameras), tokenizer(_TOLD.line("")), tokenizer(_LATER)
    if tokenizer(cameras + _TOLD.line("") + _LATER) != before + words + later:
        found = "makes other tokens of a line where another one is before it"
        raise CheckpointError(f"{base.folder}: its tokenizer {found}; expected Qwen2.5-VL's, which does not.")
    seen = sum(rows * columns for rows, columns in language.grids) // language.merge**2
    room = _MOST_TOKENS - (len(before) + len(later) - len(language.grids) + seen + shared.horizon)
    made = None if task is None else tokenizer.of_task(task, _TOLD, MOST_VOCABULARY)
    least = len(words) + 1 if made is None else len(made)
    if least > room:
        raise shared.settings.error(
            f"the prompt has {_MOST_TOKENS - room + least} tokens, {seen} of images and {shared.horizon} of actions"
            f" among them; expected {_MOST_TOKENS} at most, where lerobot cuts it"
        )
    return _Prompt(
        pieces=[*pieces(before, image, state), "task", *pieces(later, image, state)],
        length=min(len(words) + _LENGTH, room),
        task=None if made is None else torch.tensor([made]),
    )


def _read_words(base: _Base) -> tuple[int, int]:
    """The tokens that stand for an image and for the state. Raises unless the base knows its tokenizer's."""
    alone = {word: base.tokenizer(word) for word in (IMAGE, _STATE, _ACTION)}
    entries = (("vision_start_token_id", 151652), ("image_token_id", 151655))
    start, image = (base.model.number(name, own, MOST_VOCABULARY) for name, own in entries)
    if alone[IMAGE][:2] != [start, image] or any(len(alone[word]) > 1 for word in (_STATE, _ACTION)):
        raise CheckpointError(
            f"{base.folder}: its tokenizer makes {alone!s:.200}; expected {start} (vision_start_token_id) and {image}"
            " (image_token_id) of an image, and a token each of the state and of an action. It is of another model."
        )
    return image, alone[_STATE][0]


def _view(key: str) -> str:
    """What a camera is called in the prompt."""
    name = key.replace("observation.images.", "")
    return _VIEWS.get(name, name.replace("_", " ") if "view" in name else f"{name} view")


def _read_weights(shared: LeRobotConfig, options: LoadOptions, model: Settings) -> dict[str, Tensor]:
    """The weights under the names of ``WallX``, without those of experts that read nothing."""
    text = vla.part_of(model, "text_config")
    tied = model.flag("tie_word_embeddings", False)
    others = [f".moe.experts.{number}." for number in range(2, text.number("num_experts", 4, MOST))]
    saved = read_weights(shared, options, *others, *([] if tied else [_HEAD]))
    own = {name.removeprefix("model."): value for name, value in saved.items()}
    head = own.pop(_HEAD, None)
    if head is not None and not torch.equal(own.setdefault(_EMBEDDING, head), head):
        found = f"{_HEAD} and {_EMBEDDING}, which differ, and tie_word_embeddings says that they are one"
        raise CheckpointError(f"{shared.directory}: its weights have {found}. Save it again.")
    return {renamed(name, _RENAMED): value for name, value in rebuilt_weights(own).items()}


def _sampler(settings: Settings, options: LoadOptions) -> SamplerTable:
    """Ten steps: no entry of lerobot's says how many."""
    return vla.flow_matching(integration_steps(settings, options, "steps", 10), options, start=0.0, end=1.0)
