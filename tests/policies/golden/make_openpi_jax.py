"""Run openpi's JAX policy at tiny sizes, on weights that its trainer's checkpointer saved: ``openpi_jax.npz``.

Not run by the tests. Needs what ``make_openpi`` needs, and is run so; on a processor (``JAX_PLATFORMS=cpu``)::

    PYTHONPATH=.:CLONE/src:CLONE/packages/openpi-client/src python -m tests.policies.golden.make_openpi_jax

Weights are few different numbers, each a bfloat16, so that the folders stay small. All is computed in float32.
"""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import openpi.models.gemma as gemma
import openpi.models.siglip as siglip
import orbax.checkpoint as ocp
from flax import nnx, traverse_util
from openpi.models.lora import LoRAConfig
from openpi.models.model import restore_params
from openpi.models.pi0_config import Pi0Config
from openpi.policies.policy import Policy

from .. import openpis
from .make_openpi import around, given

KINDS = ("pi0", "pi05")
"""The first has adapters (LoRA), and is saved as plain arrays of bfloat16; the other as a state of nnx, of float32."""


def main() -> None:
    """One file."""
    numbers: dict[str, Any] = {}
    for kind in KINDS:
        with TemporaryDirectory() as folder:
            directory = Path(folder) / kind
            config = configured(kind)
            save(kind, config, directory)
            params = restore_params(directory / "params", dtype=jnp.float32)
            openpis.save_statistics(directory)
            made = chunks(config, params, around(kind, directory)[0])
            numbers |= {f"{kind}.{case}": chunk for case, chunk in made.items()}
            for path in sorted(each for each in (directory / "params").rglob("*") if each.is_file()):
                name = path.relative_to(folder).as_posix()
                numbers[f"file:{name}"] = np.frombuffer(path.read_bytes(), np.uint8)
    path = Path(__file__).with_name("openpi_jax.npz")
    np.savez_compressed(path, **numbers)
    print(path, path.stat().st_size, "bytes")


def chunks(config: Pi0Config, params: Any, about: dict[str, Any]) -> dict[str, Any]:
    """The chunks ``[1, T, D]`` of both calls, and of the first without a camera."""
    cases = {"0": (0, ""), "1": (1, ""), "missing": (0, openpis.ABSENT)}

    def infer() -> dict[str, Any]:
        policy = Policy(config.load(params), **about)
        return {case: policy.infer(given(*how), noise=openpis.noise())["actions"] for case, how in cases.items()}

    return {case: np.asarray(chunk, np.float32)[None] for case, chunk in sized(infer).items()}


def configured(kind: str) -> Pi0Config:
    """openpi's configuration of a policy."""
    ending = "_lora" if kind == "pi0" else ""
    return Pi0Config(
        dtype="float32",
        action_dim=openpis.PADDED,
        action_horizon=openpis.HORIZON,
        max_token_len=openpis.LENGTH,
        pi05=kind != "pi0",
        paligemma_variant=f"gemma_2b{ending}",
        action_expert_variant=f"gemma_300m{ending}",
    )


def sized(make: Callable[[], Any]) -> Any:
    """What is made while openpi's networks have the sizes of ``openpis``; adapters of rank 2."""

    def config_of(variant: str) -> Any:
        own = openpis.TEXT if variant.startswith("gemma_2b") else openpis.EXPERT
        adapted = LoRAConfig(rank=2, alpha=2.0)
        made = gemma.Config(own.width, own.layers, own.hidden, own.heads, own.groups, own.channels)
        made.lora_configs = {"attn": adapted, "ffn": adapted} if "lora" in variant else {}
        return made

    seen = openpis.VISION
    vision: dict[str, Any] = {
        "width": seen.hidden_size,
        "depth": seen.num_hidden_layers,
        "mlp_dim": seen.intermediate_size,
    }
    vision |= {"num_heads": 16, "patch_size": (14, 14)}
    with ExitStack() as changed:
        changed.enter_context(patch.object(gemma, "get_config", config_of))
        changed.enter_context(patch.object(gemma, "PALIGEMMA_VOCAB_SIZE", openpis.VOCABULARY))
        changed.enter_context(patch.object(siglip, "decode_variant", lambda _: vision))
        return make()


def save(kind: str, config: Pi0Config, directory: Path) -> None:
    """``params`` of a checkpoint, as openpi's ``save_state`` writes it."""
    state = sized(lambda: nnx.state(nnx.eval_shape(config.create, jax.random.key(0)), nnx.Param))
    shapes = traverse_util.flatten_dict(state.to_pure_dict())
    dtype = jnp.bfloat16 if kind == "pi0" else jnp.float32
    drawn = {path: jnp.asarray(numbers("/".join(path), each.shape), dtype) for path, each in shapes.items()}
    params: Any = traverse_util.unflatten_dict(drawn)
    if kind == "pi05":
        state.replace_by_pure_dict(params)
        params = state
    with ocp.CheckpointManager(directory.parent / "run", item_handlers={"params": ocp.PyTreeCheckpointHandler()}) as at:
        at.save(3, {"params": {"params": params}})
        at.wait_until_finished()
    (directory.parent / "run" / "3").rename(directory)


def numbers(name: str, shape: tuple[int, ...]) -> Any:
    """Five different ones, those of matrices smaller the more are added."""
    rng = np.random.RandomState(sum(ord(c) * (i + 1) for i, c in enumerate(name)) % 2**31)
    drawn = rng.randint(-2, 3, shape).astype(np.float32) / 2
    if name.endswith(("bias", "scale")):
        return drawn / 4 + ("LayerNorm" in name or "encoder_norm" in name) * name.endswith("scale")
    if "embedding" in name and not name.endswith("kernel"):
        return drawn
    added = {"embedding/kernel": 14 * 14 * 3, "attn_vec_einsum": 64, "out/kernel": 32}
    count = next((n for part, n in added.items() if part in name), shape[1] if "query" in name else shape[-2])
    return drawn * 2 ** np.round(np.log2(1.4 / np.sqrt(count)))


if __name__ == "__main__":
    main()
