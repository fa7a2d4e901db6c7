"""Octo, whole, from the folder that its ``save_pretrained`` wrote: cameras and instruction to a robot's actions.

That is ``config.json``, ``example_batch.msgpack``, ``dataset_statistics.json`` and ``STEP/default/checkpoint``. The
last is one msgpack file of all arrays, since they were whole on each device (flax's ``save_args_from_target``), so
neither JAX nor orbax is needed. Source: ``OctoModel.sample_actions`` of octo-models/octo at 241fb35.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ttscompile.core.spec import WITHOUT, Affine, ChunkSpec, Instruction, ObservationSpec, PolicySpec
from ttscompile.core.tokenizer import find_tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import loops_of
from ttscompile.frontends.saved_weights import filled
from ttscompile.frontends.scheduler import MOST_STEPS
from ttscompile.frontends.settings import Settings, read_json

from .flax_files import Tree, for_torch, leaves, read_tree
from .instruction import encoder_folders, task_tokens
from .networks.octo_network import (
    DEPTH,
    MASK,
    PADDING,
    TOKENS,
    Head,
    Octo,
    OctoConfig,
    OctoDenoiser,
    OctoObserved,
    Stem,
)
from .networks.t5 import Words
from .octo_loop import loop_table, schedule
from .quantiles import STATISTICS, read_moments

CONFIG, EXAMPLE, CHECKPOINT = "config.json", "example_batch.msgpack", "checkpoint"

_MOST, _MOST_LAYERS, _MOST_PIXELS, _MOST_TOKENS, _MOST_CHUNK = 2**16, 512, 4096, 2**14, 4096
"""Sizes above these are no policy's. Whether the weights are there for them is asked later."""
_MOST_EXAMPLE = 2**26
_MOST_LETTERS, _MOST_STEMS = 200, 16
_SHRINKS = 16
"""Of SmallStem's convolutions; its patch is so many times larger than that of its embedding."""
_CONVOLUTIONS = {"kernel_sizes": [3] * 4, "strides": [2] * 4, "features": [32, 96, 192, 384], "padding": [1] * 4}
_PATCHES = {"SmallStem": 32, "SmallStem16": 16, "SmallStem32": 32}
_T5 = "hf_model."
_REMEDY = "Give the folder as Octo's save_pretrained wrote it."
_AGAIN = "Save it once more, from one process: OctoModel.load_pretrained(folder).save_pretrained(step, new_folder)."
_BUILD = "Build the network in PyTorch and use ttscompile.compile_denoiser."


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    settings = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: ", _REMEDY)
    example = read_tree(directory / EXAMPLE, _MOST_EXAMPLE)
    without = tuple(options.without_cameras or ())
    weights = _weights(directory)
    config = _config(settings, _Example(directory / EXAMPLE, example), weights, without)
    left = _left_out(settings, config)
    kept = {name: value for name, value in weights.items() if not name.startswith(left)}
    network = filled(lambda: Octo(config), kept, CONFIG, directory)
    task = None if options.task is None else _task(directory, settings, config.words, options)
    betas, signal = schedule(config.head.steps)
    loops = loops_of(lambda asked: loop_table(config.head, betas, signal, asked, settings.where), options, "ddpm")
    name, normalizer = _normalizer(directory, settings, config.head.actions)
    source = {"format": "octo", "policy": "Octo", "statistics": name}
    source |= {} if options.task is None else {"task": options.task}
    source |= {WITHOUT: ", ".join(without)} if without else {}
    spec = PolicySpec(
        sample=(config.head.horizon, config.head.actions),
        observations=_observed(config, _Example(directory / EXAMPLE, example), task is None),
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(config.head.actions, 0, config.head.horizon, normalizer, ranged=False),
        source={**source, **loops.source},
        instruction=Instruction(TOKENS, MASK, False) if task is None else None,
    )
    observed = OctoObserved(network, config, task)
    return EncodedDenoiser(observed, OctoDenoiser(network, config, signal.tolist())).eval(), spec


