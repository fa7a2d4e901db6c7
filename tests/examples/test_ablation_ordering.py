"""Which tokens are computed: what the script's encoder means, and what it finds on a small policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import ordering
import pytest
import torch
from click.testing import CliRunner
from kept_tokens import TokenPolicy
from ordering import WAYS, Ordering
from orders import CALLS, Chains

from tests.calibration import policies
from tests.families import cameras
from tests.literal_tokens import LiteralTokens
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import load_episodes
from ttscompile.core.lattice import dense_plan
from ttscompile.errors import CalibrationError
from ttscompile.runtimes.random_calls import normalized
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.trajectories.episodes import Episode

pytestmark = pytest.mark.slow

CAMERA = cameras.CAMERAS[0]


@pytest.fixture(scope="module")
def folder(once: Once) -> Path:
    return cameras.compiled_tokens(once) / "artifact"


@pytest.fixture(scope="module")
def policy(folder: Path) -> TokenPolicy:
    return TokenPolicy(view_of(load_artifact(folder), "dense"))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes of four calls: a spot wanders over a picture, and patches on the left flicker a little."""
    rng, calls = np.random.default_rng(0), 32
    still = 0.1 + 0.5 * rng.random((2, 3, cameras.SIDE, cameras.SIDE), dtype=np.float32)
    frames = np.tile(still, (calls + 1, 1, 1, 1, 1))
    for i, frame in enumerate(frames):
        frame[:, :, 4 * (i % 6) : 4 * (i % 6) + 4, 8:12] += 0.3
        frame[..., :4] += 0.05 * rng.random(frame[..., :4].shape, dtype=np.float32)
    windows = np.stack([frames[:-1], frames[1:]], 1).clip(0, 1)
    views: dict[str, Any] = {key: windows[:, :, i] for i, key in enumerate(cameras.CAMERAS)}
    path = tmp_path_factory.mktemp("calls") / "calls.npz"
    np.savez(path, state=rng.random((calls, 2, 4), dtype=np.float32), episode_ends=np.arange(4, 33, 4), **views)
    return path


def stretch(policy: TokenPolicy, recording: Path) -> list[tuple[Episode, int]]:
    return [(episode, 1) for episode in load_episodes(policy.spec, [recording], None)[:2]]


def test_some_tokens_are_what_they_literally_are(folder: Path, policy: TokenPolicy) -> None:
    artifact, rng = load_artifact(folder), np.random.default_rng(0)
    literal, kept = LiteralTokens(artifact.graph("frame_00"), artifact.weights), None
    for number in range(4):
        row = cameras.picture(number)[None]
        computed = [0, *(1 + rng.choice(36, size=12, replace=False))] if number else list(range(37))
        mask = torch.zeros(1, 37).index_fill(1, torch.tensor(computed), 1)
        rows = torch.from_numpy(row)
        found, kept = (
            policy.tower.whole(rows) if kept is None else policy.tower.some(rows, torch.diag_embed(mask), kept)
        )
        for one, other in zip(found, literal(row, computed), strict=True):
            np.testing.assert_allclose(one.numpy(), other, rtol=0, atol=1e-5)


def test_rows_of_other_tokens(policy: TokenPolicy) -> None:
    """What was kept, moved twice by opposite steps, is what it was; a token may have the rows of another one."""
    rows = torch.from_numpy(cameras.picture(0)[None])
    _, kept = policy.tower.whole(rows)
    turned = torch.arange(36).roll(5)[None]
    moved = policy.tower.moved(policy.tower.moved(kept, turned), torch.arange(36).roll(-5)[None])
    assert all(torch.equal(moved[name], kept[name]) for name in kept)
    mix = torch.eye(37)[None].clone()
    mix[0, 7] = mix[0, 9]
    _, merged = policy.tower.some(rows, mix, kept)
    assert all(torch.equal(value[..., 7, :], value[..., 9, :]) for value in merged.values())


def test_with_all_tokens_it_is_the_original(policy: TokenPolicy, recording: Path) -> None:
    chains = Chains(policy, 0, stretch(policy, recording), seed=0)
    model, spec = ReferenceModel.from_view(policy.view), policy.spec
    obs = {key: torch.from_numpy(np.array(one)) for key, one in chains.obs[1].items()}
    plan = dense_plan(model.steps, model.blocks)
    whole = model.denoise(model.prologue(obs), *chains.noise[1], plan).sample
    part = whole[:, spec.chunk.start : spec.chunk.stop, : spec.chunk.action_dim]
    torch.testing.assert_close(chains.actions[1], part, rtol=0, atol=1e-6)


