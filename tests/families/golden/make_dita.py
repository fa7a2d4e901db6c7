"""Run Dita, whole, at tiny sizes on seeded weights, and write what it gives: ``dita.npz``.

Not run by the tests. Needs a clone of RoboDita/Dita (66350e7), timm 0.9.10, flamingo-pytorch 0.1.2 and einops::

    PYTHONPATH=timm-0.9.10:flamingo python -m tests.families.golden.make_dita path/to/Dita
"""

import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from tokenizers import pre_tokenizers
from torch import Tensor, nn
from torch.nn import functional
from transformers import CLIPConfig, CLIPModel

from tests.policies import ditas

from .originals import Arrays, absent, generator, normal, on_cpu, seeded, timm

VISION = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}


def run(folder: Path) -> dict[str, Arrays]:
    """The actions of each case, as the authors' own evaluation asks for them."""
    for wanted in ("diffusers.DDIMScheduler", "transformers.LlamaForCausalLM", "transformers.AutoTokenizer"):
        package, _, name = wanted.partition(".")
        getattr(importlib.import_module(package), name)  # before parts are there of what they look for
    xformers = ModuleType("xformers.ops")
    xformers.__dict__["memory_efficient_attention"] = _attention
    sys.modules.update({"xformers": ModuleType("xformers"), "xformers.ops": xformers})
    sys.modules["xformers"].__dict__["ops"] = xformers
    timm("0.9.10")
    _constants()
    absent("torchvision", "torchvision.transforms")
    transforms = sys.modules["torchvision.transforms"]
    transforms.__dict__.update(Compose=lambda steps: steps[-1], Normalize=_Normalize)
    sys.modules["torchvision"].__dict__["transforms"] = transforms
    absent("vision_tokenizers.clip", "utils", "utils.data_utils", "gymnasium", "sapien", "sapien.core", "Dataset_Sim")
    absent("Dataset_Sim.SimDataset", "transforms3d", "transforms3d.quaternions", "pytorch3d", "pytorch3d.transforms")
    absent("openvla", "openvla.prismatic", "openvla.prismatic.util", "openvla.prismatic.util.robot_utils")
    utils = ("io_utils", "sapien_utils", "visualization", "visualization.cv2_utils", "wrappers")
    absent("mani_skill2", "mani_skill2.envs", "mani_skill2.envs.sapien_env", "mani_skill2.utils")
    absent(*(f"mani_skill2.utils.{name}" for name in utils))
    sys.path.insert(0, str(folder / "scripts"))
    with patch("numpy.load", lambda path: {"cameras": None}):
        evaluation = importlib.import_module("close_loop_eval_diffusion")
    importlib.import_module("vision_tokenizers.vit_tokenizer").__dict__["create_model"] = _tower
    found: Arrays = {"seed": ditas.SEED, "shapes": ""}
    with TemporaryDirectory() as place:
        os.chdir(place)
        found |= {f"file:{path.name}": _bytes(path) for path in _clip(Path(ditas.CLIP))}
        shapes = {}
        for case in ditas.CASES:
            network = _network(case)
            shapes[case] = {name: list(value.shape) for name, value in network.state_dict().items()}
            found |= {f"{case}.{name}": value for name, value in _made(evaluation, network, case).items()}
        os.chdir("/")
    found["shapes"] = np.frombuffer(json.dumps(shapes).encode(), np.uint8)
    return {"dita": found}


def _attention(q: Tensor, k: Tensor, v: Tensor, p: float = 0.0, attn_bias: Any = None) -> Tensor:
    """What xformers' ``memory_efficient_attention`` is, of ``[B, L, heads, C]``; without it Dita is not imported."""
    assert not p
    assert attn_bias is None
    q, k, v = (each.transpose(1, 2) for each in (q, k, v))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2)


class _Normalize(nn.Module):
    """torchvision's, and the one thing that is done to pictures here."""

    def __init__(self, mean: tuple[float, ...], deviation: tuple[float, ...]) -> None:
        super().__init__()
        self.mean, self.deviation = (torch.tensor(each)[:, None, None] for each in (mean, deviation))

    def forward(self, pixels: Tensor) -> Tensor:
        return (pixels - self.mean) / self.deviation


