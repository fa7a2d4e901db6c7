"""Policies that ttscompile compiled, in LeRobot's own commands: ``lerobot-eval --policy.path=compiled/``.

LeRobot imports every installed package whose name begins with ``lerobot_policy_``; importing this one registers the
policy type ``ttscompile``.
"""

from .versions import require_lerobot

require_lerobot()  # before anything is imported that another version may not have

from .configuration_ttscompile import TtscompileConfig  # noqa: E402
from .modeling_ttscompile import TtscompilePolicy  # noqa: E402

__all__ = ["TtscompileConfig", "TtscompilePolicy"]
