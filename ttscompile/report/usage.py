"""Which heads, branches and tables of an artifact its plans use, and what the calls of an episode execute."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..artifact.load import Artifact
from ..artifact.view import view_of
from ..core.lattice import BoolArray, PlanArray, Source
from ..core.spec import ORIGINAL
from ..ir.pieces import IDLE, PRUNER, of_loop, of_tokens
from ..ir.program import Binding
from ..runtimes.frames import FrameWork
from ..runtimes.liveness import sources_of_pruner
from ..runtimes.policy import CompiledPolicy
from ..runtimes.tokens import Seen
from ..trajectories.episodes import Episode
from . import facts
from .page import Table

HEAD, BRANCH, TABLE = "head", "branch", "table"
CONTEXTS = "what the loop reads at each step"


@dataclass(frozen=True)
class Use:
    """Something that an artifact holds for the sake of plans.

    Attributes:
        kind: ``head``, which makes plans; ``branch``, one way to go on of several; or ``table``, numbers.
        plans: names of the plans that use it, ``dense`` among them.
        of: the block whose branch it is, or the context whose values are in the table; None of what is alone.
    """

    kind: str
    name: str
    plans: tuple[str, ...]
    of: int | str | None = None


def uses(artifact: Artifact) -> tuple[Use, ...]:
    """Everything that only some plans use, and by which plans it is used.

    Of each block that is the branch that evaluates it, and one for each source of a residual. A plan that falls back to
    TIMESTEP in the first call of an episode uses both. What a pruner can choose follows from its weights.
    """
    manifest, found = artifact.manifest, list[Use]()
    sources = _sources(artifact)
    for loop in (ORIGINAL, *manifest.spec.loops):
        if (loop == ORIGINAL and PRUNER in manifest.pieces) or of_loop(PRUNER, loop) in manifest.pieces:
            deciding = (name for name, plan in manifest.plans.items() if plan.pruned and plan.loop == loop)
            found.append(
                Use(HEAD, "the pruner" if loop == ORIGINAL else f"the pruner of loop {loop!r}", tuple(deciding))
            )
    for source in Source:
        for b in range(len(manifest.blocks)):
            plans = tuple(name for name, cells in sources.items() if cells[:, b, source].any())
            found.append(Use(BRANCH, source.name, plans, b))
    if IDLE in manifest.pieces:
        idle = (name for name, cells in sources.items() if np.all(cells[..., 1:].any(axis=2), axis=1).any())
        found.append(Use(BRANCH, "steps without a computed block", tuple(idle)))
    reusing = tuple(name for name, plan in manifest.plans.items() if plan.tokens is not None)
    found += [
        Use(BRANCH, f"piece {name}, for some tokens", reusing) for name in sorted(manifest.pieces) if of_tokens(name)
    ]
    read = {name for piece in manifest.pieces.values() for name in piece.contexts}
    tables = (name for name, context in manifest.contexts.items() if context.binding is Binding.TABLE)
    found += [Use(TABLE, CONTEXTS, tuple(sources) if name in read else (), name) for name in tables]
    for name, plan in artifact.plans.items():
        if (own := plan.correction) is None:
            continue
        kinds = ["correction", *["jumps"] * bool(own.jumps), *["correction with a prefix"] * (own.late is not None)]
        found += [Use(TABLE, f"{kind} of {name}", (name,)) for kind in kinds]
    return tuple(found)


def usage_table(artifact: Artifact) -> Table:
    """Of every head, branch and table the plans that use it; blocks of one use are one row."""
    alike: dict[tuple[str, str, tuple[str, ...]], list[Use]] = {}
    for use in uses(artifact):
        alike.setdefault((use.kind, use.name, use.plans), []).append(use)
    rows = []
    spare = {(name,) for name in facts.spare(artifact.manifest)}
    for (kind, name, plans), group in alike.items():
        if kind == TABLE and plans in spare:  # its own
            continue
        blocks = [use.of for use in group if isinstance(use.of, int)]
        of = f" of blocks {facts.of_blocks(blocks)}" if blocks else f" ({len(group)})" if len(group) > 1 else ""
        rows.append((f"{kind}: {name}{of}", ", ".join(plans) or "no plan: unused"))
    return Table(("part", "used by"), tuple(rows), prose=True)


def told_unused(artifact: Artifact) -> str:
    """How much is unused, in words."""
    found = uses(artifact)
    count = sum(not use.plans for use in found)
    if not count:
        return f"Each of the {len(found)} heads, branches and tables is used by a plan."
    verb = "is" if count == 1 else "are"
    return f"{count} of {len(found)} heads, branches and tables {verb} used by no plan of the artifact."


def _sources(artifact: Artifact) -> Mapping[str, BoolArray]:
    """By plan, the sources that its cells can have when they are executed: bool ``[K, blocks, 4]``."""
    found: dict[str, BoolArray] = {}
    for name, plan in artifact.plans.items():
        if plan.cells is None:
            cells = sources_of_pruner(view_of(artifact, plan))
        else:
            cells = plan.cells[..., None] == np.arange(len(Source))
        cells[0] = np.arange(len(Source)) == Source.COMPUTE
        cells[..., Source.TIMESTEP] |= cells[..., Source.ROLLOUT]
        found[name] = cells
    return found


EPISODE_CALLS = 64
"""Of an episode at most: a picture of more says no more."""

SEEN_CALLS = 6
"""Of these, those of which a page shows what the cameras showed."""


@dataclass(frozen=True)
class Course:
    """One episode with one plan.

    Attributes:
        plans: int8 ``[R, K, blocks]``, as executed; without a first call in another loop.
        legalised: cells of each call that were replaced because they were never computed.
        frames: what was done for those of all calls, and for their tokens.
        seen: of some calls, by number, what each camera showed; nothing where no tokens are reused.
    """

    name: str
    plans: PlanArray
    legalised: tuple[int, ...]
    frames: FrameWork
    seen: Mapping[int, tuple[Seen, ...]]

    @property
    def sparsity(self) -> npt.NDArray[np.float64]:
        """Share of reused cells of each call, ``[R]``."""
        return np.asarray(np.mean(self.plans != Source.COMPUTE, axis=(1, 2)), dtype=np.float64)


def run_episode(policy: CompiledPolicy, episode: Episode, plan: str | None = None) -> Course:
    """A plan, or the policy's default, on the first ``EPISODE_CALLS`` calls of an episode; reset before and after."""
    policy.reset()
    made, seen, last = [], dict[int, tuple[Seen, ...]](), dict[int, int]()
    count = min(episode.calls, EPISODE_CALLS)
    for row in range(count):
        obs = {key: array[row : row + 1] for key, array in episode.observations.items()}
        policy.predict_action(obs, plan=plan)
        report = policy.last_report
        assert report is not None  # a call was made
        made.append(report)
        shown = policy.seen()
        if shown and row in np.linspace(0, count - 1, SEEN_CALLS).astype(int):
            # A camera that shows what it showed in the call before has no new frame, and nothing was computed for it.
            known = [last.get(i) == one.number for i, one in enumerate(shown)]
            seen[row] = tuple(
                replace(s, computed=s.computed & (not k), forward=s.forward & (not k))
                for s, k in zip(shown, known, strict=True)
            )
        last = {i: one.number for i, one in enumerate(shown)}
    policy.reset()
    frames = sum((report.frames for report in made), FrameWork())
    kept = [one for one in made if one.plan.shape == made[-1].plan.shape]  # the first may be in another loop
    name = episode.name + " (without its first call)" * (len(kept) < len(made))
    return Course(name, np.stack([r.plan[0] for r in kept]), tuple(r.legalised[0] for r in kept), frames, seen)
