"""Policies beside the core's: as their authors' code saved them; LeRobot's ``act``, ``eo1``, ``wall_x``, ``xvla``.

``act`` has no loop, ``eo1`` and ``wall_x`` alone denoise inside a language model, and no other sees as ``xvla`` does.

Each is one module with the network and its loading, and one row: in ``frontends/families.py``, for a class of Diffusion
Policy's kind in ``diffusion_policy.py``, or for a type of LeRobot's in ``lerobot.py``. Of an action head the
observations are what the rest of its model gives it.
"""
