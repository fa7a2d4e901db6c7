"""Run lerobot's pi0 and pi0.5 at tiny sizes on seeded weights: ``lerobot_pi.npz``.

Not run by the tests. Needs lerobot 0.6.1 with transformers; this repository has to be importable::

    PYTHONPATH=. python -m tests.policies.golden.make_lerobot_pi
"""

import json
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import PolicyProcessorPipeline, TransitionKey
from lerobot.processor.converters import batch_to_transition
from safetensors.torch import load_file

from .. import pis
from ..vlas import CAMERAS, MASK, STATE, TOKENS, processed

POLICIES: dict[str, Any] = {"pi0": PI0Policy, "pi05": PI05Policy}


@torch.no_grad()
def main() -> None:
    """One file."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    for kind in pis.KINDS:
        with TemporaryDirectory() as folder:
            directory = pis.save(kind, Path(folder) / "policy")
            policy = tiny(kind, directory)
            for call in (0, 1):
                numbers[f"{kind}.{call}"] = chunk(policy, directory, pis.observation(call))
            del policy.config.input_features[CAMERAS[1]]  # what is not in the batch is masked, and named so
            given = pis.observation(0)
            policy.config.input_features["observation.images.empty_camera_0"] = policy.config.input_features[CAMERAS[0]]
            numbers[f"{kind}.missing"] = chunk(policy, directory, {k: v for k, v in given.items() if k != CAMERAS[1]})
            numbers[f"{kind}.rounded"] = rounded(kind, Path(folder) / "rounded")
    for mode in ("MEAN_STD", "QUANTILES"):
        numbers[f"pi05.prompts.{mode}"] = prompts(mode)
    path = Path(__file__).with_name("lerobot_pi.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def rounded(kind: str, directory: Path) -> Any:
    """Of a policy in bfloat16 what lerobot rounds when it is made; its weights, and what it computes, are float32."""
    policy = tiny(kind, pis.save(kind, directory, "bfloat16")).float()
    filled(policy, directory)  # again: its first weights were rounded
    return chunk(policy, directory, pis.observation(0))


def prompts(mode: str) -> Any:
    """What pi0.5 is told of each task and state."""
    with TemporaryDirectory() as folder:
        directory = pis.save("pi05", Path(folder) / "policy")
        path = directory / "policy_preprocessor.json"
        entries = json.loads(path.read_text())
        entries["steps"][0]["config"]["norm_map"]["STATE"] = mode
        path.write_text(json.dumps(entries))
        before = PolicyProcessorPipeline.from_pretrained(directory, config_filename=path.name)
        step = Pi05PrepareStateTokenizerProcessorStep(max_state_dim=pis.PADDED)
        told = []
        for number, state in enumerate(pis.states()):
            batch = before({STATE: torch.from_numpy(state)[None], "task": [pis.TASKS[number % 2]]})
            made = step(batch_to_transition(batch))
            told += made[TransitionKey.COMPLEMENTARY_DATA]["task"]
    return np.array(told)


def chunk(policy: Any, directory: Path, given: dict[str, Any], left_over: Any = None, delay: int = 0) -> Any:
    """The actions of a whole chunk in robot units; tokens are given, so that no tokenizer is needed.

    What is left over of the chunk before is as the network gives it, of which so many actions are executed meanwhile.
    """
    tensors = {key: torch.from_numpy(value) for key, value in given.items()}
    raw = {key: value[0] for key, value in tensors.items() if key not in (TOKENS, MASK)}
    batch, after = processed(str(directory), raw, "go")
    batch = {key: value if value.ndim > raw[key].ndim else value[None] for key, value in batch.items()}
    batch |= {key: tensors[key] for key in (TOKENS, MASK)}
    assert STATE in batch
    before = {} if left_over is None else {"prev_chunk_left_over": left_over, "inference_delay": delay}
    return after(policy.predict_action_chunk(batch, noise=torch.from_numpy(pis.noise()), **before)).numpy()


def tiny(kind: str, directory: Path) -> Any:
    """lerobot's policy at the sizes of ``pis``, with the weights of the directory."""
    module: Any = import_module(f"lerobot.policies.{kind}.modeling_{kind}")
    built = module.PaliGemmaForConditionalGenerationWithPiGemma

    def sizes(language: Any) -> Any:
        return module.GemmaConfig(
            width=language.width,
            depth=language.layers,
            mlp_dim=language.hidden,
            num_heads=language.heads,
            num_kv_heads=language.groups,
            head_dim=language.channels,
        )

    def smaller(config: Any) -> Any:
        config.text_config.vocab_size = config._vocab_size = pis.VOCABULARY
        config.text_config.pad_token_id = config.pad_token_id = 0
        vision = config.vision_config
        vision.hidden_size, vision.num_hidden_layers = pis.VISION.hidden_size, pis.VISION.num_hidden_layers
        vision.intermediate_size, vision.projection_dim = pis.VISION.intermediate_size, pis.TEXT.width
        return built(config)

    def config_of(variant: str) -> Any:
        return sizes(pis.TEXT if variant == "gemma_2b" else pis.EXPERT)

    with (
        patch.object(module, "get_gemma_config", config_of),
        patch.object(module, "PaliGemmaForConditionalGenerationWithPiGemma", smaller),
    ):
        policy = POLICIES[kind](PreTrainedConfig.from_pretrained(directory)).eval()
    filled(policy, directory)
    return policy


def filled(policy: Any, directory: Path) -> None:
    """Give it the weights of the directory."""
    saved = load_file(directory / "model.safetensors")
    own = {name.replace(".vision_tower.vision_model.", ".vision_tower."): name for name in policy.state_dict()}
    missing, unexpected = policy.load_state_dict({own[name]: value for name, value in saved.items()}, strict=False)
    unread = ("lm_head.weight", "language_model.norm.weight")
    assert not unexpected, unexpected
    assert all(name.endswith(unread) or ".vision_model.head." in name for name in missing), missing


if __name__ == "__main__":
    main()
