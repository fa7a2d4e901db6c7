"""A compiled policy as LeRobot calls it.

The artifact takes what the robot measures and gives what it executes, so nothing is normalised here or in the
processors that ``ttscompile convert`` writes beside it.
"""

from __future__ import annotations

import atexit
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

import ttscompile
from ttscompile.artifact.load import read_manifest
from ttscompile.runtimes.executor import ShadowReport

from .configuration_ttscompile import TtscompileConfig
from .original import Original

logger = logging.getLogger(__name__)

_LANGUAGE = "observation.language."
_FILES = [
    *("manifest.json", "program.json", "tokenizer.json", "*.onnx", "*.safetensors"),
    *("config.json", "policy_preprocessor.json", "policy_postprocessor.json"),
]
"""Of a repository: an artifact's files, and those that LeRobot reads beside them. ``load`` checks them."""


class TtscompilePolicy(PreTrainedPolicy):
    """A ``PreTrainedPolicy`` around ``ttscompile.load``.

    Noise is drawn from torch's global generator, which LeRobot seeds, and in the order of LeRobot's samplers: with the
    generator in the same state the original acts alike on a CPU. (Making the original draws its weights, too.)

    Where the configuration names the original, that acts, and the log says how far this one is from it: at every reset,
    and when the program ends. Both have the same noise where the original computes on a CPU.

    Args:
        config: of the policy.
        directory: the artifact. None is an error: a compiled policy is not made from its configuration.

    Raises:
        ValueError: no directory, or one whose artifact observes something else than ``config.json`` says.
        ttscompile.TtscompileError: the artifact cannot be loaded.
    """

    config_class = TtscompileConfig
    name = "ttscompile"

    def __init__(self, config: TtscompileConfig, directory: str | Path | None = None, **_: Any) -> None:
        super().__init__(config)
        if directory is None:
            raise ValueError(
                "a compiled policy is not made from scratch, and not trained: give --policy.path=DIR, which ttscompile"
                " build wrote"
            )
        self._directory = Path(directory)
        if config.precision is not None:
            config.plan = f"{config.plan or read_manifest(self._directory).default_plan}@{config.precision}"
            config.precision = None
        self._policy = ttscompile.load(directory, config.runtime, config.threads, plan=config.plan)
        observed = {key for key in self._policy.info.observation if not key.startswith(_LANGUAGE)}
        if set(config.input_features or {}) != observed:
            raise ValueError(
                f"{directory}: config.json says that the policy observes {sorted(config.input_features or {})}, and its"
                f" artifact observes {sorted(observed)}: convert the checkpoint again"
            )
        self._shadow: ttscompile.Shadow | None = None
        if config.original is not None:
            self._shadow = ttscompile.Shadow(Original(config.original), self._policy, noise=self._noise_ahead)
            atexit.register(self._tell, True)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None, **options: Any
    ) -> TtscompilePolicy:
        """Load a compiled policy from its directory, or from a repository of the hub.

        Args:
            pretrained_name_or_path: the directory that ``ttscompile convert`` wrote, or a repository with its files.
            config: of the policy; None reads its ``config.json``.
            options: as ``PreTrainedPolicy.from_pretrained`` takes them; those of the hub go to the hub.
        """
        hub = {
            key: options[key]
            for key in ("cache_dir", "force_download", "local_files_only", "revision", "token")
            if key in options
        }
        if config is None:
            config = PreTrainedConfig.from_pretrained(pretrained_name_or_path, **hub)
        directory = Path(pretrained_name_or_path)
        if not directory.is_dir():
            from huggingface_hub import snapshot_download

            wanted: Any = {"allow_patterns": _FILES, "ignore_patterns": "*/*"}  # patterns take folders for names
            directory = Path(snapshot_download(str(pretrained_name_or_path), **wanted, **hub))
        assert isinstance(config, TtscompileConfig)
        return cls(config, directory).eval()

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """The artifact as it is, with this configuration; there are no weights that could have changed."""
        shutil.copytree(self._directory, save_directory, dirs_exist_ok=True)
        self.config._save_pretrained(save_directory)

    def reset(self) -> None:
        """A new episode."""
        if self._shadow is None:
            self._policy.reset()
            return
        self._tell()
        self._shadow.reset()

    def select_action(self, batch: dict[str, Tensor], noise: Tensor | None = None) -> Tensor:
        """The next action ``[B, Da]``, in the units of the robot.

        Args:
            batch: one frame of every stream by key, in the units of the robot, and the ``task`` of each where the
                artifact makes its tokens; keys that are not the policy's are left alone.
            noise: ``[B, T, D]`` that a chunk starts from, if this call computes one; None draws it.
        """
        if self._shadow is not None:
            return self._shadow.select_action(batch)
        drawn = None if self._policy.queued else self._noise(batch, noise)
        return self._policy.select_action(batch, drawn)

    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        noise: Tensor | None = None,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
    ) -> Tensor:
        """A chunk of actions ``[B, Ta, Da]``, in the units of the robot.

        Args:
            batch: as ``select_action`` takes it.
            noise: ``[B, T, D]`` that the chunk starts from; None draws it.
            inference_delay: actions that the robot executes while this call computes.
            prev_chunk_left_over: what is left of the chunk before, ``[N, Da]`` or ``[B, N, Da]``, padded with zeros.
                Its first ``inference_delay`` actions are kept in the new chunk, and the rest of that goes on from them
                (``predict_action(prefix=)``). Those after them have no influence: this is not LeRobot's guidance. Of a
                policy that was trained with shorter prefixes only so many are kept, and the log says so, as LeRobot's
                own loop does it.
        """
        if self._shadow is not None:
            return self._shadow.predict_action_chunk(batch)
        prefix, most = _committed(inference_delay, prev_chunk_left_over), self._policy.info.trained_prefix
        if prefix is not None and 0 < most < prefix.shape[1]:
            told = "%d actions are executed meanwhile; the policy was trained to go on from %d, and is told of no more"
            logger.warning(told, prefix.shape[1], most)
            prefix = prefix[:, :most]
        return self._policy.predict_action_chunk(batch, self._noise(batch, noise), prefix=prefix)

    def supports_rtc(self) -> bool:
        """Whether chunks can be joined to what is executed meanwhile; if not, the log says why."""
        info = self._policy.info
        reason = info.prefix_refusal if self._shadow is None else "the original acts, and this policy is its shadow"
        if reason is None and any(spec.frames not in (None, 1) for spec in info.observation.values()):
            reason = (
                "it observes several frames, and real-time chunking gives it one a chunk: they would lie too far apart."
            )
        if reason is not None:
            logger.warning("%s: no real-time chunking: %s", self._directory, reason)
        return reason is None

    def forward(self, batch: dict[str, Tensor]) -> NoReturn:
        """Compiled policies are not trained.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a compiled policy is not trained: train the original, and convert it again")

    def get_optim_params(self) -> NoReturn:
        """Compiled policies are not trained.

        Raises:
            NotImplementedError: always.
        """
        self.forward({})

    def _tell(self, last: bool = False) -> None:
        """Log how far the compiled policy was from the original; the last time when it has answered all calls."""
        if self._shadow is not None:
            report = self._shadow.close() if last else self._shadow.report()
            if report.calls:
                logger.warning("shadow: %s", _told(report))

    def _noise_ahead(self, batch: Mapping[str, Any]) -> ttscompile.Noise:
        """What the original will draw for a chunk, if the next call computes one; nothing is drawn of it here."""
        with torch.random.fork_rng(devices=[]):
            return self._noise(batch, None)

    def _noise(self, batch: Mapping[str, Any], initial: Tensor | None) -> ttscompile.Noise:
        """What LeRobot's samplers draw for a chunk: the sample that it starts from, and then step by step."""
        info = self._policy.info
        streams = len(batch[next(iter(info.observation))])
        (horizon, width), predicted = info.original_sample, info.sample[0]
        shape = (streams, horizon, width)
        if initial is None:  # a sample that is given is not drawn, and shifts no later draw
            initial = torch.rand(shape) * 2 - 1 if info.noise == "uniform" else torch.randn(shape)
        first = initial.cpu()
        if not info.stochastic:
            return ttscompile.Noise(first[:, :predicted].numpy())
        steps = torch.stack([torch.randn(shape) for _ in range(info.noise_steps - 1)] + [torch.zeros(shape)])
        return ttscompile.Noise(first[:, :predicted].numpy(), steps[:, :, :predicted].numpy())


