"""Small Ditas as their training saves them, what they are shown, and what the original did; see ``make_dita``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from safetensors.torch import save_file

from tests.families.checks import Arrays, golden
from tests.families.weights import draw_weights

CLIP, SEED, WIDTH = "openai/clip-vit-large-patch14", 19, 128
TASKS = ("pick up the red cube", "Open the drawer, slowly!")
TOKENS, MASK, WORDS = (
    "language_instruction.input_ids",
    "language_instruction.attention_mask",
    "natural_language_embedding",
)
CONFIG: dict[str, Any] = {
    "task_name": "calvin_exp",
    "batch_size": 32,
    "prediction_type": "epsilon",
    "trajectory_dim": 7,
    "use_action_head_diff": 0,
    "num_inference_steps": 10,
    "dataset": {"num_given_observation": 2, "stride": 4},
    "model": {"name": "llama_dp", "num_layers": 12, "dim_align_type": 2},
    "hydra": {"run": {"dir": "./outputs/${task_name}"}},
}

Weights = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """Variant, and what its policy is shown.

    Attributes:
        size: height and width of a picture.
        maker: ``use_qformer``: 1, or 2 for the resampler.
        schedule: ``scheduler_type``.
        repeated: whether there is one frame so far.
        seed: of noise and pictures. Ten steps on random weights amplify rounding; with these seeds 20 times at most.
    """

    size: tuple[int, int]
    actions: int
    horizon: int
    frames: int
    maker: int = 1
    wrist: bool = False
    schedule: int = 0
    repeated: bool = False
    seed: int = 0


CASES = {
    "static": Case((28, 28), actions=7, horizon=6, frames=2, seed=237),
    "wrist": Case((42, 28), actions=11, horizon=5, frames=2, wrist=True, schedule=1, seed=204),
    "resampler": Case((28, 28), actions=7, horizon=4, frames=3, maker=2, repeated=True, seed=209),
}


def pictures(case: str, camera: str) -> np.ndarray:
    """uint8 ``[streams, frames, H, W, 3]``, as a camera gives them."""
    own = CASES[case]
    rng = np.random.default_rng([own.seed, len(camera)])
    drawn = rng.integers(0, 256, (len(TASKS), own.frames, *own.size, 3), dtype=np.uint8)
    return np.repeat(drawn[:, :1], own.frames, 1) if own.repeated else drawn


def observed(case: str) -> Arrays:
    """The pictures as the policy is given them."""
    cameras = ("image", "wrist_image") if CASES[case].wrist else ("image",)
    return {name: np.moveaxis(pictures(case, name), -1, 2).astype(np.float32) / 255 for name in cameras}


def weights(case: str) -> Weights:
    """Those of the golden file, under the names of ``RobotTransformerNet.state_dict``."""
    shapes = json.loads(golden("dita")["shapes"].tobytes())[case]
    return dict(draw_weights(shapes, SEED))


def save(folder: Path, case: str = "static", held: Weights | None = None, **changes: Any) -> Path:
    """As the training writes it: ``checkpoints`` in the folder where hydra has put ``.hydra``."""
    own = CASES[case]
    for name in (".hydra", "checkpoints"):
        (folder / name).mkdir(exist_ok=True, parents=True)
    settings = {
        **CONFIG,
        "num_pred_action": own.horizon - own.frames + 1,
        "scheduler_type": own.schedule,
        "dataset": {**CONFIG["dataset"], "traj_length": own.horizon},
        **({} if own.size[0] == own.size[1] else {"input_size": str(own.size)}),
    }
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(settings | changes))
    path = folder / "checkpoints" / "ckpt_1000.pth"
    optimizer = {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 1e-4, "params": [0]}]}
    parameter = weights(case) if held is None else held
    torch.save({"parameter": parameter, "optimizer": optimizer, "epoch": 1, "loss": torch.tensor(0.1)}, path)
    return path


def save_clip(folder: Path) -> Path:
    """The tiny CLIP in a folder of its name, whose parent is given: what ``--encoders`` names."""
    place = folder / CLIP
    place.mkdir(parents=True)
    for name, content in golden("dita").items():
        if name.startswith("file:"):
            (place / name.removeprefix("file:")).write_bytes(content.tobytes())
    config = json.loads((place / "config.json").read_text())["text_config"]
    width, hidden, words = config["hidden_size"], config["intermediate_size"], config["vocab_size"]
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.token_embedding.weight": (words, width),
        "embeddings.position_embedding.weight": (77, width),
    }
    for layer in range(config["num_hidden_layers"]):
        own = f"encoder.layers.{layer}"
        squares = [f"{own}.self_attn.{name}_proj" for name in ("q", "k", "v", "out")]
        sizes = {**dict.fromkeys(squares, (width, width)), f"{own}.mlp.fc1": (hidden, width)}
        for name, size in {**sizes, f"{own}.mlp.fc2": (width, hidden)}.items():
            shapes |= {f"{name}.weight": size, f"{name}.bias": size[:1]}
        for norm in (f"{own}.layer_norm1", f"{own}.layer_norm2"):
            shapes |= {f"{norm}.{name}": (width,) for name in ("weight", "bias")}
    shapes |= {f"final_layer_norm.{name}": (width,) for name in ("weight", "bias")}
    drawn = {f"text_model.{name}": value for name, value in draw_weights(shapes, SEED).items()}
    others = {"text_projection.weight": torch.zeros(16, width), "text_model.embeddings.position_ids": torch.arange(77)}
    save_file(drawn | others, place / "model.safetensors")
    return folder
