"""What LeRobot looks for in a policy's directory, for a compiled one: its configuration, and processors.

With these files beside it, an artifact is a policy of the type ``ttscompile``, which the package
``lerobot_policy_ttscompile`` registers. It takes what the robot measures, so its processors normalise nothing: they
make batches, and tokens of the instruction where that is an input and the artifact has no tokenizer of its own.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ttscompile.core.spec import PolicySpec
from ttscompile.frontends.settings import read_json

from .config import ACTION, CONFIG
from .processors import POSTPROCESSOR, PREPROCESSOR, PROMPT

LANGUAGE = "observation.language."
"""Beginning of the keys that LeRobot's tokenizer makes of an instruction."""

_TEXT = {
    "tokenizer_processor": "tokenizer_processor",
    "smolvla_new_line_processor": "smolvla_new_line_processor",
    "pi0_new_line_processor": "smolvla_new_line_processor",
}
"""Steps that work on the instruction, by the name that lerobot knows without the modules of their policies."""


def files_beside(directory: Path, spec: PolicySpec, text: bool = False) -> dict[str, bytes]:
    """The files of a compiled policy by name; the same policy gives the same bytes.

    None where the artifact does not make its tokens itself, and lerobot's steps alone would make others: of a policy
    whose prompt holds the state (pi05), which the original writes there normalised, and of one that has words before
    the instruction (eo1, evo1, groot, vla_jepa, wall_x), which no step writes.

    Args:
        text: whether it does: lerobot then gives it the task as text.
    """
    entries = read_json(directory / CONFIG)
    steps = read_json(directory / PREPROCESSOR)["steps"]
    worded = spec.instruction is not None and (spec.instruction.before or spec.instruction.around)
    held = entries["type"] == "pi05" or any(step.get("registry_name") == PROMPT for step in steps)
    if (worded or held) and not text:
        return {}
    renamed = {
        new: old
        for step in steps
        if step.get("registry_name") == "rename_observations_processor"
        for old, new in step.get("config", {}).get("rename_map", {}).items()
    }
    features = {renamed.get(key, key): dict(feature) for key, feature in entries["input_features"].items()}
    for key in [key for key in features if features[key]["type"] == "STATE" and key in spec.observations]:
        features[key]["shape"] = list(spec.observations[key].shape[1:])  # the robot's, where config.json has a base's
    config = {
        "type": "ttscompile",
        "n_obs_steps": max(one.frames or 1 for one in spec.observations.values()),
        "n_action_steps": spec.chunk.executes,
        "input_features": {key: feature for key, feature in features.items() if key in spec.observations},
        "output_features": {ACTION: entries["output_features"][ACTION]},
        "device": "cpu",
    }
    tokens = [one.shape[-1] for key, one in spec.observations.items() if key.startswith(LANGUAGE) and not text]
    before = [_step("rename_observations_processor", rename_map={}), _step("to_batch_processor")]
    before += [_text_step(step, tokens[0]) for step in steps if tokens and step.get("registry_name") in _TEXT]
    device = _step("device_processor", device="cpu", float_dtype=None)
    return {
        CONFIG: _dump(config),
        PREPROCESSOR: _dump({"name": "policy_preprocessor", "steps": [*before, device]}),
        POSTPROCESSOR: _dump({"name": "policy_postprocessor", "steps": [device]}),
    }


def _step(name: str, **config: Any) -> dict[str, Any]:
    return {"registry_name": name, "config": config}


def _text_step(step: Mapping[str, Any], tokens: int) -> dict[str, Any]:
    """A step on the instruction, as the original has it; the compiled policy takes so many tokens, and no fewer."""
    name, config = _TEXT[step["registry_name"]], dict(step.get("config", {}))
    if name == "tokenizer_processor":
        config |= {"max_length": tokens, "padding": "max_length"}
    return _step(name, **config)


def _dump(document: object) -> bytes:
    return json.dumps(document, indent=2).encode() + b"\n"
