"""The pruner, trained to make a plan for each observation, as arXiv 2605.13316 does: ``paper``."""
