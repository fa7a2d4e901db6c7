"""SAG: a head makes the cells from the observation, and what is not computed reads FORWARD alone.

Source: Sparse ActionGen: Accelerating Diffusion Policy with Real-time Pruning (arXiv 2601.12894). Gates have two ways
there: a block is computed, or takes the residual that the last computed block of its kind has left, whichever step that
was in. They are decided for each call, before its loop, so that a runtime executes them as it does any plan of the
artifact's head. The head and its training are those of ``tts-paper``, the same group's later method, with TIMESTEP and
ROLLOUT forbidden.
"""

from functools import partial

from ttscompile.calibration.pruner.paper import Paper
from ttscompile.core.lattice import Source

sag = partial(Paper, sources=(), reused=Source.FORWARD)
