"""Diffusion Policy and 3D Diffusion Policy: checkpoint to module and ``PolicySpec``.

Policies with DDPM and DDIM as real-stanford/diffusion_policy and YanjieZe/3D-Diffusion-Policy train and save them. A
policy is rebuilt from configuration and weights; neither these packages nor robomimic are needed. What is the same
for all of them is here; each kind of policy is a row of ``_POLICIES``.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from torch import nn

from ttscompile.core.spec import ChunkSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import plain_config, read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import loops_of
from ttscompile.frontends.refusals import refuse_file, refuse_payload, refuse_policy
from ttscompile.frontends.scheduler import configured_loops
from ttscompile.frontends.settings import Settings

from .interpolation import Config
from .parts import COMMON_KEYS, Rebuilt, Saved, affine, choose_weights
from .recorded import with_recorded

_STUDENT = "CTMPPUnetHybridImagePolicy"


def _row(module: str, which: str) -> Callable[[Saved], Rebuilt]:
    """A function of a module beside this one, which is imported when it is called."""
    return lambda saved: getattr(import_module(f".{module}", __package__), which)(saved)


_POLICIES: Mapping[str, Callable[[Saved], Rebuilt]] = {
    "DiffusionTransformerLowdimPolicy": _row("transformer", "low_dim"),
    "DiffusionTransformerHybridImagePolicy": _row("transformer", "on_images"),
    "DiffusionUnetLowdimPolicy": _row("unet", "low_dim"),
    "DiffusionUnetHybridImagePolicy": _row("unet", "hybrid"),
    "DiffusionUnetImagePolicy": _row("unet", "images"),
    "DP3": _row("dp3", "full"),
    "SimpleDP3": _row("dp3", "simple"),
    "DiffusionPointcloudPolicy": _row("idp3", "points"),
    "DiffusionImagePolicy": _row("idp3", "images"),
    "KarrasUnetHybridImagePolicy": _row("consistency_policy", "teacher"),
    _STUDENT: _row("consistency_policy", "student"),
    "TEDiUnetLowdimPolicy": _row("streaming", "low_dim"),
    "TEDIUnetHybridImagePolicy": _row("streaming", "on_images"),
    "DiffusionUnetTimmPolicy": _row("umi", "unet"),
    "DiffusionTransformerTimmPolicy": _row("umi", "transformer"),
}
"""By the class name of the original policy."""


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from a ``.ckpt``; see ``Family.load``.

    Source: ``predict_action`` of the policies of ``_POLICIES``.
    """
    refuse_file(path)
    payload = read_checkpoint(path)
    try:
        return build(payload, options)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error


def recordings(path: Path) -> str | None:
    """The data set of the training, where it lay then; see ``Family``."""
    refuse_file(path)
    config = _config(read_checkpoint(path))
    named = config.get("task.dataset.zarr_path") or config.get("task.dataset.dataset_path")
    if not named:
        return None
    if str(config.get("policy._target_")).endswith("TimmPolicy"):
        raise CheckpointError(
            f"{path}: it was trained on {named!s:.200}, whose poses are the robot's, and observes poses relative to the"
            " newest one. Record what the policy observes: an .npz with an array for each key, with --trajectories."
        )
    if Path(str(named)).exists():
        return str(named)
    raise CheckpointError(
        f"{path}: it was trained on {named!s:.200}, and there is no such file here. Run this in the folder where the"
        " training ran, or give recorded episodes of its robot, with --trajectories."
    )


def _config(payload: Mapping[str, Any]) -> Config:
    refuse_payload(payload)
    tree = plain_config(payload["cfg"])
    if not isinstance(tree, dict):
        raise CheckpointError(f"cfg is a {type(tree).__name__}; expected a dictionary.")
    return Config(tree)


def build(payload: Mapping[str, Any], options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Module and specification of what ``read_checkpoint`` gave; the rest as ``load``."""
    config = _config(payload)
    name = str(config.require("policy._target_")).rpartition(".")[2]
    if name not in _POLICIES:
        refuse_policy(name)
    # A student averages its weights beside them, whatever use_ema says, and evaluates those that it trains.
    use_ema = config.get("training.use_ema") if name != _STUDENT else False
    weights, which = choose_weights(payload["state_dicts"], use_ema)
    policy = config.require("policy")
    if not isinstance(policy.get("noise_scheduler"), dict):
        raise CheckpointError("cfg.policy.noise_scheduler is missing; expected the settings of a scheduler.")
    saved = Saved(config, Settings(policy, "cfg.policy."), weights)
    rebuilt = _POLICIES[name](saved)
    # The original slices action_pred[:, start : start + Ta], which ends with the horizon.
    executed = rebuilt.executed or saved.settings.number("n_action_steps")
    stop = min(rebuilt.start + executed, rebuilt.sample[0])
    step_arguments = {key: policy[key] for key in policy if key not in COMMON_KEYS | rebuilt.known}
    scheduler, steps = policy["noise_scheduler"], policy.get("num_inference_steps")
    if rebuilt.make is None:
        loops = configured_loops(scheduler, steps, options, step_arguments=step_arguments)
    else:
        loops = loops_of(rebuilt.make, options, str(scheduler.get("solver")))
    source = {"format": "diffusion_policy", "policy": name, "variant": rebuilt.variant, "weights": which}
    spec = PolicySpec(
        sample=rebuilt.sample,
        observations=with_recorded(rebuilt.observations, config),
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(
            action_dim=rebuilt.action_dim,
            start=rebuilt.start,
            stop=stop,
            normalizer=affine(weights, "action", rebuilt.action_dim),
        ),
        source={**source, **loops.source},
        trained_prefix=rebuilt.prefix,
    )
    return rebuilt.module.eval(), spec
