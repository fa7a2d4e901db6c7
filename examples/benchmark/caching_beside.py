"""BAC and EVO by their authors' own code, on Diffusion Policy's own network, beside the same cells compiled.

    python examples/benchmark/caching_beside.py DIR CHECKPOINT DIFFUSION_POLICY -t calls.npz -o theirs \
      --bac HAS --updates 3,10 --evo EVO --plans evo-0.95 --ours bac-0.95

CHECKPOINT is of Diffusion Policy's transformer, DIR what was compiled from it, and DIFFUSION_POLICY, HAS and EVO are
clones of github.com/real-stanford/diffusion_policy, ky-ji/HAS (whose ``BACInfer`` is BAC) and pillom/EVO. Diffusion
Policy's code needs hydra-core and dill.

BAC's code gets one dense call of the first recorded observation, and makes a schedule from it: what its blocks add at
each step, how alike that is, where each block is computed, and the union. EVO's code is given cells; its own search
drives 50 episodes for each of up to 5,000 candidates, which is not done here. Then both answer recorded observations as
their authors have it, in PyTorch, and so does the compiled policy with the same cells and the same noise. BAC's cells
are written into a copy of DIR as plans, so that ``rivals.py`` and ``evaluate.py`` can take them.
"""

from __future__ import annotations

import importlib
import json
import logging
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

import click
import numpy as np
import torch
from commands import numbers

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.write import require_replaceable, update_plans
from ttscompile.cli.options import count_option, json_option
from ttscompile.cli.output import print_json, results, results_console, run, say, table
from ttscompile.core.lattice import PlanArray, Source, dense_plan
from ttscompile.core.plan import DENSE, Plan
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.errors import IllegalPlanError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

SEED = 11
"""Of the noise of the call that BAC looks at, and of those that are compared; its code has this one."""

BUBBLING = 5
"""Blocks that take over updates of others, in BAC."""

PARTS = ("sa_block", "mha_block", "ff_block")
"""Blocks of a layer, in order of execution, as both call them."""


def original_policy(clone: Path, checkpoint: Path) -> Any:
    """Diffusion Policy's own policy with the averaged weights of a checkpoint, read by its own means."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "policies"))
    from diffusion_policy_training import find_original

    find_original(clone)
    payload: Any = torch.load(checkpoint, pickle_module=importlib.import_module("dill"), weights_only=False)
    policy: Any = importlib.import_module("hydra.utils").instantiate(payload["cfg"].policy)
    policy.load_state_dict(payload["state_dicts"]["ema_model"])
    return policy.float().eval()


def noise_of(policy: Any, streams: int, seed: int) -> Noise:
    """What a call of the policy draws from torch's own generator after this seed, in the order in which it draws it."""
    shape = (streams, policy.horizon, policy.action_dim)
    torch.manual_seed(seed)
    initial, steps = torch.randn(shape), torch.zeros(policy.num_inference_steps, *shape)
    for k in range(policy.num_inference_steps - 1):  # DDPM's last step draws none
        steps[k] = torch.randn(shape)
    return Noise(initial.numpy(), steps.numpy())


@torch.no_grad()
def answered(policy: Any, obs: Mapping[str, FloatArray], seed: int) -> FloatArray:
    """Actions of all positions ``[B, T, Da]``, in the units of the robot."""
    torch.manual_seed(seed)
    given = {key: torch.from_numpy(value) for key, value in obs.items()}
    found: FloatArray = policy.predict_action(given)["action_pred"].numpy()
    return found


def bac_policies(
    clone: Path, fresh: Callable[[], Any], obs: Mapping[str, FloatArray], updates: Iterable[int], work: Path
) -> dict[int, Any]:
    """BAC's own pipeline from one call: its policies, by the updates of each block.

    Args:
        clone: of ky-ji/HAS.
        fresh: makes the original policy.
        obs: one observation, ``[1, ...]`` each.
        updates: of each block before the union.
        work: where its code keeps what it finds.
    """
    logging.disable(logging.INFO)  # it tells of every block
    sys.path.insert(0, str(clone))

    def run_policy(**_: Any) -> tuple[Any, Any]:
        policy = fresh()
        torch.manual_seed(SEED)  # making it drew weights
        return policy, {key: torch.from_numpy(value) for key, value in obs.items()}

    runs = ModuleType("BACInfer.analysis.run_policy")  # its own opens a simulator's workspace
    runs.__dict__["run_policy"] = run_policy
    sys.modules[runs.__name__] = runs
    analysis = importlib.import_module("BACInfer.analysis.get_optimal_cache_update_steps")
    wrapper = importlib.import_module("BACInfer.core.diffusion_cache_wrapper").FastDiffusionPolicy
    counts = list(updates)
    analysis.get_optimal_cache_update_steps("", str(work), "cpu", metrics=["cosine"], num_caches_list=counts)
    where = str(work / "original" / "optimal_steps" / "cosine")
    return {
        count: wrapper.apply_cache(
            fresh(), optimal_steps_dir=where, num_caches=count, metric="cosine", num_bu_blocks=BUBBLING
        )
        for count in counts
    }


