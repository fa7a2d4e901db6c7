"""Run Octo on random weights: ``octo.npz``, the folders that it saves, what it is shown, and what it does.

Not run by the tests. Octo needs an environment of its own, without torch, and a clone of octo-models/octo (241fb35)::

    python -m venv octo-env
    octo-env/bin/pip install jax==0.4.20 jaxlib==0.4.20 flax==0.7.5 orbax-checkpoint==0.4.4 "numpy<2" scipy==1.11.4 \\
        transformers==4.36.2 distrax==0.1.5 optax==0.1.7 chex==0.1.85 einops ml_collections
    octo-env/bin/python tests/families/golden/make_octo.py path/to/octo

TensorFlow opens files there and is for data, so it is replaced here, as the libraries of data sets are.
"""

import argparse
import importlib
import io
import json
import os
import subprocess
import sys
import tarfile
import types
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

COMMIT = "241fb35"
SEED, WIDTH, ACTIONS, HORIZON, LENGTH, STEP = 23, 32, 3, 2, 8, 300
T5 = {
    "architectures": ["T5ForConditionalGeneration"],
    "model_type": "t5",
    "d_model": 16,
    "d_ff": 40,
    "d_kv": 8,
    "num_heads": 3,
    "num_layers": 2,
    "vocab_size": 24,
    "relative_attention_num_buckets": 32,
    "relative_attention_max_distance": 128,
    "feed_forward_proj": "relu",
    "layer_norm_epsilon": 1e-06,
    "pad_token_id": 0,
    "eos_token_id": 1,
}
PIECES = ["<pad>", "</s>", "<unk>", *(f"▁{word}" for word in "pick up the red blue cup place it on table now".split())]
TEXTS = ("pick up the red cup", "place it on the table now and then on it again")
"""The second one is longer than what is read."""
STATISTICS = {
    "action": {
        "mean": [0.1, -0.2, 0.5],
        "std": [0.3, 1.5, 0.2],
        "max": [1.0, 2.0, 1.0],
        "min": [-1.0, -2.0, 0.0],
        "p01": [-0.9, -1.9, 0.0],
        "p99": [0.9, 1.9, 1.0],
        "mask": [True, True, False],
    },
    "num_transitions": 100,
    "num_trajectories": 5,
}


class _Anything(types.ModuleType):
    """A module in which every name is something that takes any arguments."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *args, **kwargs: None})


def without_data() -> None:
    """Import the model where TensorFlow's files are those of Python; nothing else of these modules is used."""
    absent = {name: _Anything(name) for name in ("tensorflow", "dlimp")}
    gfile = types.SimpleNamespace(GFile=open, exists=os.path.exists, join=os.path.join)
    absent["tensorflow"].io = types.SimpleNamespace(gfile=gfile)  # type: ignore[attr-defined]
    os.environ["USE_TF"] = "0"  # of transformers
    sys.modules.update(absent)
    importlib.import_module("octo.model.octo_model")
    for name in absent:  # others ask whether it is installed
        del sys.modules[name]


