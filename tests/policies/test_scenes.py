"""Of vision-language-action models: the language model is not computed again for another state."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise
from ttscompile.passes.split_frames import SplitFrames
from ttscompile.report.facts import hoisting
from ttscompile.runtimes.policy import CompiledPolicy

from . import pis
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array
from .whole_vlas import WHOLE

BY_NAME = {one.name: one for one in WHOLE}


@dataclass(frozen=True)
class Seen:
    """A policy that is compiled with its towers and its scene, however small they are."""

    path: Path
    told: tuple[str, ...]

    def observation(self, seed: int = 0, state: int = 0) -> dict[str, Array]:
        """One that the policy takes: the seed decides all of it but the state."""
        specs = ttscompile.load(self.path).info.observation
        rngs = {key: np.random.default_rng((state if key == STATE else seed, i)) for i, key in enumerate(specs)}
        obs = {key: spec.draw(rngs[key]) for key, spec in specs.items()}
        return obs | {key: np.arange(obs[key].size)[None] < 5 for key in obs if key == MASK}


@pytest.fixture(scope="module")
def make(once: Once, shared: Path) -> Any:
    def made(name: str) -> Seen:
        def compile_one(folder: Path) -> None:
            if name in pis.KINDS:
                directory = pis.save(name, folder / "policy")
            elif name == "smolvla":
                directory = shared / "golden" / "lerobot_whole" / "smolvla"
            else:
                directory = BY_NAME[name].save(BY_NAME[name].kinds[0], folder / "policy", 0)
            notes = list[str]()
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("ttscompile.driver.SplitFrames", lambda: SplitFrames(1000))
                ttscompile.convert(
                    directory,
                    folder / "artifact",
                    explain=lambda stage, told: notes.extend(told) if stage == "SplitFrames" else None,
                )
            (folder / "told.txt").write_text("\n".join(notes))

        folder = once.folder(f"scene {name}", compile_one)
        return Seen(folder / "artifact", tuple((folder / "told.txt").read_text().splitlines()))

    return made


def act(policy: CompiledPolicy, obs: Mapping[str, Array], plan: str = "dense") -> Array:
    spec = policy._spec
    noise = Noise(np.random.default_rng(1).standard_normal((1, *spec.sample), dtype=np.float32))
    return np.asarray(policy.predict_action(obs, noise=noise, plan=plan)["action_pred"])


def counts(policy: CompiledPolicy) -> tuple[int, int]:
    assert policy.last_report is not None
    return policy.last_report.frames.scenes, policy.last_report.frames.scenes_remembered


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pi0", "smolvla", "evo1", "groot", "vla_jepa", "xvla"])
def test_another_state_computes_no_language_model(make: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = make(name)
    policy, fresh = ttscompile.load(seen.path), ttscompile.load(seen.path)
    backend: Any = policy._runtime.backend
    own, ran = backend.sessions["scene"], list[None]()

    class Counted:
        def run(self, outputs: list[str], feed: Mapping[str, Array]) -> Any:
            ran.append(None)
            return own.run(outputs, feed)

    monkeypatch.setitem(backend.sessions, "scene", Counted())
    first = act(policy, seen.observation(state=0))
    second = act(policy, seen.observation(state=1))
    assert (len(ran), counts(policy)) == (1, (0, 1))
    np.testing.assert_array_equal(act(fresh, seen.observation(state=1)), second)
    assert np.abs(second - first).max() > 1e-4, "the state is read"
    # Another picture, and other words; then what was seen in the first call, which is two scenes ago.
    for changed in (CAMERAS[0], TOKENS):
        obs = seen.observation() | {changed: seen.observation(seed=2)[changed]}
        found = act(policy, obs)
        assert counts(policy) == (1, 0)
        fresh.reset()
        np.testing.assert_array_equal(act(fresh, obs), found)
        assert np.abs(found - first).max() > 0
    for runtime in ("torch", "reference"):
        other = ttscompile.load(seen.path, runtime=runtime)
        np.testing.assert_allclose(act(other, obs), found, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_the_words_of_pi05_tell_its_state(make: Any) -> None:
    """So its scene stands as long as they do."""
    seen = make("pi05")
    policy, obs = ttscompile.load(seen.path), seen.observation()
    act(policy, obs)
    act(policy, obs)
    assert counts(policy) == (0, 1)
    found = act(policy, {**obs, TOKENS: obs[TOKENS] ^ 1})
    assert counts(policy) == (1, 0)
    for runtime in ("torch", "reference"):  # where nothing is left of the condition graph
        other = ttscompile.load(seen.path, runtime=runtime)
        np.testing.assert_allclose(act(other, {**obs, TOKENS: obs[TOKENS] ^ 1}), found, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_where_the_language_model_reads_the_state_it_is_told(make: Any) -> None:
    seen = make("eo1")
    assert seen.told[-1].endswith(f" MFLOP in every call, since they read %{STATE}")
    (table,) = hoisting(load_artifact(seen.path)).tables
    rows = {row[0]: row for row in table.rows}
    assert rows["condition"][1] == f"once a call, since it reads {STATE}"
    assert "scene" not in rows


@pytest.mark.slow
def test_what_is_known_of_a_scene_is_told(make: Any) -> None:
    (table,) = hoisting(load_artifact(make("smolvla").path)).tables
    rows = {row[0]: row for row in table.rows}
    assert rows["scene"][1] == "once, until a picture or a word changes"
    assert rows["condition"][1] == f"once a call, since it reads {STATE}"
