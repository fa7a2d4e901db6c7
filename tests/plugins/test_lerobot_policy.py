"""A compiled policy in LeRobot's own commands, against the original there. Runs where lerobot is installed."""

import json
import logging
import os
import pickle
import shutil
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile

from ..runtimes import committed
from ..runtimes.committed import LONGEST
from .lerobot_saved import DA, DS, ENVIRONMENT, PIXELS, SETTINGS, STATE, save

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # lerobot's and its packages' own
    pytest.mark.skipif(
        find_spec("lerobot") is None or find_spec("lerobot_policy_ttscompile") is None,
        reason="lerobot and plugins/lerobot_policy_ttscompile are not installed: run 'make test-lerobot'",
    ),
]
ROOT = Path(__file__).resolve().parents[2]
NO_REAL_TIME = {"diffusion": "it observes several frames", "act": "does not give the noise level of each step"}
"""Why a case has no real-time chunking."""


@pytest.fixture(scope="module", params=SETTINGS)
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """A case, the directory that lerobot saved, and the compiled policy."""
    folder = tmp_path_factory.mktemp("lerobot")
    directory = save(request.param, folder)
    ttscompile.convert(directory, folder / "compiled")
    return request.param, directory, folder / "compiled"


def opened(directory: Path) -> tuple[Any, Any, Any]:
    """Policy, preprocessor and postprocessor, as lerobot-eval opens ``--policy.path``."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(directory)
    policy = get_policy_class(config.type).from_pretrained(directory, config=config).eval()
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    before, after = make_pre_post_processors(config, str(directory), preprocessor_overrides=overrides)
    return policy, before, after


def frame(tick: int, policy: Any, streams: int = 2) -> dict[str, Any]:
    """What an environment measures."""
    rng = np.random.default_rng(tick)
    task = ["push the block", "pull it"][tick // 10 % 2]
    shapes = {STATE: (DS,), ENVIRONMENT: (3,)}
    found: dict[str, Any] = {"task": [task] * streams}
    for key in policy.config.input_features:
        drawn = (
            rng.standard_normal((streams, *shapes[key])) if key in shapes else rng.random((streams, 3, PIXELS, PIXELS))
        )
        found[key] = torch.tensor(drawn, dtype=torch.float32)
    return found


def driven(directory: Path) -> np.ndarray:
    """The actions of two episodes of ten ticks, by lerobot-eval's own order of calls."""
    policy, before, after = opened(directory)
    torch.manual_seed(0)
    actions = []
    for tick in range(20):
        if tick % 10 == 0:
            policy.reset()
        with torch.inference_mode():
            actions.append(after(policy.select_action(before(frame(tick, policy)))))
    return torch.stack(actions).numpy()


def test_the_compiled_policy_acts_as_the_original_does(saved: tuple[str, Path, Path]) -> None:
    """From the environment's frames and the same seed, over chunks, episodes, streams and instructions."""
    _, original, compiled = saved
    expected, found = driven(original), driven(compiled)
    assert np.ptp(expected) > 0.3 and found.shape == (20, 2, DA)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_a_chunk_is_the_originals_for_the_same_noise(saved: tuple[str, Path, Path]) -> None:
    case, original, compiled = saved
    if "one frame" not in case:
        pytest.skip("the original takes no noise, or its frames from a queue that select_action alone fills")
    chunks, noise = [], torch.randn(1, 8, DA, generator=torch.Generator().manual_seed(3))
    for directory in (original, compiled):
        policy, before, after = opened(directory)
        batch = before(frame(1, policy, streams=1))
        if directory == original:  # which takes windows here
            batch = {key: value[:, None] if key.startswith("observation.") else value for key, value in batch.items()}
        torch.manual_seed(7)
        with torch.inference_mode():
            chunks.append(after(policy.predict_action_chunk(batch, noise)).numpy())
    assert chunks[1].shape == (1, 4, DA)
    np.testing.assert_allclose(chunks[1], chunks[0], rtol=0, atol=1e-5 * np.abs(chunks[0]).max())


