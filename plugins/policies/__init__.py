"""Policies beside those of the core: action heads as their authors' code saved them, LeRobot's ``act``, and others.

Each is one module with the network and ``load``, and one row: in ``ttscompile/frontends/families.py``, for a type of
LeRobot's in ``frontends/lerobot.py``, or for a policy of Diffusion Policy's workspace in
``frontends/diffusion_policy.py``. What the rest of a model gives a head is what the head observes.
"""
