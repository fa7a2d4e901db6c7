"""The denoising loops of a checkpoint: the one that it was trained to run in, and the one that was asked for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from ..core.spec import SamplerTable
from ..errors import CheckpointError, SpecError
from ..samplers.flow import METHODS
from .families import AS_SAVED, LoadOptions

Make = Callable[[LoadOptions], SamplerTable]
"""The loop that options ask for, or that the checkpoint describes where they ask for none."""


@dataclass(frozen=True)
class Loops:
    """What a ``PolicySpec`` has of its loops."""

    original: SamplerTable
    others: Mapping[str, SamplerTable] = field(default_factory=dict)
    source: Mapping[str, str] = field(default_factory=dict)


def loops_of(make: Make, options: LoadOptions, own: str) -> Loops:
    """The checkpoint's own loop, and beside it the one that the caller's options ask for, if that is another.

    Some checkpoints name a scheduler of which there is no table, of another class, say. What is asked for then is the
    original, and the source says in place of what. Of ``options.loops`` those follow that the policy can have.
    """
    if options.sampler is None and options.steps is None and options.spacing is None:
        original = make(AS_SAVED)
        return Loops(original, _further(make, options, original))
    asked = make(options)
    name = loop_name(asked, options.spacing)
    try:
        original = make(AS_SAVED)
    except (CheckpointError, SpecError):
        return Loops(asked, _further(make, options, asked), {"sampler": f"{name} in place of {own}"})
    own_loop = {} if asked.same_as(original) else {name: asked}
    return Loops(original, own_loop | _further(make, options, original))


def _further(make: Make, options: LoadOptions, original: SamplerTable) -> dict[str, SamplerTable]:
    """The loops beside the one that is asked for; those are left out that a policy of its kind cannot have."""
    found = dict[str, SamplerTable]()
    for sampler, steps in options.loops or ():
        try:
            table = make(replace(AS_SAVED, sampler=sampler, steps=steps))
        except SpecError:
            continue  # of flow matching for a policy that was trained with diffusion, say
        # One of more steps than the original can have nothing to recommend it.
        if table.steps <= original.steps and not table.same_as(original):
            found[loop_name(table)] = table
    return found


def loop_name(table: SamplerTable, spacing: str | None = None) -> str:
    """``dpmsolver++-16``, or ``ddim-16-trailing`` where a spacing is asked for: what ``PolicySpec.loops`` calls it.

    The number is that of steps, as people count them: one of ``rk4`` has four rows of the table.
    """
    method = METHODS.get(table.name)
    steps = table.steps // (1 if method is None else method.evaluations)
    return "-".join([table.name, str(steps), *([] if spacing is None else [spacing])])
