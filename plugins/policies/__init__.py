"""Policies beside those of the core: action heads as their authors' code saved them, and LeRobot's ``act``.

Each is one module with the network and ``load``, and one row: in ``ttscompile/frontends/families.py``, or for a type of
LeRobot's in ``frontends/lerobot.py``. What the rest of a model gives a head is what the head observes.
"""
