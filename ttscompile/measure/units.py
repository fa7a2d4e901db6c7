"""How figures are written for people."""

import math
from collections.abc import Mapping


def flops(count: float) -> str:
    """FLOPs with a unit: ``16.1 GFLOP``."""
    for unit, size in (("GFLOP", 1e9), ("MFLOP", 1e6), ("kFLOP", 1e3)):
        if count >= size:
            return f"{number(count / size)} {unit}"
    return f"{count:.0f} FLOP"


def share(part: float | None) -> str:
    """A share in per cent, small ones to two digits more; empty if it is not known."""
    if part is None:
        return ""
    return f"{part:.1%}" if part == 0 or part >= 0.01 else f"{part:.3%}"


def number(value: float, digits: int = 3) -> str:
    """A positive number to so many digits at least, without an exponent."""
    return f"{value:.{digits}g}" if value < 10**digits - 0.5 else f"{value:.0f}"


ms = number
"""Of milliseconds, whose unit stands at the head of their column."""


def rounded_up(value: float) -> str:
    """To hundredths, never below it."""
    return f"{math.ceil(100 * value - 1e-9) / 100:g}"


def plain(value: object) -> str:
    """A value of a record without the marks of a program: ``calibration 0, 1; validation 2``."""
    if isinstance(value, Mapping):
        return "; ".join(f"{str(name).replace('_', ' ')} {plain(one)}" for name, one in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(plain, value)) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
