"""Trials of an artifact that holds in memory what a proposal brings."""

from __future__ import annotations

from dataclasses import replace

from ..artifact.manifest import WeightsRecord
from .proposer import Proposal
from .trials import Trials


def holding(trials: Trials, proposal: Proposal) -> Trials:
    """The same, of an artifact that holds in memory what a proposal brings."""
    artifact, manifest, loop = trials.artifact, trials.artifact.manifest, proposal.plan.loop
    added = {name: own.weights for name, own in proposal.weights.items()}
    known = {**manifest.weights, **{name: WeightsRecord(name, {}, None, {}) for name in added}}
    pruner, pruners = artifact.pruner, dict(artifact.loop_pruners)
    if proposal.pruner is not None and loop in pruners:
        pruners[loop] = proposal.pruner
    elif proposal.pruner is not None:
        pruner = proposal.pruner
    held = replace(
        artifact,
        manifest=replace(manifest, starts={**manifest.starts, **proposal.starts}, weights=known),
        block_weights={**artifact.block_weights, **added},
        pruner=pruner,
        loop_pruners=pruners,
    )
    return replace(trials, artifact=held, fresh=trials.fresh or bool(added) or proposal.pruner is not None)
