"""What is timed: the Push-T policy, and networks of its family in other sizes; their sampler, and plans for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

import ttscompile
from ttscompile import Source
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import PlanArray, uniform_plan
from ttscompile.core.spec import ORIGINAL, ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.scheduler import configured_sampler
from ttscompile.policies.diffusion_policy.parts import TokensDenoiser
from ttscompile.policies.networks.transformer_for_diffusion import TransformerConfig, TransformerForDiffusion

PUSHT = Path(__file__).parents[1] / "pusht" / "pusht_dpt_ema_fp16.ckpt"
PUSHT_WIDTH = 256
_TRAINED_STEPS = 100


@dataclass(frozen=True, eq=False)
class Network:
    """A denoiser and its loop.

    Attributes:
        name: for people.
        width: channels of the residual stream.
        module: takes the normalised observation.
        spec: of the policy.
    """

    name: str
    width: int
    module: nn.Module
    spec: PolicySpec

    @property
    def loop(self) -> str:
        """The sampler and its number of steps, for people."""
        return f"{self.spec.sampler.name.upper()} {self.spec.sampler.steps}"


def pusht_network(sampler: str, steps: int) -> Network:
    """The policy of ``examples/pusht``."""
    module, spec = load_checkpoint_policy(PUSHT, options=LoadOptions(sampler=sampler, steps=steps))
    return Network("Push-T", PUSHT_WIDTH, module, spec.in_loop(next(iter(spec.loops), ORIGINAL)))


def random_network(width: int, sampler: str, steps: int, layers: int = 8) -> Network:
    """A network of Push-T's family with random weights: its time is a trained one's, its actions mean nothing."""
    horizon, observed, channels, action = 16, 2, 20, 2
    config = TransformerConfig(
        input_dim=action,
        output_dim=action,
        horizon=horizon,
        n_obs_steps=observed,
        cond_dim=channels,
        n_layer=layers,
        n_head=max(width // 64, 1),
        n_emb=width,
        causal_attn=True,
    )
    torch.manual_seed(0)
    spec = PolicySpec(
        sample=(horizon, action),
        observations={"obs": ObservationSpec((observed, channels))},
        sampler=sampler_of(sampler, steps),
        chunk=ChunkSpec(action, observed - 1, observed + 7),
    )
    return Network("random weights", width, TokensDenoiser(TransformerForDiffusion(config)).eval(), spec)


def sampler_of(name: str, steps: int) -> SamplerTable:
    """Push-T's sampler with another number of steps; more than it was trained with, on as many betas."""
    settings = {
        "_target_": "diffusers.DDPMScheduler",
        "num_train_timesteps": max(steps, _TRAINED_STEPS),
        "beta_schedule": "squaredcos_cap_v2",
        "variance_type": "fixed_small",
        "clip_sample": True,
        "prediction_type": "epsilon",
    }
    return configured_sampler(settings, None, LoadOptions(sampler=name, steps=steps))


def plan_at(steps: int, blocks: int, sparsity: float) -> PlanArray | None:
    """A plan that reuses this share of the cells: whole steps, evenly spaced, and the first blocks of one more.

    Args:
        steps: K.
        blocks: number of blocks.
        sparsity: share of reused cells.

    Returns:
        int8 ``[K, blocks]`` of COMPUTE and TIMESTEP; None where step 0, which is always dense, is more than is left.
    """
    computed = round((1 - sparsity) * steps * blocks)
    if computed < blocks:
        return None
    plan = uniform_plan(steps, blocks, computed // blocks)
    rest = computed - np.count_nonzero(plan == Source.COMPUTE)
    if rest:
        reused = np.flatnonzero((plan != Source.COMPUTE).all(axis=1))
        plan[reused[len(reused) // 2], :rest] = Source.COMPUTE
    return plan


def plan_name(sparsity: float) -> str:
    """``reuse-95%``: the name of ``plan_at``'s plan in the artifact."""
    return f"reuse-{100 * sparsity:g}%"


def compile_with_plans(network: Network, directory: Path, sparsities: Sequence[float]) -> dict[float, PlanArray]:
    """Compile a network, and put a plan of each sparsity into its artifact, under its ``plan_name``.

    Returns:
        The plans, without those that there cannot be.
    """
    program = ttscompile.compile_denoiser(network.module, network.spec, directory)
    steps, blocks = network.spec.sampler.steps, len(program.blocks)
    plans = {sparsity: plan_at(steps, blocks, sparsity) for sparsity in sparsities}
    possible = {sparsity: plan for sparsity, plan in plans.items() if plan is not None}
    store_plans(directory, {plan_name(sparsity): plan for sparsity, plan in possible.items()})
    return possible


def store_plans(directory: Path, plans: Mapping[str, PlanArray]) -> None:
    """Give an artifact plans with these cells, in its default's loop and precision; the last of them is the default."""
    artifact = load_artifact(directory)
    made = {name: replace(artifact.default, cells=cells) for name, cells in plans.items()}
    update_plans(directory, {**artifact.plans, **made}, list(plans)[-1], {"learned": ["benchmark"]})