def _constants() -> None:
    """The module of timm that has the colours of ImageNet, without the package that it is in."""
    path = Path(importlib.import_module("timm").__file__ or "").parent / "data" / "constants.py"
    spec = importlib.util.spec_from_file_location("timm.data.constants", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules["timm.data.constants"] = module


def _tower(name: str, pretrained: bool, **settings: Any) -> nn.Module:
    """``vit_base_patch14_reg4_dinov2`` of timm, of two layers 128 wide."""
    assert name == "vit_base_patch14_reg4_dinov2.lvd142m"
    sizes = {"patch_size": 14, "embed_dim": ditas.WIDTH, "depth": 2, "num_heads": 2, "num_classes": 0}
    variant = {"init_values": 1e-5, "reg_tokens": 4, "no_embed_class": True}
    models = importlib.import_module("timm.models.vision_transformer")
    made: nn.Module = models.VisionTransformer(**sizes, **variant, **settings)
    return made


def _network(case: str) -> Any:
    own = ditas.CASES[case]
    network = importlib.import_module("llama_dp").RobotTransformerNet(
        output_tensor_spec=None,
        trajectory_dim=own.actions,
        token_embedding_size=ditas.WIDTH,
        intermediate_size=80,
        num_layers=2,
        time_sequence_length=own.horizon,
        dropout_rate=0.0,
        input_size=str(own.size),
        use_qformer=own.maker,
        qformer_depth=2,
        use_wrist_img=own.wrist,
        scheduler_type=own.schedule,
        num_inference_steps=10,
    )
    seeded(network, ditas.SEED)
    return network


def _clip(folder: Path) -> list[Path]:
    """A tiny CLIP whose words are letters, as transformers saves it; the files that the tests need beside weights."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    words = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    text = {"vocab_size": len(words), "bos_token_id": len(words) - 2, "eos_token_id": 2, "projection_dim": 16}
    sizes = {"hidden_size": ditas.WIDTH, "intermediate_size": 96, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision = VISION | {"image_size": 8, "patch_size": 4}
    model = CLIPModel(CLIPConfig(text_config=text | sizes, vision_config=vision, projection_dim=16))
    seeded(model.text_model, ditas.SEED)
    model.save_pretrained(folder)
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    names = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "unk_token": "<|endoftext|>"}
    settings = {"tokenizer_class": "CLIPTokenizer", "pad_token": "<|endoftext|>", **names}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings))
    return [folder / name for name in ("config.json", "vocab.json", "merges.txt")]


def _bytes(path: Path) -> np.ndarray:
    return np.frombuffer(path.read_bytes(), np.uint8)


class _Parallel(nn.Module):
    """As the training wraps a network; the evaluation asks the inner one whether it has a camera at the wrist."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module


def _made(evaluation: Any, network: Any, case: str) -> Arrays:
    """What ``PytorchDiffInference`` is given, and does, with each of the instructions."""
    own = ditas.CASES[case]
    parallel = _Parallel(network)
    policy = evaluation.PytorchDiffInference(
        parallel, sequence_length=own.horizon, device="cpu", num_pred_action=own.horizon - own.frames + 1
    )
    noise, actions = normal(own.seed)(len(ditas.TASKS), own.horizon, own.actions), []
    for stream, task in enumerate(ditas.TASKS):
        policy.reset_observation()
        policy.set_natural_instruction(task)
        frames = ditas.pictures(case, "image")[stream]
        for frame in frames[:1] if own.repeated else frames:
            policy.set_observation(frame)
        if own.wrist:
            # Of its window this evaluation would give the oldest frames, and the training the newest.
            wrist = torch.from_numpy(ditas.pictures(case, "wrist_image")[stream])
            policy.model_input_wrist = policy.data_transform((wrist / 255.0).permute(0, 3, 1, 2))
        given = torch.from_numpy(noise[stream : stream + 1])
        draws = patch("torch.randn", lambda *shape, given=given, **_: _drawn(shape, own.size) if shape else given)
        with draws, on_cpu(), patch.object(network, "inference", _Kept(network.inference)) as kept:
            policy.inference(ret_7=True)
        names = ["world_vector", "rotation_delta", "gripper_closedness_action"]
        names += [] if own.actions == 7 else ["terminate_episode"]
        actions.append(torch.cat([kept.given[name] for name in names], -1))
    return {"noise": noise, "actions": torch.cat(actions).numpy()}


class _Kept:
    """Calls a function, and keeps what it gives."""

    def __init__(self, function: Any) -> None:
        self._function = function

    def __call__(self, *values: Any, **named: Any) -> Any:
        self.given = self._function(*values, **named)
        return self.given


def _drawn(shape: tuple[int, ...], size: tuple[int, int]) -> Tensor:
    """What the wrist's dropout draws, ``[B, patches]``, so that it keeps every second patch, as on a chessboard."""
    rows, columns = (torch.arange(side // 14) for side in size)
    order = torch.where((rows[:, None] + columns) % 2 == 1, 0, 1).flatten()
    return (order * 1.0 + torch.arange(len(order)) * 1e-3).expand(shape)


main = generator(run, "66350e7", "scripts")

if __name__ == "__main__":
    main()
