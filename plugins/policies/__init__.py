"""Policies beside those of the core, as their authors' code saved them; and LeRobot's ``act``, which has no loop.

Each is one module with the network and its loading, and one row: in ``frontends/families.py``, for a class of Diffusion
Policy's kind in ``diffusion_policy.py``, or for a type of LeRobot's in ``lerobot.py``. Of an action head the
observations are what the rest of its model gives it.
"""
