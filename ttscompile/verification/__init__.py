"""Check an artifact without what it was made from: a ladder of rungs, from its bytes to whole episodes."""

from .ladder import verify
from .rung import Rung, Verification

__all__ = ["Rung", "Verification", "verify"]
