"""Loops are measured once a process: a table depends on the settings of its scheduler alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from ttscompile.core.spec import SamplerTable
from ttscompile.frontends import scheduler
from ttscompile.samplers.table import sampler_table


@contextmanager
def measured_once() -> Iterator[None]:
    """Keep the tables of checkpoints' schedulers; where a setting is none that JSON has, each is measured."""
    known = dict[str, SamplerTable]()

    def once(own: Any, steps: int, *, step_arguments: Mapping[str, Any] | None = None, **more: Any) -> SamplerTable:
        given = [*own.config.items(), *(step_arguments or {}).items(), *more.items()]
        if not all(isinstance(value, bool | int | float | str | list | tuple | None) for _, value in given):
            return sampler_table(own, steps, step_arguments=step_arguments, **more)
        key = repr((type(own), steps, sorted(given, key=repr), step_arguments is None))
        if key not in known:
            known[key] = sampler_table(own, steps, step_arguments=step_arguments, **more)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduler, "sampler_table", once)
        yield
