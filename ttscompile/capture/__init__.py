"""What is taken from the original network: its graph (``export``), with the batch as a symbol (``batch``), narrowed.

What cannot be captured is a ``CaptureError`` that names the node; steps that cannot be left out are a ``SpecError``.
"""
