"""What a policy is evaluated in: what an environment has to offer, and which there are.

A new one is one file in this folder, named as ``--environment`` calls it (``_`` for ``-``): a class that satisfies
``Environment``, and the line ``ENVIRONMENT = TheClass``. ``fetch.py`` is a short one to start from. The folder
``disturbed`` has environments in which something is not as it was in the recordings. The tests hold every file here
against the protocol.

An environment gives single frames and takes single actions. Windows of To frames, chunks of actions, batches, noise,
the cache and the tables are the harness's; the specification of the policy says how windows are cut.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import click
import numpy as np
import numpy.typing as npt

from ttscompile.errors import TtscompileError

Array: TypeAlias = npt.NDArray[Any]
Frame: TypeAlias = dict[str, Array]
"""What is observed at one time, by key: what a policy takes, without the axes of batch and window."""


class Environment(Protocol):
    """One robot and its task or tasks, one episode after another.

    A seed is an episode: the same seed and the same actions give the same frames, scores and pictures, in any order of
    episodes. All but the first four attributes are of the episode under way.

    Attributes:
        title: for tables and pictures, such as ``Push-T``.
        hz: actions a second.
        max_steps: actions after which an episode ends.
        displacements: channels of the actions that say how far to move, not where to (``ExecutorSettings``).
        task: what has to be done, where there are several tasks: the seed decides; else empty.
    """

    title: str
    hz: float
    max_steps: int
    displacements: tuple[int, ...]
    task: str

    @property
    def done(self) -> bool:
        """The task is solved, or ``max_steps`` actions were taken."""

    @property
    def success(self) -> bool:
        """The task is solved. It stays solved."""

    @property
    def score(self) -> float:
        """0 to 1, what the episode is worth so far: 1 if it is solved. It never falls."""

    @property
    def measures(self) -> Mapping[str, float]:
        """Further figures so far, by name; tables show their means."""

    def reset(self, seed: int) -> None:
        """Start the episode of this seed."""

    def observe(self) -> Frame:
        """The frame now. A policy takes the keys that it knows; costs nothing where nobody asks."""

    def step(self, action: Array) -> None:
        """Take one action ``[Da]``; not called once the episode is done."""

    def rest(self) -> Array:
        """The action ``[Da]`` that leaves the robot where it is now."""

    def picture(self) -> npt.NDArray[np.uint8]:
        """The world now, for people: RGB ``[H, W, 3]``."""

    def close(self) -> None:
        """Free what drawing took; nothing is asked of it any more."""


def environment_names() -> list[str]:
    """Of the files in this folder."""
    files = Path(__file__).parent.glob("[a-z]*.py")
    return sorted(file.stem.replace("_", "-") for file in files)


def disturbances(name: str) -> Mapping[str, type[Environment]]:
    """What can be otherwise in an environment: a class by the name of each.

    Args:
        name: one of ``environment_names()``.

    Raises:
        TtscompileError: a package that the environment needs is not installed.
    """
    if not (Path(__file__).parent / "disturbed" / f"{name.replace('-', '_')}.py").exists():
        return {}
    found: Mapping[str, type[Environment]] = _module(name, "disturbed.").DISTURBED
    return found


def environment_class(name: str) -> type[Environment]:
    """The class of an environment; call it for one of your own.

    Args:
        name: one of ``environment_names()``; after a colon one of its ``disturbances``.

    Raises:
        TtscompileError: a package that it needs is not installed, or there is no such disturbance.
    """
    name, _, disturbance = name.partition(":")
    if disturbance:
        known = disturbances(name)
        if disturbance not in known:
            expected = f"expected one of {', '.join(known)}" if known else "it has none"
            raise TtscompileError(f"disturbance of the environment {name!r}: {expected}; found {disturbance!r}.")
        return known[disturbance]
    found: type[Environment] = _module(name).ENVIRONMENT
    return found


def _module(name: str, folder: str = "") -> Any:
    try:
        return import_module(f"{__name__}.{folder}{name.replace('-', '_')}")
    except ModuleNotFoundError as error:
        if (error.name or __name__).startswith(__name__):
            raise
        lacking = f"the environment {name!r} needs the package {error.name!r}, which is not installed"
        raise TtscompileError(f"{lacking}. Run: pip install 'ttscompile[examples]'.") from error


class _Name(click.Choice[str]):
    """``NAME`` or ``NAME:DISTURBANCE``; of the latter the class is asked, since to list them imports a simulator."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        name, colon, disturbance = str(value).partition(":")
        return str(super().convert(name, param, ctx)) + colon + disturbance


environment_option = click.option(
    "--environment",
    default="pusht",
    show_default=True,
    type=_Name(environment_names()),
    help="What to drive; NAME:DISTURBANCE for what was never recorded.",
)
