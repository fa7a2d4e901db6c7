"""TTS as its paper trains it (arXiv 2605.13316): the training of the proposer ``pruner``, here for a schedule, too."""

from ttscompile.calibration.pruner.paper import Paper

__all__ = ["Paper"]
