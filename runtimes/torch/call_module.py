"""What a module of a call has whatever its plan is: constants as buffers, checks of what it is given, and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from ttscompile.artifact.view import View
from ttscompile.core.correction import Correction
from ttscompile.core.envelope import FAR, plain_cells
from ttscompile.core.spec import Affine, PolicySpec
from ttscompile.errors import ObservationError
from ttscompile.ir.idle_form import idle_form

from .idle_steps import IdleSteps
from .plain_network import PlainNetwork, evaluators_of
from .sampler import Advance

CPU = torch.device("cpu")


class CallModule(nn.Module):
    """A call of a policy. Every constant is a buffer; nothing is a parameter, or kept from call to call."""

    def __init__(
        self,
        view: View,
        weights: Mapping[str, npt.NDArray[Any]],
        advance: Advance,
        correction: Correction | None,
    ) -> None:
        super().__init__()
        manifest, pieces = view.manifest, view.pieces
        self._spec, self._pieces, self._features = manifest.spec, pieces, manifest.features
        self._names: dict[str, str] = {}  # of buffers, by what they hold
        constants = {name for graph in pieces.graphs().values() for name in graph.constants}
        self._keep("weight", {name: value for name, value in weights.items() if name in constants})
        self._keep("first weight", view.first_weights)
        self._keep("table", pieces.tables)
        self._advance = advance
        self._bound = None if correction is None else manifest.spec.sampler.bound
        self._keep("advance", self._advance.tensors())
        form, _ = idle_form(pieces, view.weights)
        self._idle = None if form is None else IdleSteps(form, CPU)
        self._keep("idle", {} if self._idle is None else self._idle.tensors())
        bias = np.zeros((1, 1, 1, 1), np.float32) if correction is None else correction.bias
        self._keep("offset", {"noise": manifest.spec.sampler.noise_to_next[:, None, None, None], "bias": bias})
        envelope = view.artifact.envelope
        self._far: Advance | None = None
        if correction is not None and envelope is not None:
            self._far = type(advance)(manifest.spec, None, CPU)
            self._keep("far", self._far.tensors())
            self._keep("envelope", {"reading": envelope.reading, "center": envelope.center})
            self._plain_cells = plain_cells(correction, len(manifest.blocks))
        for key, each in manifest.spec.observations.items():
            self._keep(f"normalizer {key}", _numbers(each.normalizer))
        self._keep("actions", _numbers(manifest.spec.chunk.normalizer))
        self._evaluators = evaluators_of(pieces)

    @property
    def spec(self) -> PolicySpec:
        """What goes in and comes out."""
        return self._spec

    def _network(self, obs: Mapping[str, Tensor], initial: Tensor) -> PlainNetwork:
        """The network of a call."""
        spec = self._spec
        horizon, dimensions = spec.sample
        if initial.ndim != 3 or tuple(initial.shape[1:]) != spec.sample or initial.dtype != torch.float32:
            found = f"{initial.dtype} {list(initial.shape)}"
            raise ObservationError(f"initial must be float32 [B, T, D] = [B, {horizon}, {dimensions}]; found {found}.")
        given = {}
        for key, one in spec.observations.items():
            value = obs.get(key)
            shape = None if value is None else tuple(value.shape)
            if value is None or shape != (len(initial), *one.shape) or value.dtype != getattr(torch, one.dtype):
                expected = f"{one.dtype} [{', '.join(map(str, (len(initial), *one.shape)))}]"
                found = "none" if value is None else f"{value.dtype} {list(value.shape)}"
                raise ObservationError(f"observation {key!r} must be {expected}; found {found}.")
            given[key] = _affine(value, self._kept(f"normalizer {key}"))
        weights = self._kept("weight")
        idle = None if self._idle is None else self._idle.on(self._kept("idle"))
        return PlainNetwork(
            pieces=self._pieces,
            evaluators=self._evaluators,
            weights=weights,
            first=weights | self._kept("first weight"),
            tables=self._kept("table"),
            obs=given,
            streams=len(initial),
            idle=idle,
        )

    def _is_far(self, network: PlainNetwork) -> Tensor:
        """Which streams are so far outside of what was recorded that they have no correction, bool ``[B]``."""
        envelope = self._kept("envelope")
        away = network.condition(self._features) @ envelope["reading"] - envelope["center"]
        far: Tensor = torch.linalg.vector_norm(away, dim=1) > FAR
        return far

    def _moves(
        self, network: PlainNetwork, initial: Tensor, steps: Tensor | None, corrected: bool = True
    ) -> tuple[Advance, Tensor, Tensor | None]:
        """The sampler; what each step adds, ``[K, D, B, (1 + S) T]``; and what the correction reads, ``[B, F]``.

        Raises:
            ObservationError: noise of the steps of another shape, or missing.
        """
        advance = self._advance.on(self._kept("advance"))
        if not corrected:
            assert self._far is not None
            advance = self._far.on(self._kept("far"))
        spec = self._spec
        horizon, dimensions = spec.sample
        own = self._kept("offset")
        bias = own["bias"] if corrected else torch.zeros_like(own["bias"])
        offset = bias.expand(spec.sampler.steps, dimensions, len(initial), horizon)
        if spec.sampler.stochastic:
            if steps is None or tuple(steps.shape) != (spec.sampler.steps, *initial.shape):
                found = "none" if steps is None else str(list(steps.shape))
                expected = f"float32 [K, B, T, D] = {[spec.sampler.steps, *initial.shape]}"
                raise ObservationError(f"steps must be {expected}, since the sampler draws noise; found {found}.")
            offset = offset + steps.permute(0, 3, 1, 2) * own["noise"]
        read = None
        if advance.reading is not None:
            read, added = advance.of_condition(network.condition(self._features))
            offset = offset + added
        return advance, nn.functional.pad(offset, (0, advance.memories * horizon)), read

    def _actions(self, sample: Tensor) -> Tensor:
        """The actions of a denoised sample ``[B, T, D]``, in their own units."""
        if self._bound is not None:
            sample = sample.clamp(-self._bound, self._bound)
        actions = sample[..., : self._spec.chunk.action_dim]
        normalizer = self._kept("actions")
        return (actions - normalizer["offset"]) / normalizer["scale"] if normalizer else actions.clone()

    def _keep(self, kind: str, arrays: Mapping[str, object]) -> None:
        """Make buffers of arrays or tensors."""
        for name, value in arrays.items():
            buffer = f"constant_{len(self._names)}"  # names of weights have dots
            self._names[f"{kind}/{name}"] = buffer
            self.register_buffer(buffer, value if isinstance(value, Tensor) else torch.tensor(np.asarray(value)))

    def _kept(self, kind: str) -> dict[str, Tensor]:
        """The buffers of a kind, by name."""
        start = f"{kind}/"
        found = {n.removeprefix(start): b for n, b in self._names.items() if n.startswith(start)}
        return {name: self.get_buffer(buffer) for name, buffer in found.items()}


def _numbers(normalizer: Affine | None) -> dict[str, object]:
    return {} if normalizer is None else {"scale": normalizer.scale, "offset": normalizer.offset}


def _affine(value: Tensor, normalizer: Mapping[str, Tensor]) -> Tensor:
    return value * normalizer["scale"] + normalizer["offset"] if normalizer else value
