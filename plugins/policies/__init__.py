"""The policies that are read: their networks, and how what a training saved becomes one of them.

``networks`` has what is computed, under the names of the original's weights. ``diffusion_policy`` and ``lerobot`` read
what these two projects save; a module beside them reads what the authors of one policy save. Each is found by a row: in
``frontends/families.py``, or, for a class of Diffusion Policy's kind or a type of LeRobot's, in their ``family.py``. Of
an action head the observations are what the rest of its model gives it.
"""
