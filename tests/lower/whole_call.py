"""Calls of a policy through its single ONNX file, with the state of an episode kept by hand."""

from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

import ttscompile
from tests.runtimes.toys import toy_program
from ttscompile import Noise
from ttscompile.artifact import load_artifact
from ttscompile.artifact.write import write_artifact
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.lower.single_file import lower_single_file
from ttscompile.runtimes.onnxruntime.sessions import EXACT_INTEGERS
from ttscompile.runtimes.policy import CompiledPolicy

Arrays = dict[str, np.ndarray]


@lru_cache(maxsize=1)
def opened(model: str | bytes) -> onnxruntime.InferenceSession:
    """A session, which keeps nothing from call to call: the episodes of a test share it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry(EXACT_INTEGERS, "1")  # or int8 saturates on processors without VNNI
    options.log_severity_level = 3  # optional inputs have values in the model, which is worth a warning to it
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


class Episode:
    """Calls of the single file that hand the rollout cache on, as its user would."""

    def __init__(self, model: str | bytes, streams: int) -> None:
        self.session = opened(model)
        shapes = {value.name: value.shape for value in self.session.get_inputs()}
        self.takes_noise = "step_noise" in shapes
        self.rows = np.zeros((0, *shapes["rollout_rows"][1:]), np.float32)
        self.index = np.full((streams, *shapes["rollout_index"][1:]), -1, np.int64)

    def call(self, obs: Arrays, noise: Noise, plan: np.ndarray, **more: Any) -> Arrays:
        plans = plan.astype(np.int8).reshape(-1, *plan.shape[-2:])  # one for all streams, or one for each
        feeds = {"rollout_keep": np.ones(self.index.shape[1:], np.bool_), "plan": plans, **obs, **more}
        if self.takes_noise:
            feeds["step_noise"] = noise.steps
        feeds |= {"rollout_rows": self.rows, "rollout_index": self.index, "initial_noise": noise.initial}
        names = [value.name for value in self.session.get_outputs()]
        out = dict(zip(names, self.session.run(names, feeds), strict=True))
        self.rows, self.index = out["rollout_rows_next"], out["rollout_index_next"]
        return out


def make(program: Program, folder: Path) -> tuple[CompiledPolicy, bytes]:
    models = lower_program(program)
    write_artifact(program, models, folder / "artifact")
    model = lower_single_file(program, models, program.weights)
    onnx.checker.check_model(model, full_check=True)
    return ttscompile.load(folder / "artifact", "reference"), model.SerializeToString(deterministic=True)


@cache
def lowered(**options: Any) -> tuple[Program, dict[str, onnx.ModelProto], onnx.ModelProto]:
    """A toy program of these options, its models, and the single file of them; none of it is to be changed."""
    program = toy_program(**options)
    models = lower_program(program)
    model = lower_single_file(program, models, program.weights)
    onnx.checker.check_model(model, full_check=True)
    return program, models, model


def make_toy(folder: Path, **options: Any) -> tuple[Program, CompiledPolicy, bytes]:
    """The same with its artifact, ``artifact`` in the folder, as the reference runs it, and the bytes of the file."""
    program, models, model = lowered(**options)
    write_artifact(program, models, folder / "artifact")
    return program, ttscompile.load(folder / "artifact", "reference"), model.SerializeToString(deterministic=True)


def inputs(policy: CompiledPolicy, rng: np.random.Generator, streams: int) -> tuple[Arrays, Noise]:
    info = policy.info
    obs = {k: rng.standard_normal((streams, *o.shape)).astype(o.dtype) for k, o in info.observation.items()}
    draws = rng.standard_normal((info.K, streams, *info.sample), dtype=np.float32) if info.stochastic else None
    return obs, Noise(rng.standard_normal((streams, *info.sample), dtype=np.float32), draws)


def policy_groups(artifact: Path) -> tuple[int, ...]:
    return load_artifact(artifact).manifest.groups


def groups(program: Program) -> list[int]:
    return [block.group for block in program.blocks]


def every_way(directory: Path, model: bytes, obs: Arrays, noise: Noise) -> dict[str, np.ndarray]:
    """Actions of one dense call, by what makes them: each runtime, the single ONNX file, and ``to_module``."""
    made: dict[str, np.ndarray] = {}
    for name in ("onnxruntime", "torch", "reference"):
        made[name] = ttscompile.load(directory, name).predict_action(obs, noise, plan="dense")["action_pred"]
    cells = load_artifact(directory).plans["dense"].cells
    assert isinstance(cells, np.ndarray)
    made["file"] = Episode(model, len(noise.initial)).call(obs, noise, cells)["action_pred"]
    module = ttscompile.to_module(directory, "dense")
    with torch.inference_mode():
        given = {key: torch.from_numpy(value) for key, value in obs.items()}
        made["module"] = module(given, torch.from_numpy(noise.initial)).numpy()
    return made
