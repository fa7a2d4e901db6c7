"""The adapter sees and does what the demonstrations' environment saw and did."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from environments.disturbed.pusht import GOALS, PushTLong
from environments.pusht import KEYPOINTS, PushT, keypoints, observation, place
from environments.pusht_pixels import SIZE, PushTPixels


@pytest.fixture(scope="session")
def demonstrations(shared: Path) -> dict[str, np.ndarray]:
    with np.load(shared / "data" / "pusht_demonstrations.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def test_keypoints_turn_and_move_with_the_block() -> None:
    quarter = keypoints([100.0, 200.0], np.pi / 2)
    np.testing.assert_allclose(quarter, np.stack([100 - KEYPOINTS[:, 1], 200 + KEYPOINTS[:, 0]], axis=-1))


def test_embedded_keypoints_are_the_published_ones(shared: Path) -> None:
    published = np.load(shared / "data" / "pusht_keypoints_local.npy", allow_pickle=False)
    np.testing.assert_allclose(KEYPOINTS, published, rtol=1e-7)


def test_keypoints_are_those_of_the_demonstrations(demonstrations: dict[str, np.ndarray]) -> None:
    state = demonstrations["state"].astype(np.float64)
    error = np.abs(keypoints(state[:, 2:4], state[:, 4]) - demonstrations["keypoint"]).max(axis=(1, 2))
    # 58 of the 25,650 frames, where the block is pressed into a wall or the agent, were recorded with keypoints of
    # another pose than their state's.
    assert np.count_nonzero(error > 0.1) == 58
    assert error.max() < 2.1


def test_every_demonstrated_keypoint_set_is_a_rigid_motion_of_ours(demonstrations: dict[str, np.ndarray]) -> None:
    world = demonstrations["keypoint"].astype(np.float64)
    centred = world - world.mean(axis=1, keepdims=True)
    local = KEYPOINTS - KEYPOINTS.mean(axis=0)
    # The best angle in the plane: atan2 of the summed cross and dot products.
    cross = (local[:, 0] * centred[..., 1] - local[:, 1] * centred[..., 0]).sum(axis=1)
    dot = (local * centred).sum(axis=(1, 2))
    turned = keypoints(np.zeros((len(world), 2)), np.arctan2(cross, dot))
    residual = turned - turned.mean(axis=1, keepdims=True) - centred
    assert np.abs(residual).max() < 0.1


def test_observation_is_keypoints_then_agent() -> None:
    state = [10.0, 20.0, 100.0, 200.0, 0.0]
    seen = observation(state)
    assert seen.shape == (20,)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:2], [100 + 9.268611, 200 + 90.022804], rtol=1e-6)
    np.testing.assert_array_equal(seen[18:], [10, 20])
    np.testing.assert_array_equal(observation([state, state]), [seen, seen])


def test_placed_block_has_its_vertices_where_the_state_says() -> None:
    environment = PushT()
    environment.reset(seed=0)
    world = environment._gym.unwrapped
    place(world, [30.0, 40.0, 200.0, 300.0, np.pi / 2])
    # A quarter turn takes the stem's end (15, 120) to (-120, 15).
    corners = [tuple(world.block.local_to_world(v)) for shape in world.block.shapes for v in shape.get_vertices()]
    assert any(np.allclose(corner, (200 - 120, 300 + 15)) for corner in corners)
    np.testing.assert_allclose(world.get_obs(), np.array([30, 40, 200, 300, np.pi / 2]))


def test_keypoints_lie_on_the_block_of_the_simulator() -> None:
    environment = PushT()
    environment.reset(seed=3)
    world = environment._gym.unwrapped
    for point in keypoints(world.block.position, world.block.angle):
        # They were picked from a drawing with a border: up to 3 px outside.
        assert min(shape.point_query(tuple(point)).distance for shape in world.block.shapes) < 3


def test_the_quick_simulator_has_the_numbers_of_gym_pusht() -> None:
    """States to the bit; a coverage up to the order in which areas are summed, which a set of shapes leaves open."""
    environment, original = PushT(), gymnasium.make("gym_pusht/PushT-v0", obs_type="state")
    environment.reset(seed=5, state=[200.0, 300.0, 260.0, 250.0, 0.7])
    original.reset(seed=5)
    place(original.unwrapped, [200.0, 300.0, 260.0, 250.0, 0.7])
    draw, best = np.random.default_rng(0), 0.0
    for target in np.repeat(draw.uniform(150, 350, (20, 2)), 5, axis=0):
        environment.step(target)
        state, _, _, _, info = original.step(target)
        best = max(best, info["coverage"])
        np.testing.assert_array_equal(environment.state, state)
        assert environment.coverage == pytest.approx(best, abs=1e-12)
    assert 0.2 < best < 0.95


def replay_error(states: np.ndarray, actions: np.ndarray) -> tuple[float, float, float]:
    """Worst differences of agent (px), block (px) and angle over one replayed demonstration."""
    environment = PushT()
    environment.reset(seed=0, state=states[0])
    reached = [environment.state]
    for action in actions[:-1]:
        environment.step(action)
        reached.append(environment.state)
    error = np.abs(np.stack(reached) - states)
    error[:, 4] = np.minimum(error[:, 4], 2 * np.pi - error[:, 4])
    return error[:, :2].max(), error[:, 2:4].max(), error[:, 4].max()


def test_demonstrated_actions_lead_to_the_demonstrated_states(demonstrations: dict[str, np.ndarray]) -> None:
    ends = demonstrations["episode_ends"]
    errors = []
    for episode in range(0, len(ends), 15):
        rows = slice(ends[episode - 1] if episode else 0, ends[episode])
        errors.append(replay_error(demonstrations["state"][rows].astype(np.float64), demonstrations["action"][rows]))
    agent, block, angle = np.array(errors).T
    assert len(errors) == 14
    assert agent.max() < 1e-3
    # The solver's memory of contacts is not part of the state: an episode that starts in touch is off by a little.
    assert np.count_nonzero(block < 1e-3) >= 10
    assert np.count_nonzero(angle < 1e-4) >= 10
    assert block.max() < 1
    assert angle.max() < 0.01


def test_an_episode_ends_after_the_original_number_of_steps() -> None:
    environment, steps = PushT(), 0
    environment.reset(seed=0)
    while not environment.done:
        environment.step(environment.rest())
        steps += 1
    assert steps == environment.max_steps == 300


def test_the_score_is_the_best_coverage_as_a_share_of_what_counts_as_success() -> None:
    environment = PushT()
    environment.reset(seed=0, state=[60.0, 60.0, 256.0, 256.0, np.pi / 4])
    environment.step([60.0, 60.0])
    assert environment.done
    assert environment.success
    assert environment.measures["best coverage"] == pytest.approx(1.0)
    assert environment.score == 1.0
    environment.reset(seed=0, state=[60.0, 60.0, 256.0, 306.0, np.pi / 4])
    environment.step([60.0, 60.0])
    first = environment.measures["best coverage"]
    assert environment.score == pytest.approx(first / 0.95)
    assert 0.1 < environment.score < 1
    assert not environment.done
    for number in range(10):  # pushed away
        environment.step([256.0, 200.0 + 30 * number])
    assert environment.measures["best coverage"] >= first


def test_picture_shows_agent_block_and_target_where_they_are() -> None:
    environment = PushT()
    environment.reset(seed=0, state=[100.0, 400.0, 300.0, 200.0, 0.0])
    assert environment.picture().shape == (512, 512, 3)
    environment.step([450.0, 60.0])
    picture = environment.picture().astype(int)
    x, y = environment.rest().round().astype(int)
    agent, block, target, nothing = picture[y, x], picture[215, 300], picture[60, 450], picture[450, 450]
    assert agent[2] > agent[0] + 80  # royal blue
    np.testing.assert_allclose(block, [119, 136, 153], atol=40)  # light slate grey
    assert target[0] > target[1] + 100  # red
    assert nothing.min() > 240


def test_pixels_are_what_gym_pusht_observes() -> None:
    import gymnasium

    environment = PushTPixels()
    environment.reset(seed=4)
    size = {"observation_width": SIZE, "observation_height": SIZE}
    theirs = gymnasium.make("gym_pusht/PushT-v0", obs_type="pixels_agent_pos", disable_env_checker=True, **size)
    theirs.reset(seed=4)
    for _ in range(3):
        environment.step(np.array([100.0, 200.0]))
        seen = theirs.step(np.array([100.0, 200.0]))[0]
    frame = environment.observe()
    assert frame["observation.image"].shape == (3, 64, 64)
    np.testing.assert_array_equal(np.round(frame["observation.image"] * 255), np.moveaxis(seen["pixels"], -1, 0))
    np.testing.assert_allclose(frame["observation.state"], seen["agent_pos"], rtol=1e-6)
    assert environment.title != PushT.title


def test_a_long_episode_puts_the_block_elsewhere_where_its_goal_is_reached() -> None:
    """Begun with the block on the goal: one of five is earned at once, and the agent stays where it was."""
    environment = PushTLong()
    environment.reset(3, [100.0, 100.0, 256.0, 256.0, np.pi / 4])
    before = environment.state[2:].copy()
    environment.step(np.array([100.0, 100.0]))
    assert (environment.score, environment.measures) == (1 / GOALS, {"goals": 1.0})
    assert not environment.done and not environment.success
    assert np.abs(environment.state[2:4] - before[:2]).max() > 1, "the block is elsewhere"
    np.testing.assert_allclose(environment.state[:2], 100, atol=5)
    for _ in range(PushT.max_steps):
        environment.step(np.array([100.0, 100.0]))
    assert environment.measures == {"goals": 1.0}, "the second was in vain"
    assert 1 / GOALS <= environment.score < 2 / GOALS


def test_all_goals_are_a_success(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it is put, it is on the goal."""
    monkeypatch.setattr(PushT, "success", property(lambda self: True))
    monkeypatch.setattr(PushT, "score", property(lambda self: 1.0))
    environment = PushTLong()
    environment.reset(0)
    monkeypatch.setattr(PushT, "step", lambda self, action: setattr(self, "done", True))
    for goals in range(1, GOALS + 1):
        assert not environment.done and not environment.success
        environment.step(environment.rest())
        assert environment.measures == {"goals": goals}
        assert environment.score == min(goals + 1, GOALS) / GOALS, "the next one counts at once, too"
    assert environment.done and environment.success
