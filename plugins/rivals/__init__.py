"""What calibration is compared with: proposers of schedules that others have published, each a row of ``RIVALS``.

A module has a search, and a row names it. ``static`` has those that follow a rule; ``fixed`` what all of one interval
share; ``online`` what those share that decide during a call, and ``deciding`` lets them decide there; ``slopes`` has
the gradients that ``gates`` follows. This module alone imports no torch, so that the command line can list them.
Nothing that calibrates by default imports the others.
"""

from __future__ import annotations

from ttscompile.calibration.proposer import ScheduleRow

RIVALS = (
    ScheduleRow(
        "tts-paper",
        "test-time sparsity, arXiv 2605.13316, with a smaller head: gates trained for each observation",
        "rivals.paper:Paper",
        consecutive=True,
        uses_pruner=True,
    ),
    ScheduleRow(
        "interval", "FORA, arXiv 2407.01425; EfficientVLA (arXiv 2506.10100)", "rivals.static:interval", baseline=True
    ),
    ScheduleRow("bac", "block-wise adaptive caching (arXiv 2506.13456)", "rivals.bac:bac"),
    ScheduleRow(
        "delta-dit",
        "Delta-DiT (arXiv 2406.01125)",
        "rivals.static:delta_dit",
        least=lambda steps, blocks: blocks + steps - 1,  # one block of every step after step 0
    ),
    ScheduleRow(
        "deepcache",
        "DeepCache (arXiv 2312.00858)",
        "rivals.static:deepcache",
        least=lambda steps, blocks: blocks + (steps - 1) * min(2, blocks),  # the first and the last block of every step
    ),
    ScheduleRow("sag", "Sparse ActionGen (arXiv 2601.12894)", "rivals.sag:sag", uses_pruner=True),
    ScheduleRow("dip-go", "DiP-GO (arXiv 2410.16942)", "rivals.gates:dip_go"),
    ScheduleRow(
        "l2c",
        "Learning-to-Cache (arXiv 2406.01733)",
        "rivals.gates:l2c",
        least=lambda steps, blocks: blocks * -(-steps // 2),  # every other step
    ),
    ScheduleRow("evo", "genetic search (arXiv 2607.20293)", "rivals.evo:Evo"),
    ScheduleRow(
        "teacache",
        "TeaCache (arXiv 2411.19108)",
        "rivals.online:teacache",
        least=lambda steps, blocks: blocks * min(2, steps),  # the first step and the last
    ),
    ScheduleRow(
        "dbcache",
        "DBCache of cache-dit",
        "rivals.online:dbcache",
        least=lambda steps, blocks: blocks + steps - 1,  # the first block of every step after step 0
    ),
    ScheduleRow("taylorseer", "TaylorSeer (arXiv 2503.06923), of the network's output", "rivals.taylorseer:TaylorSeer"),
)
"""In the order in which they are listed; ``calibrate --learn`` takes their names."""
