"""What tests of vision-language-action models and the makers of their golden files share."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import PolicySpec
from ttscompile.core.values import fitted

STATE = "observation.state"
TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
CAMERAS = ("observation.images.front", "observation.images.wrist")

Array = npt.NDArray[Any]


def arrays(golden: Mapping[str, Array], call: int) -> dict[str, Array]:
    """What one call of ``smolvla.npz`` was given: raw frame, task, tokens, mask and noise."""
    names = ("task", "tokens", "attention_mask", "noise")
    frames = {key: golden[f"call{call}.frame0.{key}"] for key in (STATE, *CAMERAS)}
    return frames | {name: golden[f"call{call}.{name}"] for name in names}


def frame(given: Mapping[str, Array], size: tuple[int, int]) -> dict[str, Array]:
    """The frame with images of this size; other ones unless it is theirs."""
    found = {STATE: given[STATE]}
    for seed, key in enumerate(CAMERAS):
        own = given[key].shape[1:] == size
        other = np.random.RandomState(seed).uniform(0, 1, (3, *size)).astype(np.float32)
        found[key] = given[key] if own else other
    return found


def as_given(key: str, batch: Mapping[str, Array], spec: PolicySpec) -> Array:
    """One observation of a batch as the network is given it."""
    own = spec.observations[key]
    return fitted(batch[key] if own.frames is None else batch[key][:, None], own)


def processed(directory: str, raw: Mapping[str, Any], task: str) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    """The batch that lerobot's policy is given of a raw frame, and what undoes its normaliser."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

    before = PolicyProcessorPipeline.from_pretrained(directory, config_filename="policy_preprocessor.json")
    after = PolicyProcessorPipeline.from_pretrained(
        directory,
        config_filename="policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    batch = before({**raw, "task": task})
    return {key: value for key, value in batch.items() if key.startswith("observation.")}, after
