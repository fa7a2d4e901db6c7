"""What LeRobot's own steps for GR00T N1.7 do around the policy: state, cameras, words, images and actions.

Source: ``lerobot.policies.groot.processor_groot`` of huggingface/lerobot 0.6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ttscompile.core.poses import NUMBERS, Pose
from ttscompile.core.tokenizer import TASK
from ttscompile.errors import CheckpointError
from ttscompile.frontends.settings import Settings

from ..networks.image_geometry import ResizeCrop
from . import processors as lerobot
from .config import ACTION, MOST_LETTERS, MOST_PIXELS, STATE

(_PACK, _UNPACK, _DECODE), _ENCODE = lerobot.GROOT, "groot_n1_7_vlm_encode_v1"
_OLD = ("groot_pack_inputs_v3", "groot_eagle_encode_v3", "groot_eagle_collate_v3", "groot_action_unpack_unnormalize_v1")
OLD = "of GR00T N1.5, which lerobot itself reads no longer than 0.5.1. Train a policy of GR00T N1.7"
_MOST_FRAMES, _EPSILON, _MEAN = 64, 1e-8, "mean"
_CAMERAS, _CAMERA, _CAMERA_ALONE = "observation.images", "observation.images.", "observation.image"
_POSES = ("xyz_rot6d", "xyz+rot6d")
"""Both names of the one format of poses that lerobot decodes."""
_LIBERO, _LIBERO_STEPS, _LIBERO_NUMBERS = "libero_sim", 8, 7
"""An embodiment of which lerobot executes so many actions of a chunk."""


@dataclass(frozen=True, kw_only=True)
class GrootProcessors(lerobot.Processors):
    """What the two pipelines of a policy do.

    Attributes:
        cameras: the policy's names, in the order in which they are shown.
        frames: that a camera shows of the one image that there is.
        embodiment: number of the robot among those that the policy was trained with.
        kind: its name.
        plain: whether instructions are in lower case and without signs.
        bounded: whether actions are clipped before they are unnormalised.
        executed: actions of a chunk that mean something; None for all.
        grouped: whether actions are in groups that have names.
        gripper: which number of an action is the gripper's; None where none is known to be.
        padded: numbers of a state and of an action, padded.
        geometry: of the images.
    """

    cameras: tuple[str, ...]
    frames: int
    embodiment: int
    kind: str
    plain: bool
    bounded: bool
    executed: int | None
    grouped: bool
    gripper: int | None
    padded: tuple[int, int]
    geometry: Geometry


class Geometry(NamedTuple):
    """Sides of images in pixels: as they are first resized, what of that is kept in the middle, and what is seen."""

    edge: int
    crop: int
    target: int


class Seen(nn.Module):
    """Images in -1..1 ``[B, 3, edge, edge]``, of each camera, as the backbone sees them, in steps of bytes."""

    def __init__(self, geometry: Geometry) -> None:
        super().__init__()
        self.geometry, seen = geometry, (geometry.target, geometry.target)
        self.zoom = ResizeCrop(geometry.crop, geometry.crop, seen, mode="bicubic")

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """See the class."""
        edge, crop, target = self.geometry
        if edge == crop == target:
            return images
        start = slice((edge - crop) // 2, (edge - crop) // 2 + crop)
        pixels = (((image[:, :, start, start] + 1) * 127.5).round() for image in images)
        return [self.zoom(each).clamp(0, 255).round() / 127.5 - 1 for each in pixels]


def read_groot_processors(directory: Path, features: lerobot.Features) -> GrootProcessors:
    """The pipelines of a policy with these features."""
    before = lerobot.read_steps(directory, lerobot.PREPROCESSOR, (_PACK, _ENCODE, *_OLD))
    after = lerobot.read_steps(directory, lerobot.POSTPROCESSOR, (_UNPACK, _DECODE, *_OLD))
    if old := next((step["registry_name"] for step in (*before, *after) if step["registry_name"] in _OLD), None):
        raise CheckpointError(f"{directory}: the step {old} is {OLD}.")
    pack, encode = (_one(directory, before, name) for name in (_PACK, _ENCODE))
    decode = _one(directory, after, _UNPACK, _DECODE)
    packing = _settings(directory, pack)
    packing.require(state_horizon=1, language_key=TASK)
    kind, known = packing.values.get("embodiment_tag"), packing.values.get("embodiment_mapping")
    # An embodiment that is not there has the weights of number 0, in LeRobot's training, too; ``examined`` says so.
    number = known.get(kind, 0) if isinstance(known, dict) and isinstance(kind, str) else None
    if not isinstance(kind, str) or type(number) is not int or number < 0:
        expected = "expected the name of an embodiment, and in embodiment_mapping whole numbers by name"
        raise packing.error(f"embodiment_tag is {kind!r:.80}, embodiment_mapping {known!r:.200}; {expected}")
    read = packing.flag("normalize_min_max", True)
    clipped = packing.flag("clip_outliers", True)
    state = _statistics(directory, lerobot.state_of(directory, pack) if read else {}, STATE, features, clipped)
    actions, added = _actions(directory, decode, features), lerobot.relative_entries(directory, before, after, features)
    if added and ({*actions.relative} - {None} or actions.poses):
        raise CheckpointError(f"{directory}: {_DECODE} and the steps after it add the state to actions; expected one.")
    executed = actions.executed
    if kind == _LIBERO and executed is not None:
        executed = min(executed, _LIBERO_STEPS)
    encoding = _settings(directory, encode)
    return GrootProcessors(
        normalizers={} if state is None else {STATE: state},
        action=actions.statistics,
        renamed=lerobot.renamed_observations(directory, before, features),
        tokenizer={"tokenizer_name": encoding.text("model_name", "nvidia/Cosmos-Reason2-2B", MOST_LETTERS)},
        cameras=_cameras(packing, features),
        frames=1 if packing.values.get("video_horizon") is None else packing.number("video_horizon", most=_MOST_FRAMES),
        embodiment=number,
        kind=kind,
        plain=packing.flag("formalize_language", True),
        bounded=actions.bounded,
        executed=executed,
        grouped=decode["registry_name"] == _DECODE,
        gripper=actions.gripper,
        padded=(packing.number("max_state_dim", 132), packing.number("max_action_dim", 132)),
        geometry=_geometry(encoding),
        relative=added or actions.relative,
        poses=actions.poses,
    )


def _one(directory: Path, steps: list[dict[str, Any]], *names: str) -> dict[str, Any]:
    found = [step for step in steps if step["registry_name"] in names]
    if len(found) != 1:
        raise CheckpointError(f"{directory}: expected one step {' or '.join(names)}; found {len(found)}.")
    return found[0]


def _settings(directory: Path, step: Mapping[str, Any]) -> Settings:
    return Settings(step["config"], f"{directory}: {step['registry_name']}.")


def _cameras(packing: Settings, features: lerobot.Features) -> tuple[str, ...]:
    """In the order of the base's own names, of which lerobot knows one by another; or in alphabetical order."""
    known = sorted(key for key, (kind, _) in features.items() if kind == "VISUAL")
    # lerobot shows observation.image only where no other camera is there.
    there = [key for key in known if key.startswith(_CAMERAS)] or [key for key in known if key == _CAMERA_ALONE]
    if not there:
        raise packing.error(f"the cameras are {', '.join(known)}, of which lerobot shows none; expected {_CAMERA}NAME")
    own, found = packing.values.get("video_modality_keys") or [], list[str]()
    if not isinstance(own, list) or not all(isinstance(name, str) for name in own):
        raise packing.refusal("video_modality_keys", "names of cameras, or null")
    for name in own:
        also = [f"{_CAMERA}image2"] if name == "wrist_image" else []
        found += [key for key in (f"{_CAMERA}{name}", *also) if key in there][:1]
    return tuple(found or there)


