"""The rest of a denoising loop, for calls that begin with the chunk of the call before: a warm start.

Falcon (arXiv 2503.00339) begins a call with earlier actions and as much noise as a step in the middle of the loop has.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import SpecError
from .coercion import integer
from .spec import ChunkSpec, FloatArray, Noise, SamplerTable

TOLERANCE = 1e-3
"""Of what the shares of action and noise are known by: the table is in float32."""


@dataclass(frozen=True)
class Start:
    """What the rest of a longer loop begins with: shares of the action, normalised, and of noise.

    ``skipped`` steps of the longer loop come before it.
    """

    skipped: int
    action: float
    noise: float

    def noise_from(
        self,
        before: FloatArray,
        chunk: ChunkSpec,
        fresh: Noise,
        executed: int | None = None,
        change: tuple[FloatArray, FloatArray] | None = None,
    ) -> Noise:
        """The noise of the rest, whose initial sample goes on with a chunk.

        Args:
            before: the denoised sample of the call before, float32 ``[B, T, D]``.
            executed: how many steps of it were executed; None for all that are to be.
            change: see ``ChunkSpec.moved``.
        """
        executed = chunk.executes if executed is None else executed
        moved = chunk.moved(before, executed, change)
        initial = np.float32(self.action) * moved + np.float32(self.noise) * fresh.initial
        return Noise(initial, None if fresh.steps is None else fresh.steps[self.skipped :])


def rest_of(table: SamplerTable, last_steps: int) -> tuple[SamplerTable, Start]:
    """The last steps of a loop, and what they begin with.

    A multistep solver has no earlier predictions there: its first step takes its own in their place.

    Returns:
        Their table, and how the sample before them is made of action and noise.

    Raises:
        SpecError: there are no fewer steps; or the table does not tell these shares: Runge-Kutta, an EDM, or a network
            that predicts the action itself.
    """
    last_steps = integer(last_steps, "last_steps", SpecError, 1)
    if last_steps >= table.steps:
        raise SpecError(f"last_steps is {last_steps}; expected fewer than the {table.steps} steps of the loop.")
    skipped = table.steps - last_steps
    action, noise = _shares(table, skipped)
    columns = {name: getattr(table, name)[skipped:].copy() for name in ("timesteps", *SamplerTable.COLUMNS)}
    from_memory, to_memory = table.memory_to_next[skipped:].copy(), table.to_memory[skipped:].copy()
    own = to_memory[0, :1, :3].sum(0)  # its own, of x0, sample and prediction, if there is a memory
    for name, share in zip(SamplerTable.COLUMNS[2:5], from_memory[0].sum() * own, strict=True):
        columns[name][0] += share
    to_memory[0, :, :3] += to_memory[0, :, 3:].sum(-1, keepdims=True) * own
    from_memory[0], to_memory[0, :, 3:] = 0, 0
    rest = replace(table, **columns, memory_to_next=from_memory, to_memory=to_memory)
    return rest, Start(skipped, action, noise)


def _shares(table: SamplerTable, step: int) -> tuple[float, float]:
    """Of action and of noise in the sample before a step."""
    sample, out, most = map(float, (table.sample_to_x0[step], table.out_to_x0[step], table.out_to_x0.max()))
    if sample == 1 and table.name == "euler" and abs(abs(table.out_to_x0[0]) - 1) < TOLERANCE:
        return 1 - abs(out), abs(out)  # x0 = x + left v; x = (1 - left) x0 + left noise
    # What the output means is added to the sample; DPM-Solver without ++ takes it off, for it means the noise.
    if table.name in ("ddpm", "ddim", "dpmsolver++") and table.x0_to_next[step] >= 0 and 0 < sample != 1 and most < 0:
        if abs(1 + out**2 - sample**2) < TOLERANCE * sample**2:  # the network predicts the noise: x0 = (x - s out) / a
            return 1 / sample, -out / sample
        if abs(sample**2 + out**2 - 1) < TOLERANCE:  # it predicts the velocity: x0 = a x - s out
            return sample, -out
    raise SpecError(
        f"a loop of {table.name!r} does not tell what part of its sample is noise in the middle; expected ddpm, ddim,"
        " dpmsolver++ or euler, and a network that predicts noise or velocity. It begins with noise."
    )
