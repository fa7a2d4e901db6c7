"""LeRobot's asynchronous policy server for compiled policies: ``python -m lerobot_policy_ttscompile.policy_server``.

The server's own command has a fixed list of policy types and imports no plugins. It takes the same options.
"""

from __future__ import annotations

from lerobot.async_inference import constants

from .modeling_ttscompile import TtscompilePolicy


def main() -> None:
    """Serve, with one type more."""
    from lerobot.async_inference.policy_server import serve

    allow()
    serve()


def allow() -> None:
    """Put the type on the server's list."""
    if TtscompilePolicy.name not in constants.SUPPORTED_POLICIES:
        constants.SUPPORTED_POLICIES.append(TtscompilePolicy.name)


if __name__ == "__main__":
    main()