def _geometry(encoding: Settings) -> Geometry:
    encoding.require(use_albumentations=False, letter_box_transform=False)
    target = encoding.size("image_target_size", None, MOST_PIXELS)
    if target is None or target[0] != target[1]:
        raise encoding.refusal("image_target_size", "height and width of a square")
    edge, share = target[0], encoding.values.get("crop_fraction")
    if encoding.values.get("shortest_image_edge") is not None:
        edge = encoding.number("shortest_image_edge", most=MOST_PIXELS)
    crop = encoding.size("image_crop_size", None, MOST_PIXELS)
    if share is None:
        share = 1.0 if crop is None else crop[0] / target[0]
    if type(share) not in (int, float):
        raise encoding.refusal("crop_fraction", "a number, or null")
    return Geometry(edge, max(1, round(edge * share)) if 0 < share < 1 else edge, target[0])


class Actions(NamedTuple):
    """How actions are unnormalised, and the rest as in ``GrootProcessors``."""

    statistics: lerobot.Statistics | None
    bounded: bool
    gripper: int | None
    executed: int | None = None
    relative: tuple[int | None, ...] = ()
    poses: tuple[Pose, ...] = ()


def _actions(directory: Path, step: Mapping[str, Any], features: lerobot.Features) -> Actions:
    settings, count = _settings(directory, step), features[ACTION][1][0]
    if settings.values.get("env_action_dim", 0) not in (0, count):
        raise settings.refusal("env_action_dim", f"{count}, as many as an action has, or 0")
    if step["registry_name"] == _UNPACK:
        tensors = lerobot.state_of(directory, step) if settings.flag("normalize_min_max", True) else {}
        statistics = _statistics(directory, tensors, ACTION, features)
        if tensors and statistics is None:
            raise settings.error(f"it has no {ACTION}.min and {ACTION}.max; found {list(tensors)[:6]}")
        gripper = count - 1 if count >= _LIBERO_NUMBERS else None
        bounded = settings.flag("clip_normalized_action", False)
        return Actions(statistics, statistics is not None and bounded, gripper)
    ends = ("q01", "q99") if settings.flag("use_percentiles", False) else ("min", "max")
    return grouped_actions(directory, settings, ends, count)


