"""Pictures: plans, errors of verification, the frontier of a comparison.

Without matplotlib drawing is a ``RuntimeUnavailableError``, and a picture that cannot be written an ``OutputError``.
"""