def _told(report: ShadowReport) -> str:
    """A report for people."""
    failures = f"{report.failed} failed" + (f" ({report.last_failure})" if report.last_failure else "")
    told = f"{report.compared} of {report.calls} calls compared, {report.dropped} dropped, {failures}"
    if report.original_ms is None or report.compiled_ms is None:
        return told
    share = "" if report.of_other_noise is None else f", {report.of_other_noise:.2f} of what other noise changes"
    each = ", ".join(f"{one:.4g}" for one in report.mean)
    return (
        f"{told}, {report.late} late; {report.original_ms.p50:.4g} ms the original, {report.compiled_ms.p50:.4g} ms"
        f" compiled; mean difference {sum(report.mean) / len(report.mean):.4g}{share}; by number of the action"
        f" {each}; worst call {report.worst[1]}: {report.worst[0]:.4g}"
    )


def _committed(delay: int | None, left_over: Tensor | None) -> Tensor | None:
    """The actions ``[B, N, Da]`` that are executed before a chunk can be; None without any.

    LeRobot fills what is left over with zeros up to a fixed length: zeros at its end are nobody's actions.
    """
    if not delay or left_over is None:
        return None
    left_over = left_over if left_over.ndim == 3 else left_over[None]
    there = left_over.abs().amax(dim=(0, 2)).nonzero()
    kept = left_over[:, : min(delay, int(there.max()) + 1 if len(there) else 0)]
    return kept if kept.shape[1] else None
