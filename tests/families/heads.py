"""Action heads of vision-language-action models, rebuilt, and what their originals made; see ``golden/README.md``."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import diffusers
from torch import nn

from tests.families.checks import Arrays, golden
from tests.families.groot import GR00THead
from tests.families.pi import PiHead
from tests.families.smolvla import SmolVLAHead
from tests.families.weights import draw_weights
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.policies.cogact import CogACTHead
from ttscompile.policies.dit_policy import DiTPolicyHead
from ttscompile.policies.last_step import marked
from ttscompile.policies.rdt import RDTConfig, RDTHead
from ttscompile.policies.scaledp import ScaleDPConfig, ScaleDPHead
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table


@dataclass(frozen=True)
class Family:
    """A head, what its original made, and what has to be found in it.

    Attributes:
        title: in the support table.
        verified: against what.
        module: with random weights still.
        conditions: observations of the golden file, in the order of the module's arguments.
        sampler: as the original runs it.
        prediction: name of the network's output in the golden file.
        blocks: of each kind.
        loop: largest share of the FLOPs that may stay in the loop.
        others: names and shapes of the original's parameters that the head does not have.
        scale: by which the golden file's timesteps are larger than the head's.
        whole: what is compiled of the module, where that is more than it.
    """

    title: str
    verified: str
    module: nn.Module
    conditions: tuple[str, ...]
    sampler: SamplerTable
    prediction: str = "prediction"
    blocks: dict[str, int] = field(default_factory=lambda: {"self_attention": 2, "feed_forward": 2})
    loop: float = 0.9
    others: dict[str, tuple[int, ...]] = field(default_factory=dict)
    scale: float = 1.0
    whole: Callable[[Any], nn.Module] = lambda module: module


UP_TO = "up to the rounding of float32"
LEROBOT = f"lerobot 7427f31 `denoise_step`, `euler_integrate`, {UP_TO}"


def ddim(steps: int, **settings: Any) -> SamplerTable:
    solver = diffusers.DDIMScheduler(100, beta_schedule="squaredcos_cap_v2", **settings)
    return sampler_table(solver, steps, name="ddim")


def smolvla() -> Family:
    return Family(
        title="SmolVLA action expert",
        verified=LEROBOT,
        module=SmolVLAHead(width=24, heads=4, groups=2, channels=8, hidden=40, layers=4, actions=5),
        conditions=("prefix_mask", "keys", "values"),
        sampler=flow_matching_table(10, start=1.0, end=0.0),
        prediction="velocity",
        blocks={"self_attention": 2, "feed_forward": 4, "cross_attention": 2},
        loop=0.96,
        others={"state_proj.weight": (32, 6), "state_proj.bias": (32,)},
    )


def rdt() -> Family:
    solver = diffusers.DPMSolverMultistepScheduler(beta_schedule="squaredcos_cap_v2", prediction_type="sample")
    return Family(
        title="RDT-1B, read from its directory",
        verified=f"RoboticsDiffusionTransformer deb71d8 `predict_action`, {UP_TO}",
        module=RDTHead(RDTConfig(32, heads=4, layers=4, horizon=6, actions=5, lengths=(9, 8), features=(12, 10))),
        conditions=("lang_tokens", "lang_attn_mask", "img_tokens", "state_tokens", "action_mask", "ctrl_freqs"),
        sampler=marked(sampler_table(solver, 5, name="dpmsolver++")),
        blocks={"self_attention": 4, "cross_attention": 4, "feed_forward": 4},
        loop=0.93,
        whole=RDTHead.compiled,
    )


def _pi(title: str, adaptive: bool, conditions: tuple[str, ...], loop: float) -> Family:
    return Family(
        title=f"{title} action expert",
        verified=LEROBOT,
        module=PiHead(width=24, heads=4, groups=1, channels=8, hidden=40, layers=2, actions=5, adaptive=adaptive),
        conditions=("prefix_mask", "keys", "values", *conditions),
        sampler=flow_matching_table(10, start=1.0, end=0.0),
        prediction="velocity",
        loop=loop,
    )


def groot() -> Family:
    return Family(
        title="GR00T N1.7 action head",
        verified=f"lerobot 7427f31 `get_action_with_features`, {UP_TO}",
        module=GR00THead(24, heads=3, layers=4, source=20, out=16, actions=5, embodiments=2, embodiment=1),
        conditions=("features", "state"),
        sampler=flow_matching_table(4),
        prediction="velocity",
        blocks={"cross_attention": 2, "feed_forward": 4, "self_attention": 2},
        scale=1000.0,
    )


def cogact() -> Family:
    return Family(
        title="CogACT action model, read from its file, guidance 1.5",
        verified=f"CogACT b174a1b `predict_action_batch`, `forward_with_cfg`, {UP_TO}",
        module=CogACTHead(24, heads=3, layers=2, horizon=6, actions=5, cognition=18, guidance=1.5),
        conditions=("cognition",),
        sampler=ddim(10, clip_sample=False),
        loop=0.99,
        others={"history_embedder.linear.weight": (24, 5), "history_embedder.linear.bias": (24,)},
    )


def dit_policy() -> Family:
    return Family(
        title="DiT-Policy, read from its file",
        verified=f"dit-policy ba22ee3 `get_actions`, {UP_TO}",
        module=DiTPolicyHead(24, heads=3, layers=2, hidden=40, waves=16, horizon=6, actions=5),
        conditions=("tokens",),
        sampler=ddim(8),
        loop=0.5,
    )


def scaledp() -> Family:
    return Family(
        title="ScaleDP (DexVLA), its head without its Qwen2-VL, read from its directory",
        verified=f"DexVLA fc21a82 `model_forward`, `forward`, {UP_TO}",
        module=ScaleDPHead(ScaleDPConfig(24, heads=3, layers=2, horizon=6, actions=5, features=18, state=4, hidden=20)),
        conditions=("features", "state"),
        sampler=ddim(10),
    )


FAMILIES = {
    "smolvla": smolvla,
    "rdt": rdt,
    "pi0": lambda: _pi("pi0", False, ("state",), 0.9995),
    "pi05": lambda: _pi("pi0.5", True, (), 0.9),
    "groot": groot,
    "cogact": cogact,
    "dit_policy": dit_policy,
    "scaledp": scaledp,
}


def loaded(family: Family, name: str) -> tuple[nn.Module, Arrays, PolicySpec]:
    """The head with the original's weights, what the original made, and the specification."""
    arrays = golden(name)
    own = {key: tuple(value.shape) for key, value in family.module.state_dict().items()}
    drawn = draw_weights(own | family.others, int(arrays["seed"]))
    family.module.load_state_dict({key: drawn[key] for key in own})
    observations = {
        key: ObservationSpec(arrays[key].shape[1:], dtype=str(arrays[key].dtype)) for key in family.conditions
    }
    horizon, channels = arrays["noise"].shape[1:]
    chunk = ChunkSpec(channels, horizon - arrays["actions"].shape[1], horizon)
    spec = PolicySpec((horizon, channels), observations, family.sampler, chunk)
    return family.whole(family.module).eval(), arrays, spec