def bac_cells(policy: Any) -> PlanArray:
    """What such a policy computes, int8 ``[K, blocks]``: its schedules, and every block at the last step."""
    steps, layers = policy.num_inference_steps, len(policy.model.decoder.layers)
    cells = np.full((steps, len(PARTS) * layers), Source.TIMESTEP, np.int8)
    for layer in range(layers):
        for part, name in enumerate(PARTS):
            block = len(PARTS) * layer + part
            cells[policy._cache["block_steps"][f"decoder.layers.{layer}_{name}"], block] = Source.COMPUTE
    cells[-1] = Source.COMPUTE
    return cells


def evo_cells(artifact: Artifact, names: Iterable[str]) -> dict[str, PlanArray]:
    """Cells of an artifact's plans as EVO's code executes them: with every block at the last step.

    Raises:
        IllegalPlanError: a plan reads what that code does not keep.
    """
    found = {}
    for name in names:
        cells = artifact.plan(name).cells
        if cells is None or not np.isin(cells, (Source.COMPUTE, Source.TIMESTEP)).all():
            raise IllegalPlanError(f"{name}: EVO's code adds a block's last residual or computes. Name another.")
        found[name] = cells.copy()
        found[name][-1] = Source.COMPUTE
    return found


def evo_policy(clone: Path, fresh: Callable[[], Any], cells: PlanArray, work: Path) -> Any:
    """EVO's own executor with these cells; of 100 steps it computes every block of the last one, too.

    Args:
        clone: of pillom/EVO.
        fresh: makes the original policy.
        cells: int8 ``[K, blocks]`` of COMPUTE and TIMESTEP.
        work: where its code reads them from.
    """
    logging.disable(logging.INFO)
    sys.path.insert(0, str(clone))
    wrapper = importlib.import_module("EVOInfer.acceleration.evo_cache_wrapper").FastDiffusionPolicyEVO
    path = work / "pairs.json"
    path.write_text(json.dumps([[int(block), int(k)] for k, block in np.argwhere(cells == Source.COMPUTE)]))
    return wrapper.apply_cache(fresh(), pairs_path=str(path), num_inference_steps=len(cells))


@dataclass(frozen=True)
class Row:
    """One way to answer.

    Attributes:
        cells: that a call computes.
        error: mean absolute difference of the executed actions from the original's, in their units.
        apart: largest difference of any action from what the same cells give once compiled; None without their code.
        theirs_ms: a call of the authors' code, median; None without it.
        ours_ms: a call of the compiled policy with these cells, median.
    """

    name: str
    cells: int
    error: float
    apart: float | None
    theirs_ms: float | None
    ours_ms: float


class Beside:
    """Holds policies of PyTorch against the same cells compiled.

    Args:
        obs: recorded observations ``[N, ...]`` by key, of N calls.
        rounds: of times, each of one call of everybody.
    """

    def __init__(self, artifact: Artifact, original: Any, obs: Mapping[str, FloatArray], rounds: int) -> None:
        self._artifact, self._obs, self._rounds = artifact, obs, rounds
        self._streams = len(next(iter(obs.values())))
        self._noise = noise_of(original, self._streams, SEED)
        self._original, self._dense = original, answered(original, obs, SEED)

    def rows(self, policies: Mapping[str, tuple[Any, Plan]]) -> list[Row]:
        """Of each policy, or None, and the plan that is as it is, after the original itself."""
        given = {"the original": (self._original, self._artifact.plan(DENSE)), **policies}
        opened = {name: open_policy(self._artifact, plan=plan, threads=1) for name, (_, plan) in given.items()}
        times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in given}
        one = {key: value[:1] for key, value in self._obs.items()}
        for number in range(1 + self._rounds):
            for name, (policy, _) in given.items():
                took = [_took(partial(opened[name].predict_action, one))]
                took += [] if policy is None else [_took(partial(answered, policy, one, number))]
                for kept, ms in zip(times[name], took, strict=False):
                    kept += [ms][: bool(number)]  # the first does not count
        return [self._row(name, opened[name], *given[name], times[name]) for name in given]

    def _row(
        self, name: str, compiled: CompiledPolicy, policy: Any, plan: Plan, times: tuple[list[float], list[float]]
    ) -> Row:
        """Of one, from the same noise."""
        compiled.reset()
        ours = np.asarray(compiled.predict_action(dict(self._obs), noise=self._noise)["action_pred"])
        theirs = None if policy is None else answered(policy, self._obs, SEED)
        chunk = self._artifact.manifest.spec.chunk
        wrong = (ours if theirs is None else theirs) - self._dense
        cells = dense_plan(*_shape(self._artifact)) if plan.cells is None else plan.cells
        return Row(
            name,
            int((cells == Source.COMPUTE).sum()),
            float(np.abs(wrong[:, chunk.start : chunk.stop]).mean()),
            None if theirs is None else float(np.abs(theirs - ours).max()),
            None if theirs is None else float(np.median(times[1])),
            float(np.median(times[0])),
        )


