"""Run openpi's own policy at tiny sizes on seeded weights: ``openpi.npz``.

Not run by the tests. Needs a clone of Physical-Intelligence/openpi at 15a9616, and in an environment of its own what it
imports: transformers 4.53.2 with the clone's ``transformers_replace`` copied over it, jax 0.5.3 and flax 0.10.2. Pillow
has to be below 13, which resizes in another order. This repository has to be importable, too::

    PYTHONPATH=.:CLONE/src:CLONE/packages/openpi-client/src python -m tests.policies.golden.make_openpi

All is float32, where openpi computes in bfloat16. The tokenizer is one of words in place of PaliGemma's.
"""

from contextlib import ExitStack
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import openpi.models.gemma as gemma
import openpi.models_pytorch.gemma_pytorch as gemma_pytorch
import torch
from openpi import transforms
from openpi.models.pi0_config import Pi0Config
from openpi.models.tokenizer import PaligemmaTokenizer
from openpi.models_pytorch.pi0_pytorch import PI0Pytorch
from openpi.policies.policy import Policy
from openpi.shared import normalize
from safetensors.torch import load_model

from .. import openpis


class Words:
    """In place of sentencepiece: a token a word, and what it was given."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def encode(self, text: str, add_bos: bool = False) -> list[int]:
        """A line's end is a word; without the beginning's token."""
        self.lines.append(text)
        words = [word for word in text.replace("\n", " \n ").split(" ") if word]
        return [openpis.WORDS.index(word) if word in openpis.WORDS else 0 for word in words]


def main() -> None:
    """One file."""
    torch.set_num_threads(1)
    numbers: dict[str, Any] = {}
    for kind in openpis.KINDS:
        with TemporaryDirectory() as folder:
            directory = openpis.save(kind, Path(folder) / "policy")
            for call in (0, 1):
                numbers[f"{kind}.{call}"] = infer(kind, directory, call)
            numbers[f"{kind}.missing"] = infer(kind, directory, 0, without=openpis.ABSENT)
            numbers[f"{kind}.rounded"] = infer(kind, directory, 0, dtype="bfloat16")
            numbers[f"{kind}.notes"] = np.frombuffer(notes(kind), np.uint8)
    numbers["lines"] = np.array(lines())
    path = Path(__file__).with_name("openpi.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def infer(kind: str, directory: Path, call: int, without: str = "", dtype: str = "float32") -> Any:
    """The chunk ``[1, T, D]`` of a call, in the robot's units as far as there are statistics."""
    policy = Policy(tiny(kind, directory, dtype), is_pytorch=True, **around(kind, directory)[0])
    return np.asarray(policy.infer(given(call, without), noise=openpis.noise())["actions"], np.float32)[None]


def given(call: int, without: str) -> dict[str, Any]:
    """What a robot's ``data_transforms.inputs`` give of a call, without a camera, if it is named."""
    images = openpis.pictures(call)
    masks = {key: np.bool_(key != without) for key in images}
    images = {key: image if key != without else np.zeros_like(image) for key, image in images.items()}
    return {"image": images, "image_mask": masks, "state": openpis.state(call), "prompt": openpis.TASKS[call]}


def around(kind: str, directory: Path) -> tuple[dict[str, Any], Words]:
    """The transforms of ``create_trained_policy`` but for the robot's own, and the tokenizer in them."""
    norms, ranged = normalize.load(directory / "assets" / openpis.SET), kind != "pi0"
    tokenizer = PaligemmaTokenizer.__new__(PaligemmaTokenizer)
    tokenizer._max_len, tokenizer._tokenizer = openpis.LENGTH, Words()
    before = [
        transforms.Normalize(norms, use_quantiles=ranged),
        transforms.ResizeImages(224, 224),
        transforms.TokenizePrompt(tokenizer, discrete_state_input=kind == "pi05"),
        transforms.PadStatesAndActions(openpis.PADDED),
    ]
    after = [transforms.Unnormalize(norms, use_quantiles=ranged)]
    return {"transforms": before, "output_transforms": after}, tokenizer._tokenizer


def lines() -> list[str]:
    """What pi0.5 is told of each state."""
    with TemporaryDirectory() as folder:
        made, words = around("pi05", openpis.save("pi05", Path(folder) / "policy"))
        normalized, _, told, _ = made["transforms"]
        for number, state in enumerate(openpis.states()):
            told(normalized({"state": state, "prompt": openpis.TASKS[number % 2]}))
    return words.lines


def configured(kind: str, dtype: str) -> Pi0Config:
    """openpi's configuration of the network."""
    return Pi0Config(
        dtype=dtype,
        action_dim=openpis.PADDED,
        action_horizon=openpis.HORIZON,
        max_token_len=openpis.LENGTH,
        pi05=kind != "pi0",
        discrete_state_input=kind == "pi05",
        pytorch_compile_mode=None,
    )


def notes(kind: str) -> bytes:
    """``metadata.pt`` as ``train_pytorch.py`` writes it, which trains in bfloat16 unless told otherwise."""
    from openpi.training.config import get_config

    own = replace(get_config("pi05_libero"), exp_name="tiny", model=configured(kind, "bfloat16"))
    file = BytesIO()
    torch.save({"global_step": 3, "config": asdict(own), "timestamp": 0.0}, file)
    return file.getvalue()


def tiny(kind: str, directory: Path, dtype: str) -> Any:
    """openpi's network at the sizes of ``openpis``, in float32; of bfloat16 what it rounds when it is made."""

    def config_of(variant: str) -> Any:
        own = openpis.TEXT if variant == "gemma_2b" else openpis.EXPERT
        return gemma.Config(own.width, own.layers, own.hidden, own.heads, own.groups, own.channels)

    built, expert = gemma_pytorch.PaliGemmaForConditionalGeneration, gemma_pytorch.GemmaForCausalLM

    def smaller(config: Any) -> Any:
        config.text_config.vocab_size = config._vocab_size = openpis.VOCABULARY
        config.text_config.pad_token_id = config.pad_token_id = 0
        vision = config.vision_config
        vision.hidden_size, vision.num_hidden_layers = openpis.VISION.hidden_size, openpis.VISION.num_hidden_layers
        vision.intermediate_size, vision.projection_dim = openpis.VISION.intermediate_size, openpis.TEXT.width
        return built(config)

    def least(config: Any) -> Any:
        config.vocab_size = openpis.VOCABULARY
        return expert(config)

    with ExitStack() as changed:
        changed.enter_context(patch.object(gemma, "get_config", config_of))
        changed.enter_context(patch.object(gemma_pytorch, "PaliGemmaForConditionalGeneration", smaller))
        changed.enter_context(patch.object(gemma_pytorch, "GemmaForCausalLM", least))
        network = PI0Pytorch(configured(kind, dtype)).float()
    missing, unexpected = load_model(network, directory / "model.safetensors", strict=False)
    unread = ("gemma_expert.lm_head.weight", "language_model.norm.weight")
    assert not unexpected, unexpected
    assert all(name.endswith(unread) or ".vision_model.head." in name for name in missing), missing
    return network.eval()


if __name__ == "__main__":
    main()
