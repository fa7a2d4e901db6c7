"""The text of a task in place of its tokens, for a robot that has the policy's tokenizer. Imports no torch."""

import os
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.core.coercion import plain
from ttscompile.core.spec import PolicySpec
from ttscompile.core.tokenizer import TASK, ReadTokenizer, Tokenizer, padded
from ttscompile.errors import ObservationError


class Instruct:
    """Puts the tokens of a task into an observation; ``read`` gives the tokenizer when the first text comes."""

    def __init__(self, spec: PolicySpec, read: ReadTokenizer) -> None:
        assert spec.instruction is not None
        self._told, self._keys, self._read = spec.instruction, tuple(spec.observations), read
        self._length = spec.observations[self._told.tokens].shape[0]
        self._made: dict[tuple[str, str], list[int]] = {}
        self._texts: list[str] | None = None
        self._other = False

    @cached_property
    def _tokenizer(self) -> Tokenizer:
        return self._read(ObservationError)

    def __call__(self, obs: Mapping[str, Any]) -> Mapping[str, Any]:
        """The observation with tokens and mask of its ``task``, a text or one a stream; as it is if it has them.

        Raises:
            ObservationError: it has neither, or the task is no text, or one without the state that it is told with.
        """
        if not isinstance(obs, Mapping) or self._told.tokens in obs:
            return obs
        if TASK not in obs:
            expected = f"a text, 'pick up the cup' say, or its tokens, {self._told.tokens!r} and {self._told.mask!r}"
            raise ObservationError(f"the observation has no {TASK!r}; expected {expected}.")
        rest = {key: value for key, value in obs.items() if key != TASK}
        task = obs[TASK].tolist() if isinstance(obs[TASK], np.ndarray) else obs[TASK]
        own = (rest[key] for key in self._keys if key in rest)
        streams = next((len(value) for value in own if getattr(value, "shape", ())), 1)
        texts = [task] * streams if isinstance(task, str) else task
        if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
            raise ObservationError(f"the task is {task!r:.80}; expected a text, or one for each stream.")
        states = self._states(rest, len(texts))
        self._other, self._texts = self._other or self._texts not in (None, list(texts)), list(texts)
        tokens, mask = padded(list(map(self._tokens, texts, states)), self._length)
        return {**rest, self._told.tokens: tokens, self._told.mask: mask}

    def other_task(self) -> bool:
        """Whether a text was another one than that before it since this was asked last.

        Tokens tell that, too, but where they hold a state: then what is kept of a scene has to be forgotten.
        """
        found, self._other = self._other and self._told.state is not None, False
        return found

    def of_frame(self, frame: Mapping[str, Any]) -> Mapping[str, Any]:
        """The same for one frame of one robot, without the axis of streams."""
        if not isinstance(frame, Mapping) or TASK not in frame or self._told.tokens in frame:
            return frame
        if not isinstance(frame[TASK], str):
            raise ObservationError(f"the task of a frame is a {type(frame[TASK]).__name__}; expected a text.")
        key = "" if self._told.state is None else self._told.state.key
        one = {key: plain(frame[key], f"observation {key!r}", ObservationError)[None]} if key in frame else {}
        made, new = self({TASK: frame[TASK], **one}), (self._told.tokens, self._told.mask)
        return {**{key: value for key, value in frame.items() if key != TASK}, **{key: made[key][0] for key in new}}

    def _states(self, obs: Mapping[str, Any], streams: int) -> list[str]:
        """The words of the states of so many streams; empty where the instruction has none."""
        told = self._told.state
        if told is None:
            return [""] * streams
        expected = f"expected float32 {[streams, len(told.first)]}, since the instruction of this policy holds it"
        if told.key not in obs:
            raise ObservationError(f"the task comes without {told.key!r}; {expected}.")
        given = plain(obs[told.key], f"observation {told.key!r}", ObservationError)
        if given.shape[:1] != (streams,) or given.size != streams * len(told.first) or given.dtype.kind != "f":
            raise ObservationError(f"observation {told.key!r} is {given.dtype} {list(given.shape)}; {expected}.")
        return list(map(told, given.reshape(streams, -1).astype(np.float32)))

    def _tokens(self, text: str, state: str) -> list[int]:
        """Of one text and state; the last are kept, since an episode has one text. Several threads may ask."""
        if (known := self._made.get((text, state))) is None:
            known = self._tokenizer.of_task(text, self._told, self._length, state)
            self._made = {(text, state): known}
        return known


def instruct_of(artifact: Artifact, tokenizer: str | os.PathLike[str] | None = None) -> Instruct | None:
    """What puts tokens into a policy's observations; None where the policy has no tokenizer, or is told no task.

    A tokenizer that is given is read at once, the artifact's own when the first text comes: whoever gives tokens needs
    neither it nor the package that reads it.

    Raises:
        ObservationError: the policy is not told its task in words alone, or there is no such tokenizer.
    """
    spec = artifact.manifest.spec
    if tokenizer is not None:
        if spec.instruction is None:
            remedy = "Leave the tokenizer out."
            raise ObservationError(f"{tokenizer}: this policy takes no text that alone would give its tokens. {remedy}")
        own = Tokenizer(tokenizer, ObservationError)
        return Instruct(spec, lambda error: own)
    return None if spec.instruction is None or artifact.tokenizer is None else Instruct(spec, artifact.tokenizer)
