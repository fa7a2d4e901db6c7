"""Criteria that calibration and the product are tried with."""

from ttscompile.rivals.online import Criterion

RULES = [
    Criterion("teacache", 0, 0.5, (1.0, 0.0), accumulates=True, warmup=1, closes=True),
    Criterion("dbcache", 2, 0.5, (1.0, 0.0), accumulates=False, warmup=2, closes=False),
]
