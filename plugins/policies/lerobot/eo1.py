"""LeRobot's ``eo1``: its directory to module and ``PolicySpec``; cameras, instruction and state to robot actions.

Neither lerobot nor transformers is needed. Source: ``EO1Policy.predict_action_chunk`` of huggingface/lerobot 0.6.
"""

from collections.abc import Mapping
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
from ttscompile.frontends.saved_weights import filled
from ttscompile.frontends.settings import Settings

from ..instruction import encoder_folders, language_model_folder
from ..networks.eo1 import ACTIVATIONS, EO1, Denoiser, EO1Config, Prefix
from ..networks.qwen25_vl import Piece, Qwen25VLConfig, rebuilt_weights
from . import vla
from .config import CONFIG, MOST_LAYERS, MOST_LETTERS, MOST_VOCABULARY, LeRobotConfig
from .policy import MASK, TOKENS, integration_steps, read_weights
from .processors import CONVERSATION, READ, Processors
from .qwen3_vl import END, IMAGE, TURN, Resizing, of_backbone, require_template
from .qwen25_vl import DEVIATION, KIND, MEAN, pieces, read_pictures, read_qwen25
from .resized_bytes import Filter, Shown

_MODEL = "Qwen/Qwen2.5-VL-3B-Instruct"
_LENGTH = 64
"""Tokens of an instruction, of a policy that none is compiled into; lerobot has no limit."""
_PIXELS, _MOST_PIXELS = {"min": 64 * 28 * 28, "max": 128 * 28 * 28}, 2**24
_MOST_RATIO = 200
_INNER, _HEAD = "vlm_backbone.", "lm_head.weight"
_SYSTEM = "<|im_start|>system\nYou are a helpful physical assistant.<|im_end|>\n"
_TOLD = Instruction(TOKENS, MASK, False, around=("", ""), never=("<|",))
"""With something around it, if only nothing, one that is too long is refused: lerobot reads it to its end."""
_STATE = ("<|state_start|>", "<|state_pad|>", "<|state_end|>")
_ACTIONS, _TASK = ("<|action_start|>", "<|action_pad|>", "<|action_end|>"), "<|vla|>"


class _Reader(NamedTuple):
    """How the backbone's processor reads images.

    Attributes:
        name: of the backbone.
        pixels: of a resized image, the fewest and the most.
        filter: what resizes it.
    """

    name: str
    pixels: tuple[int, int]
    filter: Filter


