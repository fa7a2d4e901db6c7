"""This package's version, and versions to compare; the standard library alone, for the doctor."""

import re

VERSION = "0.1.0"
"""Of ttscompile."""


def release(text: str) -> tuple[int, ...]:
    """``2.13.0.dev3+cpu`` as (2, 13); trailing zeros do not count."""
    match = re.match(r"\d+(?:\.\d+)*", text)
    numbers = [int(n) for n in match[0].split(".")] if match else [0]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)
