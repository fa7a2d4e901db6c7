"""What calibration is compared with: strategies that others have published, and switches.

``static`` has strategies that follow a rule; ``fixed`` what all of one interval share; ``online`` what those share that
decide during a call; ``sensitivity`` has the gradients that ``gates`` follows, and predicts the effect of every change
of a plan. ``switches`` chooses exchanges of cells by it, which depend on the observation, and ``adaptation`` keeps what
lowers the error.

All strategies are listed, each with its source, in ``calibration.strategies``. Nothing that calibrates by default
imports this package.
"""
