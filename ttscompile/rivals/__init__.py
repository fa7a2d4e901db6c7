"""Strategies that others have published, and what several of them share.

``static`` has those that follow a rule; ``fixed`` what all of one interval share; ``online`` what those share that
decide during a call; ``slopes`` has the gradients that ``gates`` follows. All strategies are listed, each with its
source, in ``calibration.strategies``.
"""
