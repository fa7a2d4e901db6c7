"""What users bring that is not a policy this compiler reads: each named for what it is, with what to do instead.

Tables of signs, tried in order, and one error. Nothing here loads anything: a sign is a class name in the
configuration, an entry of a checkpoint, the name of a weight, a file in a directory, or the first bytes of a file.
"""

import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, NoReturn

from ..core.zip_files import open_zip
from ..errors import CheckpointError
from .settings import read_json

_BUILD = "Build the network with its code and use ttscompile.compile_denoiser(module, spec): docs/howto/own-denoiser.md"
_HEAD = f"{_BUILD}. The action head is the module, and what the vision-language model gives it are its observations."
_RENAMED = (
    "If its class adds nothing to the original's that changes actions, save it again with the name of that class at the"
    " end of cfg.policy._target_. Otherwise:"
)
_HYDRA = "Give the file with the .hydra/config.yaml that its training wrote, in its folder or in the one above."
_DIFFUSION_BC = "Give the state_dict of the Model_Cond_Diffusion. Their other models have no denoising loop to compile."
_EXPERTS = f"{_BUILD}. The module has to compute all experts and weigh them, in place of choosing rows of the data."
_INNER_MODEL = f"{_BUILD}. The module is an EDMDenoiser of its inner_model."
_RDT = "Give the folder that RDT's save_pretrained wrote: config.json, and model.safetensors or pytorch_model.bin."
_INNER, _ONE = "Give the folder pretrained_model in it.", "Give one of those in it."
_PUT = "Put model.safetensors beside the JSON files and statistics of a LeRobot policy xvla, and convert that folder."
_TRAIN = f"No tool makes LeRobot's {{}} of it: train one with LeRobot. Or: {_HEAD}"
_JAX = f"Convert it to PyTorch with the tool of its project; of openpi, give the folder with params in it. {_BUILD}."
_HYBRID_VLA = "Give the .pt file of its folder checkpoints, as its training saved it."
_MOST_FILES = 10_000  # looked at in a directory; somebody may give the root of a disk
_ARTIFACT, _LOAD = "an artifact that is compiled already", "Load it with ttscompile.load, or calibrate it."
_NO_LOOP = "There is no denoising loop to compile. Use torch.compile, or torch.onnx.export and then onnxruntime."
_ONCE = f"{_BUILD}. One evaluation has nothing to reuse; it gains eight bits, known frames, and no torch on the robot."
_EXPERT = f"{_ONCE} The module is a DirectDenoiser of the mean of the expert with the highest gate."
_GGUF = "llama.cpp and vla.cpp run such files. Convert the checkpoint that it was made from, if that denoises actions."
MERGE = "Merge it into its base model (PeftModel.merge_and_unload), save that policy, and convert the result."
_BY_NAME = (
    (r"\.onnx$", "an ONNX model", "It has no denoising loop. Convert the checkpoint that it was exported from."),
    (r"\.msgpack$", "a checkpoint of Flax", _JAX),
    (r"\.(npz|npy|zarr|txt|json|ya?ml|md)$", "no checkpoint", "Give the file or the folder that the training saved."),
)
"""Of files that nothing inside tells of: sign in the name, what it is, remedy."""
_WEIGHTS = f"Weights do not say how they are connected. If a configuration was saved, convert both. If not: {_BUILD}."


@dataclass(frozen=True)
class Refusal:
    """One row of a table.

    Attributes:
        sign: pattern (of ``re``) that gives it away.
        what: it is; the message says "this is" before it.
        remedy: what the user can do, in whole sentences.
    """

    sign: str
    what: str
    remedy: str


POLICIES = (
    Refusal(r"^(ibc|bet|robomimic)", "a policy without diffusion", _NO_LOOP),
    Refusal(r"onedp", "a policy of OneDP, distilled to one evaluation", _ONCE),
    Refusal(
        r"transformer|unet",
        "a diffusion policy with another observation encoder than those that are read, or one of these renamed",
        f"{_RENAMED} {_BUILD}. Its observation encoder belongs inside the module: hoisting takes it out of the loop.",
    ),
    Refusal(r"", "a policy of its own kind", f"{_RENAMED} {_BUILD}."),
)
"""By the class name of a configuration's ``policy``, in lower case."""