class _Example:
    """Shapes of what the training was shown, ``[1, T, ...]`` of an observation."""

    def __init__(self, path: Path, tree: Tree) -> None:
        self.path = path
        parts = (tree.get("observation"), tree.get("task", tree.get("tasks")))
        if not all(isinstance(part, dict) for part in parts):
            raise self.error("holds no observation or no task")
        self.observation, self.task = ({key: np.shape(value) for key, value in leaves(part)} for part in parts)  # type: ignore[arg-type]
        self.padding = next((key for key in (PADDING, "pad_mask") if len(self.observation.get(key, ())) == 2), "")
        if not self.padding or not 1 <= self.window <= _MOST_LAYERS:
            raise self.error(f"its observation has no {PADDING} [1, T]")

    @property
    def window(self) -> int:
        """T."""
        return int(self.observation[self.padding][1])

    def image(self, key: str) -> tuple[int, int, int]:
        """Height, width and channels."""
        shape = self.observation[key]
        if len(shape) != 5 or shape[1] != self.window or not all(1 <= n <= _MOST_PIXELS for n in shape[2:]):
            raise self.error(f"its {key:.80} has shape {shape}; expected [1, {self.window}, height, width, channels]")
        return int(shape[2]), int(shape[3]), int(shape[4])

    def error(self, what: str) -> CheckpointError:
        """The error for what is wrong with it."""
        return CheckpointError(f"{self.path}: {what}. {_REMEDY}")


def _config(settings: Settings, example: _Example, weights: Mapping[str, Tensor], without: Sequence[str]) -> OctoConfig:
    model = settings.part("model")
    layers = model.part("transformer_kwargs")
    width = model.number("token_embedding_size", most=_MOST)
    heads = layers.number("num_attention_heads", most=_MOST)
    if width % heads:
        raise layers.refusal("num_attention_heads", f"one that divides {width}, token_embedding_size")
    _built(layers).require(add_position_embedding=False)
    readouts = model.part("readouts")
    if len(readouts.values) != 1:
        raise _built(model).refusal("readouts", "one, for the actions")
    readout = str(next(iter(readouts.values)))
    stems = _stems(model, example)
    unknown = sorted(set(without) - {key for stem in stems.values() for key in stem.keys})
    kept = {name: stem for name, stem in stems.items() if not set(stem.keys) & set(without)}
    torn = [key for stem in stems.values() if set(stem.keys) & set(without) for key in stem.keys if key not in without]
    if unknown or torn or not kept:
        there = ", ".join(key for stem in stems.values() for key in stem.keys)
        why = "all" if not kept else ", ".join(unknown) or f"some of those that one network reads with {torn[0]}"
        raise CheckpointError(f"{settings.where}the cameras are {there}; {why} cannot be left out. Leave out others.")
    longest = model.number("max_horizon", most=_MOST_LAYERS)
    if example.window > longest:
        raise model.refusal("max_horizon", f"{example.window} at least, the window of {EXAMPLE}")
    return OctoConfig(
        width=width,
        hidden=layers.number("mlp_dim", most=_MOST),
        layers=layers.number("num_layers", most=_MOST_LAYERS),
        heads=heads,
        window=example.window,
        longest=longest,
        words=_words(model, example, weights),
        head=_head(model, readout),
        readout=(readout, readouts.number(readout, most=_MOST_TOKENS)),
        stems=kept,
        repeated=model.flag("repeat_task_tokens", False),
        right=model.flag("use_correct_attention", False),
    )


