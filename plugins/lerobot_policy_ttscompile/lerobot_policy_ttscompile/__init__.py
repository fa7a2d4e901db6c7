"""Policies that ttscompile compiled, in LeRobot's own commands: ``lerobot-eval --policy.path=compiled/``.

LeRobot imports every installed package whose name begins with ``lerobot_policy_``; importing this one registers the
policy type ``ttscompile``.
"""

from .configuration_ttscompile import TtscompileConfig
from .modeling_ttscompile import TtscompilePolicy

__all__ = ["TtscompileConfig", "TtscompilePolicy"]
