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


_measured = set[str]()
"""Tests of which a case was measured."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Coverage is that of the first case of each quick test: measuring all of them would cost a quarter more time.

    ``no_cover`` of pytest-cov says this, too, but does nothing in the processes of pytest-xdist.
    """
    test = item.nodeid.partition("[")[0]
    left_out = item.get_closest_marker("slow") is not None or test in _measured
    _measured.add(test)
    with untraced() if left_out else nullcontext():
        return (yield)
