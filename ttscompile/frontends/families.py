"""The policy families that are read: how a checkpoint of each is told, which options it takes, and what loads it.

A family is a module of ``policies`` and a row in ``FAMILIES``. Nothing here imports torch, so that the command line can
list formats and samplers, and say what is wrong with a path or an option, before the compiler is loaded.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.coercion import integer
from ..core.spec import WITHOUT, PolicySpec
from ..errors import CheckpointError, SpecError
from ..samplers.flow import METHODS
from .refusals import refuse_directory
from .settings import read_json

if TYPE_CHECKING:
    from torch import nn

DIFFUSION_SAMPLERS = ("ddpm", "ddim", "dpmsolver++")
"""Samplers that a policy trained with diffusion can be given in place of its own."""

SAMPLERS = (*DIFFUSION_SAMPLERS, *METHODS)
SPACINGS = ("leading", "trailing", "linspace")
DIFFUSION_OPTIONS = frozenset({"sampler", "steps", "spacing", "loops"})
"""What can be asked of any policy with a denoising loop."""


@dataclass(frozen=True)
class LoadOptions:
    """What can be asked of a checkpoint in place of what it says itself; None leaves it as it was saved.

    The fields are the arguments of ``ttscompile.convert`` of the same names, and are described there.
    """

    sampler: str | None = None
    steps: int | None = None
    spacing: str | None = None
    task: str | None = None
    encoders: str | os.PathLike[str] | None = None
    without_cameras: Sequence[str] | None = None
    loops: Sequence[tuple[str, int]] | None = None
    base: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        if self.steps is not None:
            object.__setattr__(self, "steps", integer(self.steps, "steps", SpecError, 1))


AS_SAVED = LoadOptions()


def as_converted(source: Mapping[str, str], encoders: str | os.PathLike[str] | None = None) -> LoadOptions:
    """The options that decide what a policy observes, as a source tells them: its task, and cameras left out."""
    cameras = source[WITHOUT].split(", ") if source.get(WITHOUT) else None
    return LoadOptions(task=source.get("task"), encoders=encoders, without_cameras=cameras)


@dataclass(frozen=True)
class Family:
    """How the checkpoints of one family of policies are read.

    Attributes:
        name: of the format, as ``convert`` takes it and ``PolicySpec.source`` keeps it.
        title: of the project, for messages.
        reads: what the user gives, for messages; begins with an article.
        detect: whether a path looks like one of this family's, told by names, first bytes or an entry of a JSON file.
            The first row of ``FAMILIES`` that says so takes it; where several would, the narrower one stands first.
        module: of ``policies``, called as the format unless told otherwise; imported when it is needed, with torch. Its
            ``load(path, options)`` gives network and ``PolicySpec``, or a CheckpointError or SpecError. It may have
            four more. ``examine(path, spec, encoders)`` says what goes wrong without an error, in place of the look at
            normalisers. ``files_beside(path, spec, text)`` gives the files by which the program that trained a policy
            takes the compiled one in its place; none where it cannot take this one. ``tokenizer_file(path, encoders)``
            finds what makes an instruction the policy's tokens. ``recordings(path)`` says where the recorded episodes
            are that it was trained on, as ``-t`` takes it; None where the checkpoint does not say.
        options: names of ``LoadOptions`` that it takes; the others are refused.
    """

    name: str
    title: str
    reads: str
    detect: Callable[[Path], bool]
    module: str = ""
    options: frozenset[str] = DIFFUSION_OPTIONS

    def function(self, name: str) -> Any:
        """A function of its module; None where it has none of this name."""
        return getattr(import_module(f"..policies.{self.module or self.name}", __package__), name, None)

    def load(self, path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
        """Load a checkpoint of this family."""
        for name in (field.name for field in fields(options) if getattr(options, field.name) is not None):
            if name not in self.options:
                takers = ", ".join(each.title for each in FAMILIES if name in each.options)
                raise CheckpointError(
                    f"{path}: the option {name} is for policies of {takers}; this is one of {self.title}. Leave it out."
                )
        return self.function("load")(path, options)  # type: ignore[no-any-return]


def function_of(spec: PolicySpec, name: str) -> Callable[..., Any] | None:
    """A function of the family that a policy is of; None where that has none, or no checkpoint was read."""
    row = next((each for each in FAMILIES if each.name == spec.source.get("format")), None)
    return None if row is None else row.function(name)


def _config(path: Path) -> Mapping[str, object]:
    """Entries of a directory's ``config.json``; none of an artifact's, which may have one as well, and a manifest."""
    config = path / "config.json"
    return {} if (path / "manifest.json").is_file() or not config.is_file() else read_json(config)


def _begins_with(path: Path, word: bytes) -> bool:
    """Whether the names that a torch file begins with hold a word."""
    with path.open("rb") as file:
        return word in file.read(2**20)


_OPENPI = ("metadata.pt", "params/_METADATA", "assets/**/norm_stats.json")
FAMILIES = (
    Family(
        name="lerobot",
        title="LeRobot",
        reads="a directory that lerobot's save_pretrained wrote, with config.json and model.safetensors",
        detect=lambda path: "type" in _config(path),
        module="lerobot.family",
        options=DIFFUSION_OPTIONS | {"task", "encoders", "without_cameras", "base"},
    ),
    Family(
        name="groot",
        title="GR00T",
        reads="a directory of GR00T N1.7 as NVIDIA's code saves it, with config.json and processor_config.json",
        detect=lambda path: _config(path).get("model_type") == "Gr00tN1d7",
        options=DIFFUSION_OPTIONS | {"task", "encoders", "without_cameras"},
    ),
    Family(
        name="evo1",
        title="Evo-1",
        reads="a directory that Evo-1's training saved, with config.json, norm_stats.json and its weights",
        detect=lambda path: "vlm_name" in _config(path),
        options=DIFFUSION_OPTIONS | {"task", "encoders", "without_cameras"},
    ),
    Family(
        name="scaledp",
        title="DexVLA",
        reads="a directory that DexVLA's training saved, with config.json and safetensors",
        detect=lambda path: "scale_dp_policy" in map(_config(path).get, ("policy_head_type", "model_type")),
    ),
    Family(
        name="dit_policy",
        title="DiT-Policy",
        reads="a .ckpt file of DiT-Policy with agent_config.yaml beside it",
        detect=lambda path: path.is_file() and (path.parent / "agent_config.yaml").is_file(),
    ),
    Family(
        name="dita",
        title="Dita",
        reads="a .pth file of Dita with .hydra/config.yaml in its folder or in the one above",
        detect=lambda at: at.suffix == ".pth" and any((p / ".hydra/config.yaml").is_file() for p in at.parents[:2]),
        options=DIFFUSION_OPTIONS | {"task", "encoders"},
    ),
    Family(
        name="dppo",
        title="DPPO",
        reads="a state_N.pt of DPPO with .hydra/config.yaml in its folder or in the one above",
        detect=lambda at: at.match("state_*.pt") and any((p / ".hydra/config.yaml").is_file() for p in at.parents[:2]),
    ),
    Family(
        name="rdt",
        title="RDT",
        reads="a directory that RDT's save_pretrained wrote, with config.json and its weights",
        detect=lambda path: "lang_adaptor" in _config(path),
        options=DIFFUSION_OPTIONS | {"encoders", "without_cameras"},
    ),
    Family(
        name="openpi",
        title="openpi",
        reads="a folder that openpi's training or its converter to PyTorch saved, with model.safetensors and assets",
        detect=lambda path: "paligemma_variant" in _config(path) or any(any(path.glob(sign)) for sign in _OPENPI),
        options=DIFFUSION_OPTIONS | {"task", "encoders", "without_cameras"},
    ),
    Family(
        name="octo",
        title="Octo",
        reads="a folder that Octo's save_pretrained wrote, with config.json and example_batch.msgpack",
        detect=lambda path: (path / "example_batch.msgpack").is_file(),
        options=DIFFUSION_OPTIONS | {"task", "encoders", "without_cameras"},
    ),
    Family(
        name="cogact",
        title="CogACT",
        reads="a .pt file of CogACT",
        detect=lambda path: path.suffix == ".pt" and path.is_file() and _begins_with(path, b"action_model"),
    ),
    Family(
        name="hybrid_vla",
        title="HybridVLA",
        reads="a .pt file of HybridVLA that was trained with use_diff",
        detect=lambda path: path.suffix == ".pt" and path.is_file() and _begins_with(path, b"proprio_embedder"),
    ),
    Family(
        name="diffusion_bc",
        title="Diffusion BC",
        reads="a state_dict of Diffusion BC, a Model_Cond_Diffusion's, in a file",
        detect=lambda path: path.is_file() and _begins_with(path, b"mab_over_sqrtmab"),
    ),
    Family(
        name="diffusion_policy",
        title="Diffusion Policy",
        reads="a .ckpt file of Diffusion Policy",
        # Every file that no other family takes: its module names what a file is that is none of its own.
        detect=lambda path: not path.is_dir(),
        module="diffusion_policy.family",
    ),
)

GIVE = f"Give what the training saved, of one of these: {', '.join(each.title for each in FAMILIES)}."
"""What to do about a path that leads nowhere."""

FORMATS = ("auto", *(each.name for each in FAMILIES))


def find_family(path: Path, format: str) -> Family:
    """The family that reads a checkpoint. What no family reads is refused by what it is, if that is known."""
    if format not in FORMATS:
        raise CheckpointError(f"format {format!r} is not known; expected one of {', '.join(FORMATS)}.")
    rows = [each for each in FAMILIES if format in ("auto", each.name)]
    found = next((each for each in rows if each.detect(path)), None)
    if found is not None:
        return found
    if path.is_dir():
        refuse_directory(path)
    wrong = f"not of the format {format}" if path.exists() else "no such file or directory"
    raise CheckpointError(f"{path}: {wrong}; expected {rows[0].reads}.")