def test_a_camera_has_its_own_rows(policy: TokenPolicy) -> None:
    obs = cameras.frame((cameras.picture(0), cameras.picture(1)), (cameras.picture(2), cameras.picture(3)))
    window = {key: np.stack([0.5 * value, value], 1) for key, value in obs.items()}
    told = normalized(policy.spec, window)
    rows, lanes = policy.rows(told), policy.lanes(told)
    for camera, at in enumerate(lanes):
        for stream in range(2):
            for frame in range(2):
                seen = torch.from_numpy(told[cameras.CAMERAS[camera]][stream, frame])
                assert torch.equal(rows[at[frame, stream]], seen)


def test_an_effect_is_what_keeping_a_little_does(policy: TokenPolicy, recording: Path) -> None:
    """Against the difference quotient: the rows of one token, mixed with a hundredth of what was kept."""
    chains = Chains(policy, 0, stretch(policy, recording), seed=0)
    at, before = chains.lanes[0][-1], chains.rows[0][chains.lanes[0][-1]]
    kept = policy.tower.whole(before)[1]
    seen = chains._seen(chains.rows[1][at], policy.tower.patches(before), kept)
    effects = torch.stack([chains._effect(seen, 1, at, torch.Generator().manual_seed(n)) ** 2 for n in range(60)])
    for patch in (8, 14):
        mask = torch.ones(2, 37)
        mask[:, 1 + patch] = 0.99
        values, _ = policy.tower.some(seen.rows, torch.diag_embed(mask), kept)
        given = [one.index_put((at,), new) for one, new in zip(chains.whole[1][0], values, strict=True)]
        off = (chains._executed(1, given, chains.noise[1]) - chains.actions[1]).flatten(1).norm(dim=1) / 0.01
        torch.testing.assert_close(effects.mean(0)[:, patch].sqrt(), off, rtol=0.25, atol=1e-6)


@pytest.fixture(scope="module")
def found(folder: Path, recording: Path) -> Ordering:
    return ordering.ordering(folder, [recording], CAMERA, learned=6, judged=2)


def test_what_is_found(found: Ordering) -> None:
    assert found.tokens == 37 and found.stretches == (6, 2) and 0 < found.flops < 0.1
    assert [(row.size, row.way) for row in found.rows[:2]] == [(5, "difference"), (5, "chance")]
    assert len(found.rows) == 3 * len(WAYS)
    for size in (5, 10, 19):
        by_way = {row.way: row for row in found.rows if row.size == size}
        first = by_way["difference"]
        assert first.less == (0, 0, 0)
        assert by_way["importance"].less[0] == pytest.approx(1 - by_way["importance"].error / first.error)
        assert by_way["chance"].error > first.error
        assert all(row.less[1] <= row.less[0] <= row.less[2] for row in by_way.values())


def test_what_it_prints(found: Ordering, folder: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {}

    def measured(*given: Any, **named: Any) -> Ordering:
        told.update(named, camera=given[2])
        return found

    monkeypatch.setattr(ordering, "ordering", measured)
    asked = [
        str(folder),
        "-t",
        str(recording),
        "--camera",
        CAMERA,
        "--ways",
        "head,merged",
        "--judged",
        "3",
        "--eighths",
        "1,6",
    ]
    result = CliRunner().invoke(ordering.main, asked, catch_exceptions=False)
    assert result.exit_code == 0 and told["ways"] == ["head", "merged"]
    assert (told["camera"], told["judged"], told["eighths"]) == (CAMERA, 3, [1, 6])
    printed = " ".join(result.stdout.split())
    assert "5 of 37" in printed and "the last 2 of 3 consecutive calls" in printed and CALLS == 3
    assert '"rows"' in CliRunner().invoke(ordering.main, [*asked, "--json"], catch_exceptions=False).stdout
    refused = CliRunner().invoke(ordering.main, [*asked, "--ways", "luck"])
    assert refused.exit_code == 2 and "found luck" in refused.output
    for wrong in ("2,8", "12", "1,"):
        refused = CliRunner().invoke(ordering.main, [*asked, "--eighths", wrong])
        assert refused.exit_code == 2 and f"numbers from 1 to 7; found '{wrong}'" in refused.output


def test_what_cannot_be_measured_is_refused(once: Once, folder: Path, recording: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="expected one of left, right; found 'up'"):
        ordering.ordering(folder, [recording], "up")
    other = policies.compiled(once)
    with pytest.raises(CalibrationError, match="one image encoder whose tokens can be reused; this one has 0"):
        ordering.ordering(other, [policies.record(tmp_path / "calls.npz", 4)], CAMERA)
    with np.load(recording) as data:
        short = {**data, "episode_ends": np.arange(2, 33, 2)}
    np.savez(tmp_path / "short.npz", **short)
    with pytest.raises(CalibrationError, match="two episodes of 3 calls at least; found 0"):
        ordering.ordering(folder, [tmp_path / "short.npz"], CAMERA)
