"""Rivals are tested on the artifacts that calibration is tested on."""

from tests.calibration.conftest import _short_search, compiled, linear_policy, make_task, recording

__all__ = ["_short_search", "compiled", "linear_policy", "make_task", "recording"]