def language_model(folder: Path) -> None:
    """A tiny T5 in a folder of the real one's name, which transformers takes where it is there; and its tokenizer."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors

    pieces = [(piece, -2.0 - 0.1 * i) for i, piece in enumerate(PIECES)]
    made = Tokenizer(models.Unigram(pieces, unk_id=2))
    made.pre_tokenizer = pre_tokenizers.Metaspace()
    made.decoder = decoders.Metaspace()
    made.add_special_tokens(["<pad>", "</s>", "<unk>"])
    made.post_processor = processors.TemplateProcessing("$A </s>", "$A </s> $B </s>", [("</s>", 1)])
    folder.mkdir()
    made.save(str(folder / "tokenizer.json"), pretty=False)
    (folder / "config.json").write_text(json.dumps(T5))
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "T5Tokenizer", "extra_ids": 0}))


def config(spec: Any, cameras: tuple[str, ...], released: bool) -> dict[str, Any]:
    """As ``octo_pretrain_config.py`` has it, in small; or as the models of December had it."""
    from octo.data.utils.text_processing import HFTokenizer
    from octo.model.components.action_heads import DiffusionActionHead
    from octo.model.components.tokenizers import ImageTokenizer, LanguageTokenizer
    from octo.model.components.vit_encoders import SmallStem16

    stem = spec.create(SmallStem16, features=(32, 32, 64, 64), num_features=24)
    head = {"action_horizon": HORIZON, "action_dim": ACTIONS, "hidden_dim": 16, "time_dim": 8}
    return {
        "window_size": 2 if released else 1,
        "model": {
            "observation_tokenizers": {
                name: spec.create(
                    ImageTokenizer, obs_stack_keys=[f"image_{name}"], task_stack_keys=[f"image_{name}"], encoder=stem
                )
                for name in cameras
            },
            "task_tokenizers": {"language": spec.create(LanguageTokenizer, encoder="t5-base", finetune_encoder=False)},
            "heads": {
                "action": spec.create(
                    DiffusionActionHead, readout_key="readout_action", use_map=False, dropout_rate=0.0, **head
                )
            },
            "readouts": {"action": 1 if released else 3},
            "token_embedding_size": WIDTH,
            "transformer_kwargs": {
                "num_layers": 2,
                "mlp_dim": 48,
                "num_attention_heads": 4,
                "dropout_rate": 0.0,
                "attention_dropout_rate": 0.0,
                "add_position_embedding": False,
            },
            "max_horizon": 3,
            **({"repeat_task_tokens": True, "use_correct_attention": True} if released else {}),
        },
        "text_processor": spec.create(
            HFTokenizer,
            tokenizer_name="t5-base",
            encode_with_model=False,
            tokenizer_kwargs={
                "max_length": LENGTH,
                "padding": "max_length",
                "truncation": True,
                "return_tensors": "np",
            },
        ),
    }


SIZES = {"image_primary": (48, 32, 3), "image_wrist": (32, 32, 3)}


def made(name: str, cameras: tuple[str, ...], released: bool, seed: int) -> tuple[Any, Any]:
    """A model that was saved in the folder of this name and loaded again; and what draws what it is shown."""
    import flax
    import jax
    from octo.data.utils.text_processing import HFTokenizer
    from octo.model.octo_model import OctoModel
    from octo.utils.spec import ModuleSpec

    rng = np.random.default_rng(seed)
    entries = config(ModuleSpec, cameras, released)
    window, tokens = entries["window_size"], HFTokenizer(**entries["text_processor"]["kwargs"]).encode(["pick up"])
    images = {key: np.zeros((1, window, *SIZES[key]), np.uint8) for key in (f"image_{each}" for each in cameras)}
    batch = {
        "observation": {
            **images,
            "timestep": np.zeros((1, window), np.int32),
            "timestep_pad_mask": np.ones((1, window), bool),
            "pad_mask_dict": {key: np.ones((1, window), bool) for key in images},
        },
        "task": {
            **{key: value[:, 0] for key, value in images.items()},
            "language_instruction": tokens,
            "pad_mask_dict": {key: np.ones(1, bool) for key in (*images, "language_instruction")},
        },
        "action": np.zeros((1, window, HORIZON, ACTIONS), np.float32),
    }
    model = OctoModel.from_config(
        entries,
        batch,
        rng=jax.random.PRNGKey(seed),
        dataset_statistics=jax.tree_map(np.array, {"toy": STATISTICS}, is_leaf=lambda x: not isinstance(x, dict)),
    )

    # The head takes most of the noise away, so that most actions stay within the bound.
    rows = np.linalg.qr(rng.standard_normal((16, HORIZON * ACTIONS)))[0].T.astype(np.float32)

    def moved(path: tuple[Any, ...], value: Any) -> Any:
        """What is drawn as zeros or ones is something else after training."""
        drawn = np.asarray(value) + 0.1 * rng.standard_normal(value.shape).astype(np.float32)
        if path[-3:] == ("reverse_network", "Dense_0", "kernel"):
            drawn = np.concatenate([0.25 * drawn[: -len(rows)], 0.4 * rows])
        if path[-3:] == ("reverse_network", "Dense_1", "kernel"):
            drawn = 0.1 * drawn + 4.5 * rows.T
        return np.asarray(drawn, np.float32)

    params = flax.traverse_util.path_aware_map(moved, flax.core.unfreeze(model.params))
    model.replace(params=jax.tree_map(jax.numpy.asarray, params)).save_pretrained(STEP, str(Path(name).absolute()))
    return OctoModel.load_pretrained(str(Path(name).absolute())), rng


def called(model: Any, observed: dict[str, Any], pad: list[bool], seed: int) -> dict[str, Any]:
    """What a model does, of two instructions, and the noise that it draws for that."""
    import jax

    window = len(pad)
    tasks = model.create_tasks(texts=list(TEXTS))
    key = jax.random.PRNGKey(seed)
    actions = model.sample_actions(
        observed | {"timestep_pad_mask": np.array([pad, pad])},
        tasks,
        unnormalization_statistics=model.dataset_statistics["toy"]["action"],
        rng=key,
    )
    shape, draws = (2, window, HORIZON * ACTIONS), []
    for _ in range(1 + 20):  # the first one is what the loop begins with
        key, own = jax.random.split(key)
        draws.append(np.asarray(jax.random.normal(own, shape))[:, -1].reshape(2, HORIZON, ACTIONS))
    return {
        "tokens": tasks["language_instruction"]["input_ids"],
        "mask": tasks["language_instruction"]["attention_mask"],
        "pad": np.array([pad, pad]),
        "noise": draws[0],
        "steps": np.stack(draws[1:]),
        "actions": np.asarray(actions),
    }


def run() -> dict[str, Any]:
    """Two models: with two frames of two cameras, as released; with one of one, as of December."""
    arrays: dict[str, Any] = {"texts": np.array(TEXTS)}
    for name, cameras, released in (("two", ("primary", "wrist"), True), ("one", ("primary",), False)):
        model, rng = made(name, cameras, released, SEED + released)
        window = 2 if released else 1
        images = {f"image_{each}": SIZES[f"image_{each}"] for each in cameras}
        shown = {key: rng.integers(0, 256, (2, window, *size), dtype=np.uint8) for key, size in images.items()}
        arrays |= {f"{name}.{key}": value for key, value in shown.items()}
        cases = {"all": (shown, [True] * window)}
        if released:
            alone = {"image_primary": shown["image_primary"]}
            masked = {"image_primary": np.ones((2, window), bool), "image_wrist": np.zeros((2, window), bool)}
            cases["start"] = (shown, [False, True])
            cases["primary"] = (alone, [True, True])
            cases["masked"] = (shown | {"pad_mask_dict": masked}, [True, True])
        for case, (observed, pad) in cases.items():
            one = called(model, observed, pad, seed=5)
            arrays |= {f"{name}.{case}.{key}": value for key, value in one.items()}
            print(name, case, one["actions"].reshape(2, -1))
    for path in sorted(each for each in Path().rglob("*") if each.is_file()):
        arrays[f"file:{path}"] = np.frombuffer(path.read_bytes(), np.uint8)
        print(path, path.stat().st_size)
    return arrays


def main() -> None:
    """``CLONE [-o FOLDER]``, as the other generators have it."""
    parser = argparse.ArgumentParser(description=f"Run Octo from a clone that has commit {COMMIT}.")
    parser.add_argument("clone", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent)
    told = parser.parse_args()
    git = ["git", "-C", str(told.clone), "archive", "--format=tar", COMMIT, "octo"]
    sources, output = subprocess.run(git, check=True, stdout=subprocess.PIPE).stdout, told.output.absolute()
    with TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(sources)) as tar:
            tar.extractall(Path(folder) / "sources")
        sys.path.insert(0, str(Path(folder) / "sources"))
        (Path(folder) / "saved").mkdir()
        os.chdir(Path(folder) / "saved")
        language_model(Path("t5-base"))
        without_data()
        arrays = run()
        os.chdir(output)
    path = output / "octo.npz"
    np.savez_compressed(path, **arrays)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