def _took(call: Callable[[], Any]) -> float:
    """Milliseconds."""
    begun = perf_counter()
    call()
    return 1000 * (perf_counter() - begun)


def _shape(artifact: Artifact) -> tuple[int, int]:
    return artifact.manifest.steps, len(artifact.manifest.blocks)


def _clone(name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    kind = click.Path(exists=True, file_okay=False, path_type=Path)
    return click.option(f"--{name}", type=kind, help=f"A clone that has {name.upper()}'s code.")


@click.command()
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("checkpoint", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("original", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-t", "--trajectories", required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(file_okay=False, path_type=Path), help="A copy of DIR.")
@_clone("bac")
@_clone("evo")
@click.option("--updates", default="3,10", show_default=True, callback=numbers, help="Of each block, for BAC.")
@click.option("--plans", default="", help="Plans of DIR that EVO's code executes, with commas between them.")
@click.option("--ours", default="", help="Plans of DIR that are told of beside, with commas between them.")
@count_option("--calls", "Answer so many recorded observations, at most.", default=64)
@count_option("--rounds", "Time so many calls.", default=10)
@json_option
def main(
    directory: Path,
    checkpoint: Path,
    original: Path,
    trajectories: Path,
    output: Path,
    bac: Path | None,
    evo: Path | None,
    updates: Sequence[int],
    plans: str,
    ours: str,
    calls: int,
    rounds: int,
    as_json: bool,
) -> None:
    """Answer with the authors' code, and with the same cells compiled."""
    require_replaceable(output)
    torch.set_num_threads(1)
    artifact = load_artifact(directory)
    base, executed = artifact.plan(DENSE), {} if evo is None else evo_cells(artifact, filter(None, plans.split(",")))
    with np.load(trajectories) as file:
        recorded = {key: file[key] for key in artifact.manifest.spec.observations}
    count = len(next(iter(recorded.values())))
    chosen = np.unique(np.linspace(0, count - 1, min(calls, count)).astype(int))
    work = output.with_name(f"{output.name}-work")
    work.mkdir(parents=True, exist_ok=True)

    def fresh() -> Any:
        return original_policy(original, checkpoint)

    whole, beside = fresh(), dict[str, tuple[Any, Plan]]()  # before other clones, which have copies of its code
    if bac is not None:
        first = {key: value[:1] for key, value in recorded.items()}
        for number, policy in bac_policies(bac, fresh, first, updates, work).items():
            beside[f"bac-theirs-{number}"] = policy, replace(base, cells=bac_cells(policy))
    made = {name: plan for name, (_, plan) in beside.items()}
    for name, cells in executed.items():
        assert evo is not None
        beside[f"{name} in EVO's code"] = evo_policy(evo, fresh, cells, work), replace(base, cells=cells)
    beside |= {name: (None, artifact.plan(name)) for name in filter(None, ours.split(","))}
    obs = {key: value[chosen].astype(np.float32) for key, value in recorded.items()}
    rows = Beside(artifact, whole, obs, rounds).rows(beside)
    shutil.rmtree(work)
    shutil.rmtree(output, ignore_errors=True)
    shutil.copytree(directory, output)
    if made:
        update_plans(output, {**artifact.plans, **made}, artifact.manifest.default_plan)
    if as_json:
        print_json({"machine": fingerprint(), "calls": len(chosen), "rows": [asdict(row) for row in rows]})
        return
    told = table("authors' code", "cells", "error", "apart", "theirs, ms", "compiled, ms")
    for row in rows:
        told.add_row(
            row.name,
            str(row.cells),
            f"{row.error:.3g}",
            "" if row.apart is None else f"{row.apart:.1g}",
            "" if row.theirs_ms is None else f"{row.theirs_ms:.1f}",
            f"{row.ours_ms:.1f}",
        )
    results_console().print(told)
    say(results(), f"Error: of the executed actions of {len(chosen)} calls, from the original's with the same noise.")
    say(results(), one_line(fingerprint()))


if __name__ == "__main__":
    run(main)
