"""What calibration is compared with: strategies that others have published, each a row of ``RIVALS``.

``static`` has strategies that follow a rule; ``fixed`` what all of one interval share; ``online`` what those share that
decide during a call, and ``deciding`` lets them decide there; ``slopes`` has the gradients that ``gates`` follows. This
module alone imports no torch, so that the command line can list them. Nothing that calibrates by default imports the
others.
"""

from __future__ import annotations

from ttscompile.calibration.strategy import Strategy

RIVALS = (
    Strategy(
        "interval", "FORA, arXiv 2407.01425; EfficientVLA (arXiv 2506.10100)", "rivals.static:interval", baseline=True
    ),
    Strategy("bac", "block-wise adaptive caching (arXiv 2506.13456)", "rivals.bac:bac"),
    Strategy(
        "delta-dit",
        "Delta-DiT (arXiv 2406.01125)",
        "rivals.static:delta_dit",
        least=lambda steps, blocks: blocks + steps - 1,  # one block of every step after step 0
    ),
    Strategy(
        "deepcache",
        "DeepCache (arXiv 2312.00858)",
        "rivals.static:deepcache",
        least=lambda steps, blocks: blocks + (steps - 1) * min(2, blocks),  # the first and the last block of every step
    ),
    Strategy("sag", "Sparse ActionGen (arXiv 2601.12894)", "rivals.sag:sag", uses_pruner=True),
    Strategy("dip-go", "DiP-GO (arXiv 2410.16942)", "rivals.gates:dip_go"),
    Strategy(
        "l2c",
        "Learning-to-Cache (arXiv 2406.01733)",
        "rivals.gates:l2c",
        least=lambda steps, blocks: blocks * -(-steps // 2),  # every other step
    ),
    Strategy("evo", "genetic search (arXiv 2607.20293)", "rivals.evo:Evo"),
    Strategy(
        "teacache",
        "TeaCache (arXiv 2411.19108)",
        "rivals.online:teacache",
        least=lambda steps, blocks: blocks * min(2, steps),  # the first step and the last
    ),
    Strategy(
        "dbcache",
        "DBCache of cache-dit",
        "rivals.online:dbcache",
        least=lambda steps, blocks: blocks + steps - 1,  # the first block of every step after step 0
    ),
    Strategy("taylorseer", "TaylorSeer (arXiv 2503.06923), of the network's output", "rivals.taylorseer:TaylorSeer"),
)
"""Names and modules; ``calibrate --strategy`` takes the names."""
