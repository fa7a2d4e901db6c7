"""Calibration: an artifact learns from a few recorded episodes which residuals it can reuse.

The main path is ``pipeline``: calls and their ``targets``, then the ``tts`` strategy, which places ``whole_steps`` and
gives them a ``correction``, then the ``judge``. The other strategies are in ``published``; ``strategies`` lists all of
them. ``pruner`` learns where a plan may depend on the observation. This package and ``strategies`` import no torch.
"""
