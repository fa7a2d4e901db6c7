"""Environments in which something is not as it was in the recordings: ``--environment NAME:DISTURBANCE``.

``disturbed/NAME.py`` is about ``NAME.py`` beside this folder. Its mapping ``DISTURBED`` has a class for each
disturbance, by its name.
"""
