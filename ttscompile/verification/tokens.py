"""The rung of tokens that are reused: computed all, they give what the encoder gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..artifact.golden import Golden
from ..artifact.load import Artifact
from ..runtimes.frames import FrameWork
from ..runtimes.runtime import Runtime
from .calls import SAMPLE, VALUE, computed
from .network import largest
from .rung import Rung, judged

TOKENS = "tokens"


def check_tokens(artifact: Artifact, golden: Golden, runtime: Runtime) -> Rung | None:
    """A dense call in which all tokens are computed against one without their pieces, and one that reuses them.

    None where no plan reuses any.
    """
    obs = golden.network_observations(artifact.manifest.spec)
    reuse = next((plan.tokens for plan in artifact.plans.values() if plan.tokens is not None), None)
    if reuse is None:
        return None
    samples, works = [], list[FrameWork]()
    for settings in (None, replace(reuse, refresh=1), reuse):
        plan = replace(computed(artifact), tokens=settings)
        runtime.reset()
        sample, report = runtime.predict(obs, golden.noise, plan)
        samples.append(sample)
        if settings is reuse:  # the newest pictures again, with a bright spot
            shown = {key: value.copy() for key, value in obs.items()}
            for key, spec in artifact.manifest.spec.observations.items():
                if spec.image:
                    newest = shown[key][:, -1] if spec.frames else shown[key]
                    y, x = (slice(n // 2, n // 2 + n // 8 + 1) for n in newest.shape[-2:])
                    newest[..., y, x] += np.float32(10)
            _, report = runtime.predict(shown, golden.noise, plan)
        works.append(report.frames)
    _, whole, some = works
    told = (
        f"a dense call that computes {whole.tokens} of {whole.of} tokens against one by whole frames; where a spot is"
        f" new, {some.tokens} of {some.of} are computed"
    )
    error = largest(samples[1], samples[0])
    if whole.tokens != whole.of or not 0 < some.tokens < some.of:
        error = np.inf
    details = {"spot": [some.tokens, some.of], **vars(reuse)}
    remedy = "Take plans that compute all tokens (plan.exact), or convert the checkpoint again."
    return replace(judged(TOKENS, error, SAMPLE, VALUE, told, remedy), details=details)
