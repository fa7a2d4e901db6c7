"""Strategies that others have published: one module each, and what several of them share.

``fixed`` has the strategies of one interval, ``online`` and ``criterion`` those that decide during a call, ``slopes``
the gradients that ``gates`` follows. All strategies are listed, each with its source, in
``calibration.strategies``.
"""
