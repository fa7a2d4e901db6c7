"""Recorded episodes as calls of the policy: ``.npz``, zarr replay buffers, robomimic's HDF5, LeRobot data sets.

Whatever is wrong with a recording is a ``TrajectoryError`` of any function of this room.
"""

from .episodes import Episode, episodes_of, load_trajectories, read_npz
from .rate import recorded_rate

__all__ = ["Episode", "episodes_of", "load_trajectories", "read_npz", "recorded_rate"]
