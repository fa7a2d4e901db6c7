"""A whole policy one of whose cameras moves with the gripper: how many tokens a call computes, and what it then takes.

    python examples/benchmark/large.py --smolvla --output DIR
    MUJOCO_GL=osmesa python examples/benchmark/in_motion.py DIR

The pictures are rendered: of the arm over three blocks that the small SmolVLA of ``examples/policies/vla`` was trained
with, one camera stands in front of it and the other hangs on its gripper. Scripted experts drive it, and a call comes
after as many steps as that policy executes. The table is white, so much of what the gripper's camera sees stays as it
was; with ``--patterned`` all of it is new in every call. A call with all tokens and one with those that changed take
turns, of two computed steps. Seconds are the processor's, and all calls have one thread.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
from beside import COMPUTED
from large_calls import lowered, plans_of
from large_smolvla import call
from moving import backgrounds

from ttscompile import Noise, Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import TokenReuse
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.tokens import TokenWork

Array = npt.NDArray[np.float32]

WHOLE, OTHER = "all tokens", "all tokens, other noise"

STEPS = 8
"""Of the world between two calls: actions that the trained policy executes of a chunk."""


@dataclass
class Calls:
    """Of one way to call.

    Attributes:
        seconds: of each call.
        shares: of the tokens of its new frames that were computed, by camera.
        off: by how much its actions differ from those with all tokens, on average.
    """

    seconds: list[float] = field(default_factory=list)
    shares: list[list[float]] = field(default_factory=list)
    off: list[float] = field(default_factory=list)


def views(sizes: Sequence[tuple[int, int]]) -> Iterator[tuple[bool, list[Array]]]:
    """Of each call whether it is the first of an episode, and what both cameras see, ``[3, H, W]`` in 0..1.

    Args:
        sizes: height and width of the pictures of each camera.
    """
    sys.path.insert(1, str(Path(__file__).parents[1] / "evaluation"))
    sys.path.insert(2, str(Path(__file__).parents[1] / "policies" / "vla"))
    from environments.fetch_blocks import FetchBlocks
    from experts import act

    world, side = FetchBlocks(), max(map(max, sizes))
    for seed in count():
        world.reset(seed)
        first = True
        while not world.done:
            seen = [world.view(camera, side) for camera in ("front", "wrist")]
            yield first, [_middle(one, *size) for one, size in zip(seen, sizes, strict=True)]
            first = False
            for _ in range(STEPS):
                if not world.done:
                    world.step(act(world, world.task))


def _middle(square: npt.NDArray[np.uint8], height: int, width: int) -> Array:
    """What is in the middle of a picture, in 0..1."""
    top, left = (len(square) - height) // 2, (len(square) - width) // 2
    cut = np.moveaxis(square[top : top + height, left : left + width], -1, 0)
    return np.divide(cut, 255, dtype=np.float32)


def measured(
    folder: Path, thresholds: Sequence[float], calls: int, patterned: bool, scenes: Sequence[float] = ()
) -> dict[str, Calls]:
    """Calls of each way by its name, but for the first of each episode, which computes all.

    Args:
        folder: with the artifact.
        thresholds: of ``TokenReuse``.
        calls: of each way.
        patterned: whether the second camera sees another picture in every call.
        scenes: of ``TokenReuse``, each with every threshold; beside these the scene is computed whole.
    """
    artifact = load_artifact(folder / "compiled")
    bits, (obs, noise) = lowered(artifact), call(artifact.manifest.spec)
    cameras = [key for key, one in artifact.manifest.spec.observations.items() if one.image]
    settings: dict[str, TokenReuse | None] = {WHOLE: None}
    for least in thresholds:
        settings[f"threshold {least:g}"] = TokenReuse(least, 10**6)
        settings |= {f"threshold {least:g}, scene {share:g}": TokenReuse(least, 10**6, share) for share in scenes}
    plans = {name: list(plans_of(artifact, bits, COMPUTED, one).values())[-1] for name, one in settings.items()}
    policy = open_policy(artifact, seed=0)  # one for all: what they have in common is in memory once
    rng = np.random.default_rng(1)
    other = Noise(rng.standard_normal(noise.initial.shape, dtype=np.float32))
    found = {name: Calls() for name in [*plans, OTHER]}
    for first, shown in views([obs[key].shape[-2:] for key in cameras]):
        seen = dict(zip(cameras, shown, strict=True))
        if patterned:
            seen |= backgrounds({cameras[1]: obs[cameras[1]]}, rng)
        for key, one in seen.items():
            obs[key] = np.stack([one] * obs[key].shape[1])[None]
        if first:
            policy.reset()
        made, works = dict[str, tuple[Array, float]](), dict[str, tuple[TokenWork, ...]]()
        for name, plan in plans.items():
            made[name] = _timed(policy, obs, noise, plan)
            works[name] = () if policy.last_report is None else policy.last_report.frames.by_camera
        if first:
            continue
        made[OTHER] = _timed(policy, obs, other, plans[WHOLE])
        for name, (actions, seconds) in made.items():
            found[name].off.append(float(np.abs(actions - made[WHOLE][0]).mean()))
            found[name].seconds.append(seconds)
            if name in settings:
                found[name].shares.append([one.computed / one.of for one in works[name]])
        if len(found[WHOLE].seconds) == calls:
            break
    return found


def _timed(policy: CompiledPolicy, obs: Mapping[str, Array], noise: Noise, plan: Plan) -> tuple[Array, float]:
    """The actions, and seconds."""
    start = time.process_time()
    made = policy.predict_action(obs, noise=noise, plan=plan)["action"]
    return np.asarray(made), time.process_time() - start


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--thresholds", default="0.02,0.05,0.1,0.2", help="Of token reuse.")
@click.option("--scenes", default="", help="Shares of a scene's rows, for the same.")
@click.option("--calls", default=16, type=click.IntRange(1), help="Of each way.")
@click.option("--patterned", is_flag=True, help="All that the gripper's camera sees is new in every call.")
def main(folder: Path, thresholds: str, scenes: str, calls: int, patterned: bool) -> None:
    """Time calls of the policy in FOLDER."""
    shares = [float(one) for one in scenes.split(",") if one]
    found = measured(folder, [float(one) for one in thresholds.split(",")], calls, patterned, shares)
    whole = statistics.median(found[WHOLE].seconds)
    for name, one in found.items():
        seconds = statistics.median(one.seconds)
        parts = ", ".join(f"{statistics.mean(own):.0%}" for own in zip(*one.shares, strict=True))
        computed = f"; computed, by camera, and of the scene: {parts}" if parts else ""
        off = f"{statistics.mean(one.off):8.3f}  actions off those with all tokens"
        print(f"{off}; {seconds:.2f} s, {seconds / whole:.2f} of theirs{computed}: {name}")


if __name__ == "__main__":
    main()
