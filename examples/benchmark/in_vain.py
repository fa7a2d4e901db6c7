"""What reuse costs a call where nothing can be reused: every picture is new noise.

    python examples/benchmark/in_vain.py DIR [--computed 3] [--calls 200]

Of a compiled policy with cameras, calls of one robot and one thread take turns on the same observations:

- ``nothing kept``: every frame and scene is computed, and nobody looks whether it is known;
- ``frames and scenes``: as the product calls it;
- ``tokens, too``: tokens of image encoders are reused, and all patches of all pictures differ.

Each call is compared with that of ``nothing kept`` on the same observation, and the median of these ratios is printed
with its interval of 95 %, of 2,000 bootstraps. Milliseconds are the processor's, medians: the machine may be busy.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from moving import REUSE

from ttscompile import Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.core.coercion import Array
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import DENSE
from ttscompile.errors import TtscompileError
from ttscompile.ir.pieces import SCENE
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

WARM_UP = 5
"""Calls that do not count."""

PLAIN, KNOWN, TOKENS = "nothing kept", "frames and scenes", "tokens, too"


class Unkept(FramePieces):
    """Frames and scenes that are computed in every call."""

    def values(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        """See ``FramePieces``."""
        rows, found = self._rows_of(obs), dict[str, Array]()
        for name, piece in self._pieces.items():
            own = {key: rows[key] for key in piece.inputs}
            found |= self._each(name, own, len(next(iter(own.values()))))
        if self._scene is not None:
            whole = {key: np.ascontiguousarray({**obs, **found}[key]) for key in self._scene.inputs}
            found |= self._each(SCENE, whole, len(next(iter(obs.values()))))
        return found

    def _each(self, name: str, inputs: Mapping[str, Array], count: int) -> dict[str, Array]:
        piece = self._scene if name == SCENE else self._pieces[name]
        assert piece is not None
        parts = [{key: np.split(one, count)[i] for key, one in inputs.items()} for i in range(count)]
        made = [self._run(name, part) for part in parts]
        joined = (one[0] if len(one) == 1 else np.concatenate(one) for one in zip(*made, strict=True))
        return dict(zip(piece.outputs, joined, strict=True))


def measured(directory: Path, computed: int, calls: int) -> dict[str, npt.NDArray[np.float64]]:
    """Milliseconds of calls, by way.

    Raises:
        TtscompileError: the policy has no encoder whose tokens could be reused.
    """
    artifact, rng = load_artifact(directory), np.random.default_rng(0)
    spec, steps, blocks = artifact.manifest.spec, artifact.manifest.steps, len(artifact.manifest.blocks)
    if not artifact.manifest.tokens:
        raise TtscompileError(f"{directory}: none of its image encoders has tokens that could be reused.")
    whole = replace(artifact.plans[DENSE], cells=uniform_plan(steps, blocks, min(computed, steps)))
    plans = {PLAIN: whole, KNOWN: whole, TOKENS: replace(whole, tokens=REUSE)}
    opened = {way: open_policy(artifact, seed=0, plan=plan) for way, plan in plans.items()}
    forget(opened[PLAIN])
    noise = Noise(rng.standard_normal((1, *spec.sample), dtype=np.float32))
    took: dict[str, list[float]] = {way: [] for way in plans}
    said = {key: one.draw(rng) for key, one in spec.observations.items() if not one.image}
    for number in range(calls + WARM_UP):
        obs = said | {key: one.draw(rng) for key, one in spec.observations.items() if one.image}
        ways = deque(opened.items())
        ways.rotate(number)
        for way, policy in ways:
            start = time.process_time()
            policy.predict_action(obs, noise=noise)
            took[way].append(1000 * (time.process_time() - start))
    report = opened[TOKENS].last_report
    assert report is not None and report.frames.tokens == report.frames.of
    return {way: np.array(own[WARM_UP:]) for way, own in took.items()}


def forget(policy: CompiledPolicy) -> None:
    """Have every call of a policy compute all of its frames and its scene, without looking for them."""
    backend: Any = policy._runtime.backend
    backend.frames = Unkept(backend._manifest.pieces, backend._run)


@click.command(context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--computed", default=3, type=click.IntRange(1), help="Steps of the loop.")
@click.option("--calls", default=200, type=click.IntRange(2), help="Of each way.")
def main(directory: Path, computed: int, calls: int) -> None:
    """Time calls of the policy in DIRECTORY."""
    took = measured(directory, computed, calls)
    rng = np.random.default_rng(0)
    for way, own in took.items():
        ratios = own / took[PLAIN]
        drawn = np.median(ratios[rng.integers(len(ratios), size=(2000, len(ratios)))], axis=1)
        low, high = np.quantile(drawn, [0.025, 0.975])
        print(f"{np.median(own):8.3f} ms; {np.median(ratios):.3f} [{low:.3f}, {high:.3f}]: {way}")


if __name__ == "__main__":
    main()
