"""Coverage that stands still for a while. As a plugin of pytest: while a slow test runs."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest


@contextmanager
def untraced() -> Iterator[None]:
    """What runs in the block is not measured for coverage, which makes Python several times as slow."""
    tracers = sys.gettrace(), threading.gettrace()
    sys.settrace(None)
    threading.settrace(None)
    try:
        yield
    finally:
        sys.settrace(tracers[0])
        threading.settrace(tracers[1])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Coverage is that of the quick tests: measuring all of them would cost a quarter more time.

    ``no_cover`` of pytest-cov says this, too, but does nothing in the processes of pytest-xdist.
    """
    with untraced() if item.get_closest_marker("slow") else nullcontext():
        return (yield)
