"""What calibration is compared with: strategies that others have published.

``static`` has strategies that follow a rule; ``fixed`` what all of one interval share; ``online`` what those share that
decide during a call; ``slopes`` has the gradients that ``gates`` follows.

All strategies are listed, each with its source, in ``calibration.strategies``. Nothing that calibrates by default
imports this package.
"""