def grouped_actions(directory: Path, settings: Settings, ends: tuple[str, str], count: int | None = None) -> Actions:
    """How actions in groups are unnormalised.

    Args:
        ends: names of the two statistics of each group; ``mean`` and ``std``, or where its range ends.
        count: numbers of an action; None for those of all groups.
    """
    try:
        own = settings.values["modality_config"]["action"]
        names, steps = own["modality_keys"], len(own.get("delta_indices") or ()) or None
        kinds = (settings.flag("use_relative_action", False) and own["action_configs"]) or [{}] * len(names)
        found = zip(*(_group(settings, *each, ends) for each in zip(names, kinds, strict=True)), strict=True)
        *both, columns, of_poses = found
        rows = max((each.shape[:-1] for each in (*both[0], *both[1])), default=())
        tensors = {
            f"{ACTION}.{name}": torch.cat([each.expand(*rows, -1) for each in groups], -1)
            for name, groups in zip(_ends(ends), both, strict=True)
        }
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        both_ends = " and ".join(ends)
        expected = f"groups of an action in modality_config, and numbers {both_ends} of each in the statistics"
        raise settings.error(f"{error!r:.80}; expected {expected}") from error
    steps = min(steps or rows[0], *rows) if rows else steps
    sizes = [len(each) for each in columns]
    single = "gripper" in names and sizes[at := names.index("gripper")] == 1
    gripper = sum(sizes[:at]) if single else None
    shaped = {ACTION: ("ACTION", (*rows, sum(sizes) if count is None else count))}
    entries, poses = list[int | None](), list[Pose]()
    for own, pose in zip(columns, of_poses, strict=True):
        poses += [Pose(len(entries), own[0])] if pose else []
        entries += [None] * len(own) if pose else own
    statistics = _statistics(directory, tensors, ACTION, shaped, ends=_ends(ends))
    return Actions(statistics, ends[0] != _MEAN, gripper, steps, tuple(entries), tuple(poses))


def _ends(ends: tuple[str, str]) -> tuple[str, str]:
    """The same, of ranges that are not those of percentiles."""
    return ends if ends[0] == _MEAN else ("min", "max")


def _group(
    settings: Settings, name: str, kind: Mapping[str, Any], ends: tuple[str, str]
) -> tuple[Tensor, Tensor, tuple[int | None, ...], bool]:
    """Where the range of a group ends, ``[d]`` or a row for each step; what it is relative to; whether it is a pose."""
    raw, part, state = settings.values["raw_stats"], "action", settings.values["modality_config"].get("state")
    pose, told = False, f"{kind.get('type')} of the format {kind.get('format')}"
    if relative := str(kind.get("rep")).lower() == "relative":
        pose = str(kind.get("type")).lower() == "eef"
        if str(kind.get("type")).lower() != "non_eef" and not (pose and str(kind.get("format")).lower() in _POSES):
            raise settings.error(
                f"actions {name!r} are relative, as {told}, which is not decoded; expected NON_EEF, or EEF of the"
                " format XYZ_ROT6D"
            )
        part, ends = "relative_action", _ends(ends)
    low, high = (torch.tensor(raw[part][name][end], dtype=torch.float32) for end in ends)
    if not relative:
        return low, high, (None,) * low.shape[-1], False
    sizes = {key: len(raw["state"][key].get("mean") or raw["state"][key]["min"]) for key in state["modality_keys"]}
    own = kind.get("state_key") or name
    first, count = sum(list(sizes.values())[: list(sizes).index(own)]), NUMBERS if pose else low.shape[-1]
    if not sizes[own] == count == low.shape[-1]:
        found = f"actions {name!r} have {low.shape[-1]} numbers, and the state {own!r} {sizes[own]}"
        raise settings.error(f"{found}; expected {f'{count} each, as {told} has' if pose else 'as many'}")
    return low, high, tuple(range(first, first + count)), pose


def _statistics(
    directory: Path,
    tensors: Mapping[str, Tensor],
    key: str,
    features: lerobot.Features,
    clipped: bool = False,
    ends: tuple[str, str] = ("min", "max"),
) -> lerobot.Statistics | None:
    """The range of a feature, or its mean and deviation; None where nothing is known of it."""
    names = [f"{key}.{name}" for name in ends]
    if not all(name in tensors for name in names):
        return None
    kind, shape = features[key]
    low, high = (lerobot.as_statistic(directory, name, tensors[name], kind, shape) for name in names)
    if ends[0] != _MEAN:
        return lerobot.Statistics("MIN_MAX", low, high, _EPSILON, still=True, clipped=clipped)
    still = high == 0  # what never moved stays as it is
    return lerobot.Statistics("MEAN_STD", low.masked_fill(still, 0), high.masked_fill(still, 1), 0.0)
