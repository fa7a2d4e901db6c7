"""LeRobot's asynchronous policy server for compiled policies: ``python -m lerobot_policy_ttscompile.policy_server``.

The server's own command has a fixed list of policy types and imports no plugins. It takes the same options. Nothing
else of the plugin needs it: where LeRobot has no such server there are ``lerobot-rollout`` and ``ttscompile serve``.
"""

from __future__ import annotations

import sys

from .modeling_ttscompile import TtscompilePolicy
from .versions import TRIED


def main() -> None:
    """Serve, with one type more; exit status 2 where this LeRobot has no such server."""
    try:
        from lerobot.async_inference.policy_server import serve

        allow()
    except (ImportError, AttributeError) as error:
        sys.stderr.write(
            f"error: this LeRobot has no asynchronous policy server as {TRIED} has it with lerobot[async] ({error}):"
            " run lerobot-rollout on the robot, or ttscompile serve\n"
        )
        sys.exit(2)
    serve()


def allow() -> None:
    """Put the type on the server's list."""
    from lerobot.async_inference import constants

    if TtscompilePolicy.name not in constants.SUPPORTED_POLICIES:
        constants.SUPPORTED_POLICIES.append(TtscompilePolicy.name)


if __name__ == "__main__":
    main()
