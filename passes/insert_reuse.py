"""Give every block its reuse branch: which caches it writes and may read."""

from __future__ import annotations

from dataclasses import replace

from ttscompile.ir.program import Program, Reuse

from .base import Pass, PassResult


class InsertReuse(Pass):
    """Replace ``x <- x + f_b(x)`` by a branch on the plan.

    Before::

        x = x + f_b(x)

    After (runtimes lower the branch; docs/design.md section 2 defines it)::

        r = switch plan[k, b]:
              COMPUTE:  f_b(x), written to forward[g], timestep[b], rollout[k, b]
              FORWARD:  forward[g]          # g: blocks of this kind and shape
              TIMESTEP: timestep[b]
              ROLLOUT:  rollout[k, b]
        x = x + r
    """

    def requires(self, program: Program) -> None:
        """The program is cut into pieces."""
        if program.pieces is None:
            raise self.fail("the program is not cut into pieces; run partition first.")

    def call(self, program: Program) -> PassResult:
        """One ``Reuse`` a block."""
        members: dict[int, list[int]] = {}
        for block in program.blocks:
            members.setdefault(block.group, []).append(block.index)
        reuse = tuple(Reuse(b.type, b.group, tuple(members[b.group])) for b in program.blocks)
        if reuse == program.reuse:
            return PassResult(program, modified=False)
        notes = [f"{len(reuse)} branches in {len(members)} FORWARD groups"]
        notes += [
            f"block {indices[0]} is alone in its group: FORWARD is its own TIMESTEP"
            for indices in members.values()
            if len(indices) == 1
        ]
        return PassResult(replace(program, reuse=reuse), True, tuple(notes))
