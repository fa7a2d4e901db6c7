"""The artifact that is made hostile."""

from tests.artifact.conftest import written

__all__ = ["written"]
