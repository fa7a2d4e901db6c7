"""The intermediate representation: immutable graphs of ATen operations, and the program that passes rewrite.

What does not fit in a graph or a program is a ``PassError``, and what torch cannot do of it a ``CaptureError``.
"""
