"""Episodes that are kept on disk."""

import numpy as np
import pytest
from episodes import Episodes
from rollout import Episode, NoiseShape, run_episodes
from variants import Variant


class Info:
    model_identity, identity, precision, default_plan = "m" * 64, "i" * 64, "fp32", "schedule"


class Policy:
    """Counts its calls; moves nowhere."""

    info = Info()
    last_report = None
    calls = 0

    def reset(self):
        pass

    def predict_action(self, obs_dict, noise=None, plan=None):
        self.calls += 1
        return {"action": np.full((len(obs_dict["obs"]), 8, 2), 256.0, np.float32)}


SHAPE = NoiseShape(2, (16, 2), False)


def variant(plan=None, **changes):
    policy = Policy()
    policy.info = type("Changed", (Info,), changes)()
    return Variant("v", policy, plan, SHAPE)


def episode(seed=7):
    draw = np.random.default_rng(seed)
    return Episode(
        seed,
        draw.random((3, 2, 20), np.float32),
        draw.random((9, 5)),
        draw.random((8, 2)),
        draw.random(8),
        (0.95, 0.9, 1.0),
        (1.5, 2.5, 3.5),
        (0, 2, 0),
    )


def test_an_episode_is_read_as_it_was_written(tmp_path):
    cache = Episodes(tmp_path, variant(), "onnxruntime")
    assert cache.read(7) is None
    cache.write(episode())
    again = cache.read(7)
    assert (again.seed, again.sparsity, again.flops, again.legalised) == (
        7,
        (0.95, 0.9, 1.0),
        (1.5, 2.5, 3.5),
        (0, 2, 0),
    )
    for name in ("windows", "states", "targets", "coverages"):
        np.testing.assert_array_equal(getattr(again, name), getattr(episode(), name))
    assert cache.read(8) is None


@pytest.mark.parametrize(
    ("plan", "changes", "found"),
    [
        (None, {}, True),
        ("schedule", {}, True),
        ("dense", {}, False),
        ("fast", {}, False),
        (None, {"identity": "j" * 64}, False),
        (None, {"precision": "int8"}, False),
    ],
)
def test_only_what_computes_the_same_finds_it(tmp_path, plan, changes, found):
    Episodes(tmp_path, variant(), "onnxruntime").write(episode())
    assert (Episodes(tmp_path, variant(plan, **changes), "onnxruntime").read(7) is not None) == found
    assert Episodes(tmp_path, variant(plan, **changes), "reference").read(7) is None


def test_calibration_does_not_change_the_dense_policy(tmp_path):
    Episodes(tmp_path, variant("dense"), "onnxruntime").write(episode())
    assert Episodes(tmp_path, variant("dense", identity="j" * 64), "onnxruntime").read(7) is not None
    assert Episodes(tmp_path, variant("dense", model_identity="n" * 64), "onnxruntime").read(7) is None


def test_a_damaged_file_is_as_good_as_none(tmp_path):
    cache = Episodes(tmp_path, variant(), "onnxruntime")
    cache.write(episode())
    (file,) = tmp_path.glob("*/7.npz")
    file.write_bytes(file.read_bytes()[:100])
    assert cache.read(7) is None


def test_kept_episodes_are_not_run_again(tmp_path):
    one = variant()
    first = run_episodes(one.policy, [1, 2], SHAPE, 2, cache=Episodes(tmp_path, one, "onnxruntime"))
    calls = one.policy.calls
    done = []
    more = run_episodes(one.policy, [2, 3, 1], SHAPE, 2, None, done.append, Episodes(tmp_path, one, "onnxruntime"))
    assert [e.seed for e in more.episodes] == [2, 3, 1]
    assert 0 < one.policy.calls - calls <= calls
    np.testing.assert_array_equal(more.episodes[2].states, first.episodes[0].states)
    assert done[-1] == 3