DIRECTORIES = (
    Refusal(r"^manifest\.json$", _ARTIFACT, _LOAD),
    Refusal(r"^meta/info\.json$", "a data set of LeRobot, not a policy", "Give it with --trajectories."),
    Refusal(r"^adapter_config\.json$", "a PEFT adapter without the config.json of its policy", MERGE),
    Refusal(r"^[^/]+/(metadata\.pt|params/_METADATA)$", "a directory around checkpoints of openpi", _ONE),
    Refusal(r"(^|/)(_(CHECKPOINT_)?METADATA|manifest\.ocdbt)$|\.msgpack$", "a JAX checkpoint (Orbax or msgpack)", _JAX),
    Refusal(r"(^|/)pretrained_model(/config\.json)?$", "a directory around what lerobot saved", _INNER),
    Refusal(r"^config\.json: model_type=(?i:gr00t)", "a GR00T model", _HEAD),
    Refusal(r"^config\.json: model_type=xvla", "an X-VLA as its authors save it", _PUT),
    Refusal(r"^config\.json: model_type=eo1$", "an EO-1 as its authors save it", _TRAIN.format("eo1")),
    Refusal(r"^config\.json: dof_config=", "a Wall-X as its authors save it", _TRAIN.format("wall_x")),
    Refusal(r"^config\.json: act_adaptor=", "an RDT2 or H-RDT", _HEAD),
    Refusal(r"^config\.json: policy_head_type=unet", "a DexVLA or DiVLA whose head is a U-Net", _HEAD),
    Refusal(r"^(checkpoint-|step_)\w+/config\.json$", "a directory around checkpoints", _ONE),
    Refusal(r"\.ckpt$|^checkpoints/[^/]+\.pt$", "a directory of checkpoints", "Give one of the files in it."),
    Refusal(r"\.(safetensors|bin|pth?)$", "a directory of weights", _WEIGHTS),
)
"""By the path of a file in a directory, three levels deep, or an entry of its ``config.json``."""

ENTRIES = (
    Refusal(r"^parameter$", "a checkpoint of Dita", _HYDRA),
    Refusal(r"^algo_name$", "a checkpoint of robomimic", f"If that is diffusion_policy: {_BUILD}. If not: {_NO_LOOP}"),
)
"""By an entry of a torch checkpoint."""

LEROBOT_TYPES = "act, diffusion, eo1, evo1, groot, multi_task_dit, smolvla, pi0, pi05, vla_jepa, wall_x or xvla"

LEROBOT = (
    Refusal(r"^(vqbet|pi0_fast)$", "autoregressive over codes of actions", _NO_LOOP),
    Refusal(r"^tdmpc$", "a world model with a planner", _NO_LOOP),
    Refusal(r"^sac$", "an actor of reinforcement learning", _NO_LOOP),
    Refusal(r"^molmoact2$", "a policy whose backbone, Molmo, is not rebuilt here", _HEAD),
    Refusal(
        r"^(fastwam|lingbot_va)$",
        "a world model that denoises video beside actions, Wan2.2, which is not rebuilt here",
        "No module of it was compiled yet.",
    ),
    Refusal(r"", "not known", f"Expected {LEROBOT_TYPES}. If it denoises: {_BUILD}."),
)
"""By the type of a LeRobot policy, in lower case."""

STATES = (
    Refusal(r"^(x_embedder|llm_backbone\.x_embedder)\b", "a checkpoint of HybridVLA", _HYBRID_VLA),
    Refusal(r"^qwen_vl_interface\.", "a VLA-JEPA or another of starVLA as it is saved", _TRAIN.format("vla_jepa")),
    Refusal(r"^action_model\b", "a checkpoint of CogACT", "Give it a name that ends with .pt, as its training does."),
    Refusal(r"(^|\.)act(ion)?_adaptor\.", "an RDT2 or H-RDT", _HEAD),
    Refusal(r"(^|\.)(state|lang|img)_adaptor\.", "weights of RDT", _RDT),
    Refusal(r"^(joint_cmps|gating_network|gmm_mean_net)\.", "a policy of VDD, experts of one evaluation each", _EXPERT),
    Refusal(r"^(actor_ft|network)\.(time_embedding|time_mlp|mlp_mean)\.", "a policy of DPPO", _HYDRA),
    Refusal(r"^nn_model\.", "a network of Diffusion BC without its schedule, or another one", _DIFFUSION_BC),
    Refusal(r"noise_pred_net\.blocks\.", "a first stage of DexVLA's ScaleDP", "Give what its second or third saved."),
    Refusal(r"(^|\.)(noise|time)_net\.", "a checkpoint of DiT-Policy", "Put its agent_config.yaml beside it."),
    Refusal(r"\.router\.|\.experts?\.\d+\.", "a mixture of experts (MoDE, say)", _EXPERTS),
    Refusal(r"(^|\.)inner_model\.", "a policy of k-diffusion (BESO or MDT, say)", _INNER_MODEL),
    Refusal(
        r"\.add_[qkv]_proj\.|\.context_block\.|\.txt_(mlp|attn)",
        "a transformer of two streams (MM-DiT)",
        f"{_BUILD}. Two streams that attend to each other make no chain of additions: what lies between two points"
        " that all paths cross becomes one block, and where there are none the compiler says so.",
    ),
    Refusal(r"(^|\.)(down|up)_modules\.|(^|\.)unet\.", "weights of a U-Net", _WEIGHTS),
    Refusal(r"\blora_[AB]\b", "an adapter (LoRA) without the weights that it adapts", MERGE),
    Refusal(r"", "a plain dictionary of weights", _WEIGHTS),
)
"""By the name of a weight; the first row that matches any of them. The last matches every checkpoint."""


