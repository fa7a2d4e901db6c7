"""GR00T N1.7 as NVIDIA saves it: a directory to module and ``PolicySpec``; cameras, words and state to robot actions.

Neither its code nor transformers is needed. Sizes of the backbone and its tokenizer are those of its folder, which the
code needs, too. On the robot the original computes in bfloat16, and here all is float32. Source: ``Gr00tPolicy`` of
NVIDIA/Isaac-GR00T at 65cc4a1, and its later ``letter_box_transform``.
"""

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import LARGEST, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32
from ttscompile.frontends.settings import Settings, read_json

from .groot_pictures import Pictures, read_pictures
from .instruction import encoder_folders
from .lerobot import groot as shared, qwen3_vl as qwen, vla
from .lerobot.config import ACTION, CONFIG, MOST, MOST_CAMERAS, MOST_LETTERS, STATE, LeRobotConfig
from .lerobot.groot_steps import Actions, grouped_actions
from .lerobot.processors import Normalizer, Processors, Statistics
from .lerobot.tokenizer import file_of_name
from .networks.groot import Denoiser, GrootConfig, Prefix
from .shards import read_part

_PROCESSOR, _STATISTICS, _EMBODIMENTS = "processor_config.json", "statistics.json", "embodiment_id.json"
_TRAINED = "experiment_cfg/dataset_statistics.json"
_BACKBONE, _TAG, _VIDEO = "nvidia/Cosmos-Reason2-2B", "embodiment_tag", "video."
_MOST_FRAMES, _MOST_GROUPS, _EPSILON = 64, 256, 1e-8
_NEAR, _RELATIVE = 1e-8, 1e-5
"""How near two ends of a range are for which it is none, as numpy's ``isclose`` has it."""
_NUMBERS = {
    "simpler_env_google": 0,
    "simpler_env_widowx": 1,
    "libero_sim": 2,
    **dict.fromkeys(("new_embodiment", "robocasa_panda_omron", "robocasa_gr1_tabletop"), 10),
    "unitree_g1_sonic": 11,
    "oxe_droid_relative_eef_relative_joint": 24,
    **dict.fromkeys(("real_g1_relative_eef_relative_joints", "unitree_g1_full_body_with_waist_height_nav_cmd"), 25),
    **dict.fromkeys((f"real_r1_pro_sharpa_relative_eef{end}" for end in ("", "_human", "_maxinsights", "_mecka")), 26),
    **dict.fromkeys((f"xdof_relative_eef_relative_joint{end}" for end in ("", "_subtask")), 27),
}
"""Of an embodiment that ``embodiment_id.json`` does not name."""


class _Robot(NamedTuple):
    """What a directory says of one embodiment.

    Attributes:
        kind: its name.
        number: of its weights.
        modality: its entries of ``modality_configs``.
        statistics: by part and group.
    """

    kind: str
    number: int
    modality: Settings
    statistics: Settings


class _Group(NamedTuple):
    """Of a state.

    Attributes:
        waves: whether it becomes its sine and its cosine.
        averaged: whether mean and deviation normalise it.
        first: mean, or the lower end of the range, ``[d]``.
        second: deviation, or the upper end.
    """

    waves: bool
    averaged: bool
    first: Tensor
    second: Tensor


