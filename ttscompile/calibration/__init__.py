"""Calibration: an artifact learns from a few recorded episodes which residuals it can reuse."""

from __future__ import annotations

from .pipeline import calibrate
from .result import CalibrationResult, PlanScore

__all__ = ["CalibrationResult", "PlanScore", "calibrate"]