def refuse_policy(name: str, rows: Iterable[Refusal] = POLICIES, where: str = "") -> NoReturn:
    """Refuse a checkpoint whose policy is another one than its project's that are read."""
    row = _first(rows, [name.lower()])
    shown = f"{name!a:.80}".strip("'\"")
    raise CheckpointError(f"{where}the policy is {shown}: {row.what}. {row.remedy}")


def refuse_payload(payload: Mapping[str, Any]) -> None:
    """Refuse what a torch file holds unless it is a checkpoint of Diffusion Policy's workspace."""
    if "cfg" in payload and "state_dicts" in payload:
        return
    entries, missing = sorted(map(str, payload)), "cfg" if "cfg" not in payload else "state_dicts"
    if "cfg" in payload or "state_dicts" in payload:
        raise CheckpointError(
            f"no entry {missing!r}; found {entries[:8]}. Expected all that Diffusion Policy's workspace saves: {{cfg,"
            " state_dicts, pickles}. Take the file that the training wrote."
        )
    row = next((each for each in ENTRIES if _match(each, entries)), None)
    how = f"its entry {_match(row, entries)}" if row else ""
    if row is None:
        names = sorted(_weight_names(payload))
        row = _first(STATES, names)
        how = f"the weight {_match(row, names)}" if row.sign else f"its entries {', '.join(entries[:6]) or '(none)'}"
    raise CheckpointError(
        f"no entry {missing!r}, so not a checkpoint of Diffusion Policy's workspace {{cfg, state_dicts, pickles}}: this"
        f" is {row.what} (told by {how}). {row.remedy}"
    )


def refuse_file(path: Path) -> None:
    """Refuse a file whose first bytes or entries say that it is no torch checkpoint; leave all others alone."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(10)
    if head[8:10] == b'{"' and int.from_bytes(head[:8], "little") < path.stat().st_size:
        raise _refused(path, "a safetensors file", "a JSON header after its length", _WEIGHTS)
    if head.startswith(b"\x89HDF\r\n"):
        raise _refused(path, "an HDF5 file, data or Keras weights", "its first bytes", _WEIGHTS)
    if head.startswith(b"GGUF"):
        raise _refused(path, "a GGUF file, a quantised model", "its first bytes", _GGUF)
    for sign, what, remedy in _BY_NAME:
        if re.search(sign, path.name):
            raise _refused(path, what, "its name", remedy)
    if not zipfile.is_zipfile(path):
        return
    try:
        with path.open("rb") as file, open_zip(file) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError):
        return  # a damaged archive, which the reader of checkpoints describes
    if "manifest.json" in names:
        raise _refused(path, _ARTIFACT, "manifest.json", _LOAD)
    if not any(name.endswith("data.pkl") for name in names):
        how = f"{', '.join(names[:4]) or 'no entries'}, and no data.pkl"
        remedy = "Unpack it, and convert the checkpoint inside."
        raise _refused(path, "a zip archive that torch.save did not write", how, remedy)


def refuse_directory(path: Path) -> NoReturn:
    """Refuse a directory that no frontend reads; ``LEROBOT`` has LeRobot's own policies."""
    every = chain.from_iterable(path.glob(level) for level in ("*", "*/*", "*/*/*"))
    names = sorted(each.relative_to(path).as_posix() for each in islice(every, _MOST_FILES))
    names += _entries(path / "config.json")
    for row in DIRECTORIES:
        if how := _match(row, names):
            raise _refused(path, row.what, how, row.remedy)
    raise CheckpointError(
        f"{path} is a directory without a policy that is read: found {', '.join(names[:6]) or 'nothing'}; expected the"
        f" config.json and model.safetensors of LeRobot's {LEROBOT_TYPES}, or give a .ckpt file of Diffusion Policy."
        f" Otherwise: {_BUILD}."
    )


def _refused(path: Path, what: str, how: str, remedy: str) -> CheckpointError:
    return CheckpointError(f"{path}: this is {what} (told by {how}). {remedy}")


def _match(row: Refusal, names: Iterable[str]) -> str | None:
    return next((name for name in names if re.search(row.sign, name)), None)


def _first(rows: Iterable[Refusal], names: list[str]) -> Refusal:
    """The first row whose sign is in any of the names; the last rows of these tables match all."""
    return next(row for row in rows if not row.sign or _match(row, names) is not None)


def _weight_names(payload: Mapping[str, Any]) -> set[str]:
    """Names of the weights, without the entries that hold them; CogACT's and HybridVLA's modules keep theirs."""
    names: set[str] = set()
    for key, value in payload.items():
        for inner, item in value.items() if isinstance(value, Mapping) else [(key, value)]:
            names |= {f"{inner}.{name}" for name in item} if isinstance(item, Mapping) else {str(inner)}
    return names


def _entries(path: Path) -> list[str]:
    """``config.json: key=value`` for the entries of a JSON file; none where it is not there or not one."""
    try:
        config = read_json(path)
    except CheckpointError:
        return []
    return [f"{path.name}: {key:.80}={value!s:.80}" for key, value in config.items()]