def test_committed_actions_are_kept_and_padding_is_none(
    saved: tuple[str, Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    """As lerobot's real-time chunking calls it: what is left of a chunk, cut or padded with zeros to a fixed length."""
    from lerobot.rollout.inference.rtc import supports_rtc_inference

    case, _, compiled = saved
    policy, before, _ = opened(compiled)
    with caplog.at_level(logging.WARNING):
        assert supports_rtc_inference(policy) == (case not in NO_REAL_TIME)
    assert all((why in caplog.text) == (case == one) for one, why in NO_REAL_TIME.items())
    if case == "act":  # whose next chunk cannot be joined to anything
        return
    batch, noise = before(frame(0, policy, streams=1)), torch.randn(1, 8, DA)
    free = policy.predict_action_chunk(batch, noise)
    left_over = torch.cat([free[0, 1:] + 0.05, torch.zeros(3, DA)])

    def chunk(delay: int | None, rest: torch.Tensor | None) -> torch.Tensor:
        torch.manual_seed(0)
        policy.reset()
        return policy.predict_action_chunk(batch, noise, inference_delay=delay, prev_chunk_left_over=rest)

    without = chunk(None, None)
    for delay, rest in ((0, left_over), (2, None), (2, left_over[3:])):
        assert torch.equal(chunk(delay, rest), without), "nothing is committed"
    joined = chunk(2, left_over)
    torch.testing.assert_close(joined[0, :2], left_over[:2], rtol=1e-5, atol=1e-5)
    assert not torch.allclose(joined[0, 2:], without[0, 2:])
    assert torch.equal(chunk(5, left_over), chunk(3, left_over)), "no more is left over"


def test_it_is_saved_as_it_is_and_not_trained(saved: tuple[str, Path, Path], tmp_path: Path) -> None:
    from lerobot.policies.factory import make_policy_config

    _, _, compiled = saved
    policy, _, _ = opened(compiled)
    policy.config.threads = 2
    policy.save_pretrained(tmp_path / "copy")
    again, _, _ = opened(tmp_path / "copy")
    assert again.config.threads == 2 and again._policy.info.identity == policy._policy.info.identity
    with pytest.raises(NotImplementedError, match="train the original"):
        policy.forward({})
    with pytest.raises(ValueError, match=r"not made from scratch.*--policy.path"):
        type(policy)(make_policy_config("ttscompile", device="cpu"))
    config = json.loads((tmp_path / "copy" / "config.json").read_text())
    config["input_features"]["observation.more"] = {"type": "STATE", "shape": [1]}
    (tmp_path / "copy" / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"observes \[.*'observation.more'.*convert the checkpoint again"):
        opened(tmp_path / "copy")


def test_an_older_configuration_has_its_precision_in_the_name_of_the_plan(
    saved: tuple[str, Path, Path], tmp_path: Path
) -> None:
    _, _, compiled = saved
    copy = Path(shutil.copytree(compiled, tmp_path / "copy"))
    config = json.loads((copy / "config.json").read_text())
    for plan, found in ((None, "dense@fp32"), ("dense@fp32", "dense@fp32@fp32")):
        (copy / "config.json").write_text(json.dumps({**config, "plan": plan, "precision": "fp32"}))
        if plan is None:
            policy, _, _ = opened(copy)
            assert (policy.config.plan, policy.config.precision) == (found, None)
            assert policy._policy.info.default_plan == found
        else:
            with pytest.raises(ttscompile.errors.IllegalPlanError, match=f"no plan {found!r}"):
                opened(copy)


def test_of_a_repository_an_artifact_s_files_are_downloaded(
    saved: tuple[str, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub
    from huggingface_hub.utils import filter_repo_objects  # type: ignore[attr-defined]  # it has no __all__

    _, _, compiled = saved
    policy, _, _ = opened(compiled)
    asked: list[dict[str, Any]] = []

    def download(_: str, **words: Any) -> str:
        asked.append(words)
        return str(compiled)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    again = type(policy).from_pretrained("org/name", config=policy.config, revision="main")
    assert again._policy.info.identity == policy._policy.info.identity and asked[0].pop("revision") == "main"
    own = {each.name for each in compiled.iterdir()}
    others = {"README.md", "video.mp4", "pytorch_model.bin", "code.py", "old/manifest.json", "old/weights.safetensors"}
    assert set(filter_repo_objects([*own, *others], **asked[0])) == own


def command(name: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run one of lerobot's commands, as a shell would."""
    words = [sys.executable, "-W", "ignore", "-m", name, *options]
    env = {**os.environ, "SDL_VIDEODRIVER": "dummy", "HF_HUB_OFFLINE": "1"}
    return subprocess.run(words, capture_output=True, text=True, env=env, cwd=ROOT, timeout=600)


def test_lerobot_eval_runs_it(saved: tuple[str, Path, Path], tmp_path: Path) -> None:
    case, _, compiled = saved
    if case != "diffusion" or find_spec("gym_pusht") is None:
        pytest.skip("Push-T takes the policy that observes its image and state")
    run = ["--env.episode_length=10", "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false"]
    options = [f"--policy.path={compiled}/", "--env.type=pusht", *run, f"--output_dir={tmp_path / 'out'}"]
    result = command("lerobot.scripts.lerobot_eval", *options, "--policy.threads=2")
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


@pytest.mark.parametrize("inference", ["sync", "rtc"])
def test_lerobot_rollout_runs_it(saved: tuple[str, Path, Path], tmp_path: Path, inference: str) -> None:
    """On a robot that writes down what it is sent."""
    case, _, compiled = saved
    if case != "multi_task_dit":
        pytest.skip("the robot measures what the other policy observes")
    sent = tmp_path / "sent.txt"
    robot = ["--robot.type=still_robot", f"--robot.log={sent}", "--return_to_initial_position=false"]
    run = ["--task=push the block", "--fps=10", "--duration=2", f"--inference.type={inference}", "--play_sounds=false"]
    if inference == "rtc":
        run += ["--inference.queue_threshold=2", "--inference.rtc.execution_horizon=4"]
    result = command("tests.plugins.still_robot", f"--policy.path={compiled}", *robot, *run)
    assert result.returncode == 0, result.stderr
    actions = np.loadtxt(sent, ndmin=2)
    assert len(actions) > 5 and actions.shape[1] == DA and np.isfinite(actions).all()


@pytest.mark.parametrize("inference", ["sync", "rtc"])
def test_a_robot_that_disappears_ends_the_rollout(
    saved: tuple[str, Path, Path], tmp_path: Path, inference: str
) -> None:
    """With its error, soon, and nothing is sent after that: no thread of the policy goes on."""
    case, _, compiled = saved
    if case != "multi_task_dit":
        pytest.skip("the robot measures what the other policy observes")
    sent = tmp_path / "sent.txt"
    robot = ["--robot.type=still_robot", f"--robot.log={sent}", "--robot.frames=8"]
    run = ["--task=push", "--fps=10", "--duration=500", f"--inference.type={inference}", "--play_sounds=false"]
    began = time.monotonic()
    result = command(
        "tests.plugins.still_robot",
        f"--policy.path={compiled}",
        "--policy.threads=2",
        "--return_to_initial_position=false",
        *robot,
        *run,
    )
    assert time.monotonic() - began < 300, "it went on without a robot"
    assert result.returncode != 0
    assert "the robot does not answer any more" in result.stderr
    actions = np.loadtxt(sent, ndmin=2)
    assert 0 < len(actions) <= 8 and np.isfinite(actions).all()


def test_the_policy_server_takes_it(
    saved: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a client sends first, and then the work on its observations."""
    if find_spec("grpc") is None:
        pytest.skip("lerobot's server takes grpc: lerobot[async]")
    monkeypatch.chdir(tmp_path)  # where it makes a folder logs
    from lerobot.async_inference import policy_server
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import RemotePolicyConfig
    from lerobot.transport import services_pb2
    from lerobot_policy_ttscompile.policy_server import allow

    allow()
    _, _, compiled = saved
    server = policy_server.PolicyServer(PolicyServerConfig())
    server.shutdown_event.clear()
    context = SimpleNamespace(peer=lambda: "robot")
    specs = RemotePolicyConfig("ttscompile", str(compiled), {}, actions_per_chunk=3)
    server.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(specs)), context)
    batch = server.preprocessor(frame(0, server.policy, streams=1))
    assert server._get_action_chunk(batch).shape == (1, 3, DA)


def test_in_shadow_mode_the_original_acts_and_the_log_says_how_far_the_compiled_one_is(
    saved: tuple[str, Path, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same generator both have the same noise, so the differences are those of rounding."""
    _, original, compiled = saved
    at_exit: list[Any] = []
    registry = SimpleNamespace(register=lambda *given: at_exit.append(partial(*given)))
    monkeypatch.setattr("lerobot_policy_ttscompile.modeling_ttscompile.atexit", registry)
    copy = Path(shutil.copytree(compiled, tmp_path / "copy"))
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "original": str(original)}))
    expected = driven(original)
    with caplog.at_level(logging.WARNING):
        found = driven(copy)
        at_exit[0]()
    np.testing.assert_array_equal(found, expected)
    policy, _, _ = opened(copy)
    assert not policy.supports_rtc()
    assert "shadow: 20 of 20 calls compared, 0 dropped, 0 failed, " in caplog.text
    worst = float(caplog.text.split("worst call ")[-1].split(": ")[1].split()[0])
    assert worst < 1e-4 * np.abs(expected).max()


def test_of_a_longer_prefix_than_a_policy_was_trained_with_it_is_told_of_as_much_and_the_log_of_the_rest(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As lerobot's own loop does it with ``--inference.rtc.mode=trained``, which its releases do not know yet."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot_policy_ttscompile.configuration_ttscompile import TtscompileConfig
    from lerobot_policy_ttscompile.modeling_ttscompile import TtscompilePolicy

    committed.compiled("rk4", tmp_path / "compiled")
    observed = {"obs": PolicyFeature(FeatureType.STATE, (4,))}
    policy = TtscompilePolicy(TtscompileConfig(input_features=observed, device="cpu"), tmp_path / "compiled")
    assert policy.supports_rtc()
    batch, noise = {"obs": torch.ones(1, 4)}, torch.randn(1, committed.HORIZON, committed.CHANNELS)
    left_over = torch.rand(1, LONGEST + 1, committed.ACTIONS)
    chunks = []
    for delay in (LONGEST - 1, LONGEST, LONGEST + 1):
        chunks.append(policy.predict_action_chunk(batch, noise, delay, left_over))
        policy.reset()
        assert ("4 actions are executed meanwhile; the policy was trained to go on from 3" in caplog.text) == (
            delay == 4
        )
    assert torch.equal(chunks[2], chunks[1]) and not torch.equal(chunks[1], chunks[0])
    torch.testing.assert_close(chunks[2][:, :LONGEST], left_over[:, :LONGEST])


def test_lerobots_of_other_series_are_refused_in_one_sentence(caplog: pytest.LogCaptureFixture) -> None:
    from lerobot_policy_ttscompile.versions import TRIED, require_lerobot

    with caplog.at_level(logging.WARNING):
        require_lerobot()
        require_lerobot(TRIED)
    assert "was tried with" not in caplog.text
    require_lerobot("0.6.2")
    assert "was tried with lerobot 0.6.1, and this is 0.6.2" in caplog.text
    for found in ("0.5.1", "0.7.0", "unknown"):
        with pytest.raises(ImportError, match=f"tried with lerobot 0.6.1, and found {found}: install"):
            require_lerobot(found)


def test_without_the_asynchronous_server_the_rest_works_and_the_server_says_so(saved: tuple[str, Path, Path]) -> None:
    """As in a LeRobot that has none any more."""
    _, _, compiled = saved
    without = "import sys; sys.modules['lerobot.async_inference'] = None\n"
    opens = (
        "from tests.plugins.test_lerobot_policy import opened; from pathlib import Path; opened(Path(sys.argv[1]))\n"
    )
    serves = "from lerobot_policy_ttscompile.policy_server import main; main()"
    words = [sys.executable, "-W", "ignore", "-c", without + opens + serves, str(compiled)]
    result = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, timeout=600)
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.splitlines() if line.startswith(("error:", "Traceback"))]
    assert len(lines) == 1 and "no asynchronous policy server" in lines[0] and "ttscompile serve" in lines[0]