def load(directory: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its directory; see ``Family.load``."""
    base, own = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: "), _processor(directory)
    base.require(backbone_model_type="qwen", strict_action_padding_mask=False)
    own.require(use_tactile=False)
    robot = _robot(directory, base, own)
    video = robot.modality.part("video")
    cameras, (frames, consecutive) = [f"{_VIDEO}{key}" for key in _names(video)], _frames(video)
    kept = [key.removeprefix(_VIDEO) for key in vla.kept_cameras(directory, cameras, options)]
    if (count := frames * len(kept)) > MOST_CAMERAS:
        raise video.refusal("delta_indices", f"{MOST_CAMERAS} pictures of all cameras together at most")
    groups, actions = _groups(own, robot), _actions(directory, own, robot)
    name = base.text("model_name", _BACKBONE, MOST_LETTERS)
    backbone = qwen.find_backbone(name, encoder_folders(options.encoders, directory))
    pictures = read_pictures(base, own, kept, qwen.read_resizing(backbone))
    _warn(directory, pictures)
    config = _config(base, own, backbone, [*pictures.seen.values()] * frames)
    encoding = _States(groups, config.state, own.flag("clip_outliers", True), own.flag("exclude_state", False))
    numbers, action = sum(len(each.first) for each in groups), len(actions.relative)
    if encoding.width > config.state or action > config.actions:
        found = f"{robot.kind} has a state of {encoding.width} numbers and an action of {action}"
        raise own.error(f"{found}; expected max_state_dim {config.state} and max_action_dim {config.actions} at most")
    executed = min(actions.executed or config.horizon, config.horizon)
    features: dict[str, tuple[str, tuple[int, ...]]] = {STATE: ("STATE", (numbers,))}
    features |= {f"{_VIDEO}{key}": ("VISUAL", (3, *size)) for key, size in pictures.given.items()}
    features[ACTION] = ("ACTION", (action,))
    around = LeRobotConfig(directory, Settings({"type": "groot"}, base.where), features, 1, config.horizon, executed)
    spoken = shared.Spoken(name, backbone, count, count, own.flag("formalize_language", True), "")
    saved = partial(_weights, directory)
    network, told, sizes, task = shared.rebuilt(config, spoken, saved, robot.number, options.task, directory)
    ways = Processors({}, actions.statistics, {STATE: "state"}, {}, relative=actions.relative, poses=actions.poses)
    prefix = Prefix(network, pictures.network(frames))
    encoder = vla.Gathered(around, ways, prefix, config.state, task, normalizer=encoding, frames=frames)
    table = partial(vla.in_buckets, base, 4, base.number("num_timestep_buckets", 1000, 2**20), actions.bounded)
    spec = vla.vla_spec(around, ways, None, "stretch", sizes, options, table, told)
    observations = dict(spec.observations)
    for key, size in pictures.given.items():
        shape = (frames, 3, *size)
        observations[f"{_VIDEO}{key}"] = ObservationSpec(shape, bounds=(0.0, 1.0), window=consecutive)
    observations["state"] = replace(observations["state"], bounds=_usual(groups))
    source = {**spec.source, "format": "groot", "policy": "GR00T N1.7", "embodiment": robot.kind}
    source |= {"state": _listed(robot, "state"), "action": _listed(robot, "action")}
    return EncodedDenoiser(encoder, Denoiser(network)).eval(), replace(spec, observations=observations, source=source)


def _config(base: Settings, own: Settings, backbone: qwen.Backbone, seen: list[tuple[int, int]]) -> GrootConfig:
    """Sizes and variant; ``seen`` are height and width of each picture as the backbone sees it."""
    padded = own.number("max_state_dim", 29, MOST), own.number("max_action_dim", 29, MOST)
    config = shared.read_config(base, backbone.model, seen, padded)
    stacked = len(config.language.vision.stacked)
    if config.language.text.layers <= stacked:
        # Its version of transformers then changes what it has noted of the last layer.
        raise base.refusal("select_layer", f"more than the {stacked} layers of deepstack", 12)
    return config


def tokenizer_file(directory: Path, encoders: str | os.PathLike[str] | None) -> Path | None:
    """The backbone's tokenizer, if it is on this machine; see ``Family``."""
    name = Settings(read_json(directory / CONFIG), f"{directory / CONFIG}: ").text(
        "model_name", _BACKBONE, MOST_LETTERS
    )
    return file_of_name(name, directory, encoders)


def _warn(directory: Path, pictures: Pictures) -> None:
    if not pictures.way.padded and any(height != width for height, width in pictures.given.values()):
        warnings.warn(
            f"{directory}: pictures that are no squares keep their proportions, and nothing is beside them, as"
            f" letter_box_transform is false in {_PROCESSOR}. The code of NVIDIA before it obeyed that entry always"
            " padded them: if such code trained this policy, write true there, and convert again.",
            stacklevel=5,
        )


def _processor(directory: Path) -> Settings:
    """Entries of the processor, which a training saves in a folder of its own, too."""
    inner = directory / "processor" / _PROCESSOR
    path = directory / _PROCESSOR
    path = inner if inner.is_file() and not path.is_file() else path
    return Settings(read_json(path), f"{path}: ").part("processor_kwargs")


def _robot(directory: Path, base: Settings, own: Settings) -> _Robot:
    """The embodiment that ``config.json`` names, or else the only one, or else the one that it was trained on last."""
    folder = directory if (directory / _PROCESSOR).is_file() else directory / "processor"
    statistics = Settings(read_json(folder / _STATISTICS), f"{folder / _STATISTICS}: ")
    modalities, trained = own.part("modality_configs"), directory / _TRAINED
    known = sorted(set(modalities.values) & set(statistics.values))
    last = sorted(set(known) & set(read_json(trained))) if len(known) > 1 and trained.is_file() else known
    kind = base.values.get(_TAG, last[0] if len(last) == 1 else None)
    if kind not in known:
        told = f"this policy has the embodiments {', '.join(known) or 'none'}, and {_TAG} is {kind!r:.80}"
        raise base.error(
            f'{told}. Write the name of your robot\'s into this file: "{_TAG}": "{(known or ["NAME"])[0]}"'
        )
    path = folder / _EMBODIMENTS
    numbers: dict[str, Any] = {**_NUMBERS, **(read_json(path) if path.is_file() else {})}
    if type(numbers.get(kind)) is not int or numbers[kind] < 0:
        raise CheckpointError(f"{path}: {kind} is {numbers.get(kind)!r:.80}; expected the number of its weights.")
    return _Robot(kind, numbers[kind], modalities.part(kind), statistics.part(kind))


def _names(own: Settings) -> list[str]:
    """Of cameras, or of groups of numbers, in their order."""
    names = own.values.get("modality_keys")
    if not isinstance(names, list) or not 0 < len(names) <= _MOST_GROUPS:
        raise own.refusal("modality_keys", "names")
    if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise own.refusal("modality_keys", "different names")
    return names


def _chosen(own: Settings, entry: str) -> list[str]:
    """Groups that an entry names; none where it is null."""
    found = own.values.get(entry) or []
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise own.refusal(entry, "names, or null")
    return found


def _frames(own: Settings) -> tuple[int, bool]:
    """How many frames of a camera are shown, and whether they follow on each other up to now."""
    steps = own.values.get("delta_indices")
    if (
        not isinstance(steps, list)
        or not 0 < len(steps) <= _MOST_FRAMES
        or any(type(each) is not int for each in steps)
    ):
        raise own.refusal("delta_indices", f"1 to {_MOST_FRAMES} whole numbers")
    return len(steps), steps == list(range(1 - len(steps), 1))


def _groups(own: Settings, robot: _Robot) -> list[_Group]:
    """How the parts of a state are normalised."""
    state = robot.modality.part("state")
    if _frames(state)[0] != 1:
        raise state.refusal("delta_indices", "one: a state of several frames is not rebuilt here")
    waves = _chosen(state, "sin_cos_embedding_keys") if own.flag("apply_sincos_state_encoding", False) else []
    averaged, found = _chosen(state, "mean_std_embedding_keys"), list[_Group]()
    ends = ("q01", "q99") if own.flag("use_percentiles", False) else ("min", "max")
    for name in _names(state):
        part = robot.statistics.part("state").part(name)
        first, second = (vector(part, each) for each in (("mean", "std") if name in averaged else ends))
        if len(first) != len(second):
            raise part.error(f"its statistics have {len(first)} and {len(second)} numbers; expected as many")
        found.append(_Group(name in waves, name in averaged, first, second))
    return found


def vector(own: Settings, name: str) -> Tensor:
    """Numbers of an entry, float64 ``[n]``."""
    value: Any = own.values.get(name)
    if isinstance(value, list) and 0 < len(value) <= MOST and all(type(one) in (int, float) for one in value):
        found = torch.tensor(value, dtype=torch.float64, device="cpu")
        if bool((found.abs() < LARGEST).all()):
            return found
    raise own.refusal(name, "finite numbers")


class _States(nn.Module):
    """A state ``[B, 1, Ds]``, each of its groups normalised in its way, padded to ``[B, 1, most]``.

    Args:
        clipped: whether what is out of its range is clipped.
        unread: whether zeros stand for all of it.
    """

    def __init__(self, groups: Sequence[_Group], most: int, clipped: bool, unread: bool) -> None:
        super().__init__()
        self.sizes, self.ways, made = list[int](), list[bool](), list[nn.Module]()
        # Sines and cosines stand side by side of each group of its own; the others may be normalised together.
        apart = [(number if group.waves else -1, group.averaged) for number, group in enumerate(groups)]
        for (number, averaged), pairs in groupby(zip(apart, groups, strict=True), lambda pair: pair[0]):
            both, waves = [(group.first, group.second) for _, group in pairs], number >= 0
            first, second = (torch.cat(ends) for ends in zip(*both, strict=True))
            self.sizes.append(len(first))
            self.ways.append(waves)
            made.append(nn.Identity() if waves else Normalizer(_way(averaged, first, second, clipped)))
        self.normalizers, self.most, self.unread = nn.ModuleList(made), most, unread
        self.width = sum(size * (1 + waves) for size, waves in zip(self.sizes, self.ways, strict=True))

    def forward(self, state: Tensor) -> Tensor:
        """See the class."""
        parts, pieces = list[Tensor](), torch.split(state, self.sizes, -1)
        for part, waves, normalizer in zip(pieces, self.ways, self.normalizers, strict=True):
            parts += [part.sin(), part.cos()] if waves else [normalizer(part)]
        whole = functional.pad(torch.cat(parts, -1), (0, self.most - self.width))
        return whole * 0 if self.unread else whole


def _way(averaged: bool, first: Tensor, second: Tensor, clipped: bool) -> Statistics:
    """Of float64, in which the original computes: a range of which little is left would be another in float32."""
    if averaged:
        still = second == 0  # what never moved stays as it is
        first, second = first.masked_fill(still, 0), second.masked_fill(still, 1)
        return Statistics("MEAN_STD", first, second, 0.0)
    still = (second - first).abs() <= _NEAR + _RELATIVE * first.abs()
    second = torch.where(still, first, second)
    return Statistics("MIN_MAX", first, second, _EPSILON, still=True, clipped=clipped)


def _usual(groups: Sequence[_Group]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Where the numbers of a state usually are."""
    both = [_way(each.averaged, each.first, each.second, False).usual_range for each in groups]
    low, high = (tuple(number for each in both for number in each[end]) for end in (0, 1))
    return low, high


def _actions(directory: Path, own: Settings, robot: _Robot) -> Actions:
    """How actions are unnormalised."""
    action = robot.modality.part("action")
    names, averaged = _names(action), _chosen(action, "mean_std_embedding_keys")
    if averaged and set(averaged) != set(names):
        raise action.refusal("mean_std_embedding_keys", "all groups of an action, or none")
    ends = ("q01", "q99") if own.flag("use_percentiles", False) else ("min", "max")
    told = {"modality_config": robot.modality.values, "raw_stats": robot.statistics.values}
    relative = {"use_relative_action": own.flag("use_relative_action", False)}
    settings = replace(robot.statistics, values={**told, **relative})
    return grouped_actions(directory, settings, ("mean", "std") if averaged else ends)


def _listed(robot: _Robot, part: str) -> str:
    """The groups of a state or an action and how many numbers each has, in their order."""
    own = robot.statistics.part(part)
    return ", ".join(f"{name} {len(vector(own.part(name), 'mean'))}" for name in _names(robot.modality.part(part)))


def _weights(directory: Path) -> dict[str, Tensor]:
    """Under the names of LeRobot."""
    saved = as_float32(read_part(directory, "", shared.UNREAD), f"{directory}: ")
    return {f"{shared.OWN}{name}": value for name, value in saved.items()}
