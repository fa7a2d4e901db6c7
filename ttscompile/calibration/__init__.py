"""Calibration: an artifact learns from a few recorded episodes which residuals it can reuse.

The main path is ``pipeline``: ``trials`` of what the original answers; then each ``proposer`` proposes plans, and the
``judge`` judges them. Who proposes is told by the table of ``proposers``. What was asked for and cannot be is a
``CalibrationError`` of any function of this room. This package, ``proposer`` and ``proposers`` itself import no torch.
"""
