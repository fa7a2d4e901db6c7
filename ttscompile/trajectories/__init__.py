"""Recorded episodes as calls of the policy: ``.npz``, zarr replay buffers, robomimic's HDF5, LeRobot data sets."""

from __future__ import annotations

from .episodes import Episode, load_trajectories, read_npz

__all__ = ["Episode", "load_trajectories", "read_npz"]
