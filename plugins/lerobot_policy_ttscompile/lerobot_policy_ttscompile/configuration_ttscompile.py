"""The policy type ``ttscompile``: what ``config.json`` of a compiled policy says, and what a command may change."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig


@PreTrainedConfig.register_subclass("ttscompile")
@dataclass
class TtscompileConfig(PreTrainedConfig):
    """A compiled policy. ``ttscompile convert`` writes what belongs to the policy; the rest is how it is executed.

    Attributes:
        n_action_steps: actions of a chunk that are executed.
        runtime: ``onnxruntime``, ``torch``, or ``reference``, which is slow.
        threads: threads of arithmetic.
        plan: name of a plan of the artifact, ``dense`` among them, or ``NAME@fp32`` for one in another precision; None
            for the artifact's default.
        original: the policy that was compiled, where that shall act and the compiled one be compared with it: its
            directory, or a repository.
        precision: of older configurations, in which it was not part of the plan's name; the policy moves it there.
    """

    n_action_steps: int = 1
    runtime: str = "onnxruntime"
    threads: int = 1
    plan: str | None = None
    original: str | None = None
    precision: str | None = None

    @property
    def observation_delta_indices(self) -> list[int]:
        """Frames of a data set that make one observation."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> None:
        """None: a compiled policy is not trained."""

    @property
    def reward_delta_indices(self) -> None:
        """None, likewise."""

    def get_optimizer_preset(self) -> None:
        """None, likewise."""

    def get_scheduler_preset(self) -> None:
        """None, likewise."""

    def validate_features(self) -> None:
        """Nothing: the policy compares them with its artifact when it is loaded."""
