from tests.policies.conftest import payload, save

__all__ = ["payload", "save"]