def load(directory: Path, entries: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory and the entries of its ``config.json``; see ``Family.load``."""
    shared = vla.read_vla_config(directory, {"chunk_size": 8, "n_action_steps": 8, **entries}, options)
    shared, processors = vla.read_vla_processors(shared)
    settings, reader = shared.settings, _read_reader(shared, processors)
    model, folders = vla.part_of(settings, "vlm_config"), encoder_folders(options.encoders, directory)
    folder = language_model_folder(reader.name, folders, KIND)
    language = read_qwen25(model)
    read_pictures(folder, language, model).require(image_mean=list(MEAN), image_std=list(DEVIATION))
    require_template(folder, "")  # its own words are left out where the first message is the system's
    sizes = [(shape[1], shape[2]) for shape in shared.cameras.values()]
    if wrong := [each for each in sizes if max(each) > _MOST_RATIO * min(each)]:
        told = f"a camera has images of {wrong[0][0]} x {wrong[0][1]} pixels, which its processor does not take"
        raise settings.error(f"{told}; expected sides of a ratio of {_MOST_RATIO} at most")
    shown = [Resizing(language.patch * language.merge, *reader.pixels)(*each) for each in sizes]
    language = language.of_images(shown)
    prompt, config = _prompt(folder, language, model), read_config(shared, language)
    numbers, task = {"actions": config.actions, "tokens": _LENGTH, "vocabulary": language.vocabulary}, None
    if options.task is not None:
        made = Tokenizer(folder, CheckpointError).of_task(options.task, _TOLD, MOST_VOCABULARY)
        if not made or max(made) >= language.vocabulary:
            found = (
                f"has the tokens {made!s:.80} of {language.vocabulary} that the backbone knows; expected some of them"
            )
            raise CheckpointError(f"{folder}: the task {options.task!r:.100} {found}.")
        task = torch.tensor([made])
    network = filled(lambda: EO1(config, prompt), _read_weights(shared, options, model), CONFIG, directory)
    seen = Shown(list(zip(sizes, shown, strict=True)), reader.filter, MEAN, DEVIATION)
    encoder = vla.Gathered(shared, processors, Prefix(network, seen), config.state, task)
    table = partial(_sampler, settings)
    spec = vla.vla_spec(shared, processors, None, "stretch", numbers, options, table, _TOLD)
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), spec


def read_config(shared: LeRobotConfig, language: Qwen25VLConfig) -> EO1Config:
    """Sizes and variant."""
    settings = shared.settings
    if language.text.width % 2:
        raise settings.error("the width of the language model is odd; expected an even one")
    return EO1Config(
        language=language,
        state=vla.padded_size(settings, "max_state_dim", shared.state_dim),
        actions=vla.padded_size(settings, "max_action_dim", shared.action_dim),
        layers=settings.number("num_action_layers", 2, MOST_LAYERS),
        activation=settings.choice("action_act", *ACTIVATIONS),
        periods=(vla.positive_number(settings, "min_period", 4e-3), vla.positive_number(settings, "max_period", 4.0)),
    )


def _read_reader(shared: LeRobotConfig, processors: Processors) -> _Reader:
    missing = [name for name in (CONVERSATION, READ) if name not in processors.own]
    if missing:
        raise CheckpointError(f"{shared.directory}: its preprocessor has no {' and no '.join(missing)}. Save it again.")
    told, own = (Settings(processors.own[name], f"{shared.directory}: {name}.") for name in (CONVERSATION, READ))
    told.require(chunk_size=shared.horizon)
    shown, known = _cameras(told), _cameras(shared.settings)
    if shown != known:
        expected = f"those of {CONFIG}, {', '.join(known)}, in their order. Save the policy again"
        raise told.error(f"input_features has the cameras {', '.join(shown) or 'none'}; expected {expected}")
    least, most = (own.number(f"image_{name}_pixels", count, _MOST_PIXELS) for name, count in _PIXELS.items())
    fast = own.flag("use_fast_processor", False)
    return _Reader(own.text("processor_name", _MODEL, MOST_LETTERS), (least, most), "torchvision" if fast else "pillow")


def _cameras(settings: Settings) -> list[str]:
    """Names of the cameras among the input features, in their order."""
    features = settings.part("input_features").values
    return [key for key, one in features.items() if isinstance(one, dict) and one.get("type") == "VISUAL"]


def _prompt(folder: Path, language: Qwen25VLConfig, model: Settings) -> list[Piece]:
    """What is around an instruction. LeRobot adds its own words to the tokenizer's."""
    tokenizer, image = Tokenizer(folder, CheckpointError), model.number("image_token_id", 151655, MOST_VOCABULARY)
    _, state, *_ = tokenizer.with_words([*_ACTIONS, *_STATE, _TASK])[3:]
    cameras = len(language.grids)
    before = tokenizer(f"{_SYSTEM}{TURN}\n{IMAGE * cameras}{''.join(_STATE)}")
    later = tokenizer(f"{_TASK}{END}\n<|im_start|>assistant\n{_ACTIONS[0]}")
    if before.count(image) != cameras or max(*before, *later) >= language.vocabulary:
        raise CheckpointError(
            f"{folder}: its tokenizer makes {before.count(image)} tokens {image} (image_token_id) of {cameras} images,"
            f" and tokens up to {max(*before, *later)} of {language.vocabulary}. It is of another model."
        )
    return [*pieces(before, image, state), "task", tuple(later)]


def _read_weights(shared: LeRobotConfig, options: LoadOptions, model: Settings) -> dict[str, Tensor]:
    """The weights under the names of ``EO1``."""
    either = {**vla.part_of(model, "text_config").values, **model.values}
    tied = Settings(either, model.where).flag("tie_word_embeddings", False)
    saved = read_weights(shared, options, *([] if tied else [_HEAD]))
    weights = {name.removeprefix("model."): value for name, value in saved.items()}
    others, backbone = of_backbone(weights, _INNER, rebuilt_weights)
    return others | backbone


def _sampler(settings: Settings, options: LoadOptions) -> SamplerTable:
    steps = integration_steps(settings, options, "num_denoise_steps", 10)
    return vla.flow_matching(steps, options, start=1.0, end=0.0)
