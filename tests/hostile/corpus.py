"""Small files that are as they should be, from which the fuzzer makes bad ones."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.conftest import ROOT, find_shared

OBSERVATION = (2,)
"""Shape of the toy policies' one observation, ``obs``."""


def make(folder: Path) -> None:
    """Write the corpus: artifacts, checkpoints, trajectories, a calibration's state. Takes torch and some seconds."""
    import torch

    from tests.plans import store_schedules
    from tests.runtimes.toys import pencil_program, toy_program, written_artifact
    from ttscompile.calibration.state import StateFile
    from ttscompile.core.correction import no_correction
    from ttscompile.core.lattice import dense_plan

    torch.set_num_threads(1)
    written_artifact(pencil_program(), folder / "artifacts" / "pencil")
    for name, program in {"toy": toy_program(3, 3), "bare": toy_program(2, 2, noise=0.0, pruner=False)}.items():
        path = folder / "artifacts" / name
        artifact = written_artifact(program, path)
        sparse = dense_plan(artifact.manifest.steps, len(artifact.manifest.blocks))
        sparse[1:, ::2] = 2
        store_schedules(
            path,
            artifact.pruner or None,
            {"schedule": sparse, "uniform": sparse},
            "schedule",
            {"seed": 0, "note": [1, 2.5, None, {"a": "b"}]},
            corrections={"schedule": no_correction(artifact.manifest.steps, artifact.manifest.spec.sample)},
        )
    _checkpoints(folder / "checkpoints")
    _lerobot(folder / "lerobot")
    _trajectories(folder / "trajectories")
    _recordings(folder / "recordings")
    (folder / "states").mkdir()
    state = StateFile(folder / "states", {"model": "0" * 16, "seed": 0, "budget": {"kind": "sparsity", "value": 0.9}})
    state.progress = {"intervals": 3, "seconds": 1.5, "whole": {"4": [0, 1]}}
    state.put("search", {"logits": np.zeros((3, 3, 4), np.float32), "best": np.zeros((3, 3), np.int8)})
    state.save()


def _checkpoints(folder: Path) -> None:
    import torch

    from tests.policies import unets
    from tests.policies.conftest import _config, _weights

    folder.mkdir()
    for name, as_cond in {"conditioned": True, "inpainting": False}.items():
        config = _config(as_cond)
        states = {key: _weights(config["policy"]["model"], seed) for seed, key in enumerate(("model", "ema_model"))}
        payload = {"cfg": config, "state_dicts": states, "pickles": {"epoch": b"not even a pickle"}}
        torch.save(payload, folder / f"{name}.ckpt")
    for name in ("local", "dp3"):
        torch.save(unets.payload(name), folder / f"unet-{name}.ckpt")
    shared = find_shared(ROOT)
    if shared is not None:
        shutil.copy(shared / "golden" / "diffusion_policy" / "bert.ckpt", folder / "golden.ckpt")


def _lerobot(folder: Path) -> None:
    from tests.policies import lerobot_unets
    from tests.policies.lerobot_tiny import save_policy

    lerobot_unets.save("states", folder / "unet" / "policy")
    policies: dict[str, dict[str, Any]] = {
        "images": {
            "cameras": ("top", "wrist"),
            "renamed": {"arm": "observation.state"},
            "noise_scheduler_type": "DDPM",
        },
        "flow": {"objective": "flow_matching", "integration_method": "rk4", "use_positional_encoding": True},
    }
    for name, settings in policies.items():
        (folder / name).mkdir(parents=True)
        save_policy(folder / name, **settings)


def _trajectories(folder: Path) -> None:
    folder.mkdir()
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((9, *OBSERVATION)).astype(np.float32)
    np.savez(folder / "calls.npz", obs=obs, episode_ends=np.array([4, 9]))
    meta = np.array(json.dumps({"frames": True}))
    np.savez_compressed(folder / "frames.npz", obs=obs[:, 0], episode_ends=np.array([4, 9]), meta=meta)
    np.savez(folder / "wide.npz", obs=obs.astype(np.float64), episode_ends=np.array([9], np.uint8), other=obs)
    shared = find_shared(ROOT)
    if shared is not None:
        with np.load(shared / "golden" / "tts" / "mixed_95.npz") as file:
            few = {name: file[name][:2] for name in file.files if file[name].ndim}
        np.savez(folder / "golden.npz", **few)


def _recordings(folder: Path) -> None:
    """Data sets as users have them."""
    from tests.hostile import dataset_changes, hdf5_changes, zarr_changes
    from tests.trajectories.data_sets import as_hdf5, as_lerobot, as_zarr

    zarr_changes.make(folder / "zarr", as_zarr)
    hdf5_changes.make(folder / "hdf5", as_hdf5)
    dataset_changes.make(folder / "lerobot-dataset", as_lerobot)


if __name__ == "__main__":
    make(Path(sys.argv[1]))
