"""Policies beside those of the core: as their authors' code saved them; LeRobot's ``act``, ``eo1`` and ``xvla``.

``act`` has no loop, no other policy denoises inside its language model as ``eo1`` does, and none sees as ``xvla`` does.

Each is one module with the network and its loading, and one row: in ``frontends/families.py``, for a class of Diffusion
Policy's kind in ``diffusion_policy.py``, or for a type of LeRobot's in ``lerobot.py``. Of an action head the
observations are what the rest of its model gives it.
"""