def _of_class(entry: Any, where: Settings, name: str, *classes: str) -> tuple[str, Settings]:
    """Class and arguments of a ``ModuleSpec``, whose class has to be one of these."""
    whole = Settings({name: entry}, where.where, where.remedy).part(name)
    kind = whole.values.get("name")
    if kind not in classes:
        told = f"{name:.80} is a {kind!s:.80}; expected {' or '.join(classes)}: another is not rebuilt here"
        raise CheckpointError(f"{where.where}{told}. {_BUILD}")
    if whole.values.get("args"):
        raise whole.refusal("args", "arguments by name")
    return str(kind), whole.part("kwargs")


def _built(own: Settings) -> Settings:
    """The same where what is refused is another network, and nothing is wrong with the folder."""
    return replace(own, remedy=_BUILD)


def _stems(model: Settings, example: _Example) -> dict[str, Stem]:
    """The image tokenizers by name."""
    tokenizers = model.part("observation_tokenizers")
    if not 1 <= len(tokenizers.values) <= _MOST_STEMS:
        raise model.refusal("observation_tokenizers", f"1 to {_MOST_STEMS} of them")
    found = {}
    for name, entry in tokenizers.values.items():
        own = _of_class(entry, tokenizers, str(name), "ImageTokenizer")[1]
        for key in ("task_film_keys", "use_token_learner"):
            if own.values.get(key):
                raise _built(own).refusal(key, "none (FiLM and token learners are not rebuilt here)")
        keys = _matching(own, "obs_stack_keys", ["image_.*", "depth_.*"], example.observation)
        if keys:  # the original passes over a tokenizer that reads nothing
            found[str(name)] = _stem(own, example, keys)
    if not found:
        raise model.refusal("observation_tokenizers", f"one that reads something in {EXAMPLE}")
    return found


def _stem(own: Settings, example: _Example, keys: tuple[str, ...]) -> Stem:
    kind, encoder = _of_class(own.values.get("encoder"), own, "encoder", *_PATCHES)
    _built(encoder).require(use_film=False)
    sizes = {example.image(key)[:2] for key in keys}
    if len(sizes) != 1:
        raise own.error(f"{', '.join(keys)} have several sizes in {EXAMPLE}; expected one")
    goals = {**example.observation, **example.task}
    wanted = _matching(own, "task_stack_keys", [], goals)
    lists = [encoder.values.get(name, default) for name, default in _CONVOLUTIONS.items()]
    numbers = all(isinstance(one, list) and all(type(n) is int and 0 <= n <= _MOST for n in one) for one in lists)
    if (
        not numbers
        or len({len(one) for one in lists}) != 1
        or not 1 <= len(lists[0]) <= _SHRINKS
        or any(0 in one for one in lists[:3])
    ):
        raise encoder.error(f"{', '.join(_CONVOLUTIONS)} are {lists!r:.200}; expected lists of sizes, of one length")
    kernels, strides, features, padding = lists
    if any(n % 32 for n in features):
        raise encoder.refusal("features", "multiples of 32, the groups of the norms")
    (height, width) = next(iter(sizes))
    patch = encoder.number("patch_size", _PATCHES[kind], _MOST_PIXELS) // _SHRINKS
    sides = []
    for side in (height, width):
        for kernel, stride, beside in zip(kernels, strides, padding, strict=True):
            side = (side + 2 * beside - kernel) // stride + 1
        sides.append(side // patch if patch else 0)
    if min(sides) < 1 or sides[0] * sides[1] > _MOST_TOKENS:
        raise encoder.error(f"images of {height} x {width} become {sides} tokens; expected 1 to {_MOST_TOKENS}")
    return Stem(
        keys=keys,
        kind=kind,
        channels=(sum(example.image(key)[2] for key in keys), sum(int(goals[key][-1]) for key in wanted)),
        features=tuple(features),
        layers=tuple(zip(kernels, strides, padding, strict=True)),
        patch=patch,
        out=encoder.number("num_features", 512, _MOST),
        imagenet=encoder.choice("img_norm_type", "default", "imagenet") == "imagenet",
        tokens=sides[0] * sides[1],
    )


def _matching(own: Settings, name: str, default: list[str], there: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys of images that begin as one of these says, in order; ``.*`` at an end says no more than that."""
    wanted = own.values.get(name, default)
    plain = isinstance(wanted, list) and all(
        isinstance(one, str) and re.fullmatch(r"\w{1,80}(\.\*)?", one) for one in wanted
    )
    if not plain:
        raise own.refusal(name, "names, or beginnings of names with .* behind")
    starts = tuple(one.removesuffix(".*") for one in wanted)
    # Beside images the masks of the original have such names, and are deeper in the tree.
    return tuple(sorted(key for key in there if starts and key.startswith(starts) and "." not in key))


def _words(model: Settings, example: _Example, weights: Mapping[str, Tensor]) -> Words:
    """T5's sizes are those of its weights, since the original takes them from a model on the hub, of this name."""
    tokenizers = model.part("task_tokenizers")
    if len(tokenizers.values) != 1:
        raise _built(model).refusal("task_tokenizers", "one, of language")
    name, entry = next(iter(tokenizers.values.items()))
    own = _of_class(entry, tokenizers, str(name), "LanguageTokenizer")[1]
    encoder = own.values.get("encoder")
    if not isinstance(encoder, str) or "t5" not in encoder:
        raise _built(own).refusal("encoder", "a T5: another is not rebuilt here")
    length = example.task.get("language_instruction.input_ids", ())
    if len(length) != 2 or not 1 <= length[1] <= _MOST_TOKENS:
        raise example.error("its task has no language_instruction.input_ids [1, L]")
    before = f"octo_transformer.task_tokenizers_{name}.{_T5}"
    attention, feed = (f"{before}encoder.block.0.layer.{part}" for part in ("0.SelfAttention.", "1.DenseReluDense."))

    def shape(what: str) -> tuple[int, int]:
        value = weights.get(what)
        if value is None or value.ndim != 2 or not value.numel():
            found = "none" if value is None else f"shape {tuple(value.shape)}"
            raise own.error(f"no matrix {what:.200}, which T5 of 2019 has; found {found}")
        return value.shape[0], value.shape[1]

    buckets, heads = shape(f"{attention}relative_attention_bias.weight")
    inside = shape(f"{attention}q.weight")[0]
    if buckets % 4 or inside % heads:
        raise own.error(f"T5 has {buckets} buckets of distances, and heads of {inside / heads} numbers")
    vocabulary, width = shape(f"{before}shared.weight")
    layers = {rest.split(".")[0] for key in weights if (rest := key.removeprefix(f"{before}encoder.block.")) != key}
    hidden = shape(f"{feed}wi.weight")[0]
    return Words(str(name), int(length[1]), vocabulary, width, hidden, len(layers), heads, inside, buckets)


def _head(model: Settings, readout: str) -> Head:
    heads = model.part("heads")
    kwargs = _of_class(heads.values.get("action"), heads, "action", "DiffusionActionHead")[1]
    _built(kwargs).require(readout_key=f"readout_{readout}", use_map=False, use_layer_norm=True)
    bound = kwargs.values.get("max_action", 5.0)
    if type(bound) not in (int, float) or not 0 < bound <= _MOST:
        raise kwargs.refusal("max_action", "a positive number")
    waves = kwargs.number("time_dim", 32, _MOST)
    if waves % 2:
        raise kwargs.refusal("time_dim", "an even number")
    old = "pred_horizon" in kwargs.values
    return Head(
        horizon=kwargs.number("pred_horizon" if old else "action_horizon", 1, _MOST_CHUNK),
        actions=kwargs.number("action_dim", 7, _MOST),
        width=kwargs.number("hidden_dim", 256, _MOST),
        waves=waves,
        blocks=kwargs.number("num_blocks", 3, _MOST_LAYERS),
        steps=kwargs.number("diffusion_steps", 20, MOST_STEPS),
        bound=float(bound),
    )


def _left_out(settings: Settings, config: OctoConfig) -> tuple[str, ...]:
    """How the names of weights begin whose images are not observed."""
    every = settings.part("model").part("observation_tokenizers").values
    absent = [str(name) for name in every if name not in config.stems]
    parts = [(f"observation_tokenizers_{one}.", f"obs_{one}_projection.", f"obs_{one}_pos_embedding") for one in absent]
    return tuple(f"octo_transformer.{part}" for each in parts for part in each)


def _weights(directory: Path) -> dict[str, Tensor]:
    """Those of the last step that was saved, as the original takes them."""
    steps = [int(each.name) for each in directory.iterdir() if each.name.isdecimal() and each.is_dir()]
    if not steps:
        raise CheckpointError(f"{directory}: no folder of a step, 300000 say, is in it. {_REMEDY}")
    folder = directory / str(max(steps)) / "default"
    if not (folder / CHECKPOINT).is_file():
        found = "arrays in files of their own (tensorstore)" if folder.is_dir() else "none"
        raise CheckpointError(f"{folder}: expected its file {CHECKPOINT} with all arrays; found {found}. {_AGAIN}")
    return for_torch(read_tree(folder / CHECKPOINT), folder / CHECKPOINT, _AGAIN)


def _observed(config: OctoConfig, example: _Example, told: bool) -> dict[str, ObservationSpec]:
    found = {}
    for key in (key for stem in config.stems.values() for key in stem.keys):
        height, width, channels = example.image(key)
        bounds = None if key.startswith(DEPTH) else (0.0, 1.0)
        found[key] = ObservationSpec((config.window, channels, height, width), bounds=bounds)
    if config.window > 1:
        found[PADDING] = ObservationSpec((config.window,), dtype="bool", window=False, bounds=(0.0, 1.0))
    if told:
        words, last = (config.words.length,), float(config.words.vocabulary - 1)
        found[TOKENS] = ObservationSpec(words, dtype="int64", window=False, bounds=(0.0, last))
        found[MASK] = ObservationSpec(words, dtype="bool", window=False, bounds=(0.0, 1.0))
    return found


def _task(directory: Path, settings: Settings, words: Words, options: LoadOptions) -> tuple[Tensor, Tensor]:
    """Tokens and mask of the instruction that is compiled in; the original reads the padding's, too."""
    entry = settings.values.get("text_processor")
    own = _of_class(entry, settings, "text_processor", "HFTokenizer")[1]
    _built(own).require(encode_with_model=False)
    name, file = own.text("tokenizer_name", "t5-base", _MOST_LETTERS), tokenizer_file(directory, options.encoders)
    folder = None if file is None else file.parent
    tokens = task_tokens(options.task or "", name, folder, words.length, words.vocabulary)
    rows, mask = padded([tokens], words.length)
    return torch.from_numpy(rows), torch.from_numpy(mask)


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The tokenizer of its T5, if it is on this machine, in a folder of its name or where a T5 or the policy is."""
    settings = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: ", _REMEDY)
    own = _of_class(settings.values.get("text_processor"), settings, "text_processor", "HFTokenizer")[1]
    name = Path(own.text("tokenizer_name", "t5-base", _MOST_LETTERS)).name
    places = [place for each in encoder_folders(encoders, directory) for place in (each / name, each)]
    return next((path for place in places if (path := find_tokenizer(place)) is not None), None)


def _normalizer(directory: Path, settings: Settings, actions: int) -> tuple[str, Affine | None]:
    """Of the actions; the original is told at each call of which data set, and that they have mean 0."""
    data = settings.values.get("dataset_kwargs")
    for where in (data, data.get("oxe_kwargs")) if isinstance(data, dict) else ():
        own = Settings(where if isinstance(where, dict) else {}, f"{settings.where}dataset_kwargs.", _BUILD)
        own.require(action_proprio_normalization_type="normal")
    return read_moments(directory / STATISTICS, actions)
