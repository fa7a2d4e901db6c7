"""Octo from the folder that its authors' code saved, to the actions of Octo 241fb35; see ``octos.py``."""

import builtins
import struct
import warnings
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import ttscompile
from tests.families.checks import kinds
from tests.families.support import record, stored_program
from tests.serving.serving import ServerError, connected, listening
from ttscompile.artifact import load_artifact
from ttscompile.cli import main
from ttscompile.core.spec import Noise
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions, find_family
from ttscompile.policies import flax_files, octo, octo_loop
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.executor_server import ExecutorServer

from .authors import by_one_command
from .octos import CHECKPOINT, MASK, TOKENS, WINDOW, actions, change, noise, shown, unpack
from .refused import Refusals, assert_not_read, refusals
from .whole_vlas import assert_refused

CASES = [("two", "all"), ("two", "start"), ("two", "primary"), ("one", "all")]
"""Two frames of two cameras; the first call of an episode; without the wrist's; one frame of one camera."""
ALLOWED = 1e-4


def options(case: str) -> LoadOptions:
    """A camera that is missing is left out."""
    return LoadOptions(without_cameras=["image_wrist"] if case == "primary" else None)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack(tmp_path_factory.mktemp("octo"))


@pytest.mark.parametrize(("model", "case"), CASES)
def test_the_rebuilt_network_acts_as_the_original(saved: Path, model: str, case: str) -> None:
    module, spec = load_checkpoint_policy(saved / model, options=options(case))
    seen = {key: torch.from_numpy(shown(model, case)[key]) for key in spec.observations}
    found = eager_policy(module, spec)(seen, noise(model, case)).numpy()
    assert np.abs(spec.chunk.unnormalized(found) - actions(model, case)).max() < ALLOWED
    assert (WINDOW in spec.observations) == (model == "two")
    assert find_family(saved / model, "auto").name == find_family(saved / model, "octo").name == "octo"


def test_a_masked_camera_is_as_one_that_is_not_there() -> None:
    """In the original, whose ``pad_mask_dict`` the policy therefore need not observe."""
    assert np.abs(actions("two", "masked") - actions("two", "primary")).max() < 1e-5
    assert np.abs(actions("two", "masked") - actions("two", "all")).max() > 100 * ALLOWED


@pytest.fixture(scope="module")
def compiled(saved: Path) -> Path:
    """By one command."""
    return by_one_command(saved / "two")


@pytest.fixture(scope="module")
def of_one_frame(saved: Path) -> Path:
    ttscompile.convert(saved / "one", saved / "compiled-one")
    return saved / "compiled-one"


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_the_compiled_policy_acts_as_the_original(compiled: Path, runtime: str) -> None:
    """From images and words to the robot's actions; a padded frame counts for nothing."""
    policy = ttscompile.load(compiled, runtime=runtime)
    for case in ("all", "start"):
        made = policy.predict_action(shown("two", case), noise=noise("two", case), plan="dense")["action"]
        assert np.abs(made - actions("two", case)).max() < ALLOWED
    assert np.abs(actions("two", "all") - actions("two", "start")).max() > 100 * ALLOWED


@pytest.mark.slow
def test_what_is_found_in_it(compiled: Path) -> None:
    """The head's three residual blocks; all that depends on the observation alone has left the loop."""
    program = stored_program(load_artifact(compiled))
    assert kinds(program) == {"feed_forward": 3}
    compared = "octo 241fb35 `sample_actions`, from raw images and words, 1e-4"
    record("Octo, whole, read from its folder", compared, "ddpm 20", program)


@pytest.mark.slow
def test_a_robot_gives_the_instruction_as_text(compiled: Path, saved: Path) -> None:
    policy = ttscompile.load(compiled, tokenizer=saved / "t5-base")
    seen = {key: value for key, value in shown("two", "all").items() if key not in (TOKENS, MASK)}
    texts = ["pick up the red cup", "place it on the table now and then on it again"]
    made = policy.predict_action({**seen, "task": texts}, noise=noise("two", "all"), plan="dense")["action"]
    assert np.abs(made - actions("two", "all")).max() < ALLOWED


@pytest.mark.slow
def test_a_client_of_the_executors_server_gives_the_instruction_as_text(of_one_frame: Path, saved: Path) -> None:
    """The actions are those of the tokens, and other words have others."""
    policy = ttscompile.load(of_one_frame, tokenizer=saved / "t5-base")
    image, texts = shown("one", "all")["image_primary"][0, 0], ("pick up the red cup", "place it on the table")
    tokens = policy.with_tokens({"image_primary": image, "task": texts[0]})
    frames = [tokens, *({"image_primary": image, "task": text} for text in texts)]
    limits, made = ServerLimits.of(policy.info.observation, 2), []
    with (
        AsyncExecutor(policy, 10, ExecutorSettings(max_hold=1000, refuse_infeasible=False)) as executor,
        listening(lambda: ExecutorServer(executor, limits)) as url,
        connected(url) as call,
    ):
        for frame in frames:
            call("reset", seed=0)
            call("observe", obs={key: value if key == "task" else value.tolist() for key, value in frame.items()})
            made.append(call("action", timeout=10.0)["action"])
        with pytest.raises(ServerError, match="ProtocolError: a task is a text; found int"):
            call("observe", obs={"image_primary": image.tolist(), "task": 3})
    assert made[0] == made[1] != made[2]


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_one_camera_of_two_and_a_task_that_is_compiled_in(saved: Path, runtime: str, tmp_path: Path) -> None:
    out = tmp_path / "compiled"
    ttscompile.convert(saved / "two", out, encoders=saved, without_cameras=["image_wrist"], task="pick up the red cup")
    policy = ttscompile.load(out, runtime=runtime)
    seen = {key: shown("two", "primary")[key][:1] for key in ("image_primary", WINDOW)}
    drawn = noise("two", "primary")
    own = Noise(drawn.initial[:1], None if drawn.steps is None else drawn.steps[:, :1])
    made = policy.predict_action(seen, noise=own, plan="dense")["action"]
    assert np.abs(made - actions("two", "primary")[:1]).max() < ALLOWED


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_one_frame_of_a_model_of_december(of_one_frame: Path, runtime: str) -> None:
    """Whose first token of each group reads what the group before may read."""
    policy = ttscompile.load(of_one_frame, runtime=runtime)
    seen = {key: shown("one", "all")[key] for key in ("image_primary", TOKENS, MASK)}
    made = policy.predict_action(seen, noise=noise("one", "all"), plan="dense")["action"]
    assert np.abs(made - actions("one", "all")).max() < ALLOWED


def test_the_loop_clips_what_it_gives_to_the_next_step() -> None:
    """The table, and what the denoiser does about it, against the original's step in float64."""
    betas, signal = octo_loop.schedule(20)
    table, rng = octo_loop.own_table(betas, signal, 5.0), np.random.default_rng(0)
    x = clipped = rng.standard_normal(400) * 6
    for k, t in enumerate(table.timesteps):
        noise, drawn = rng.standard_normal(400), rng.standard_normal(400)
        alpha, kept = 1 - float(betas[t]), float(signal[t])
        original = (clipped - (1 - alpha) / np.sqrt(1 - kept) * noise) / np.sqrt(alpha)
        original = np.clip(original + (t > 0) * np.sqrt(1 - alpha) * drawn, -5, 5)
        out = noise + (x - clipped) / np.sqrt(1 - kept)
        x0 = np.clip(table.sample_to_x0[k] * x + table.out_to_x0[k] * out, -5, 5)
        x = table.x0_to_next[k] * x0 + table.sample_to_next[k] * x + table.out_to_next[k] * out
        x = x + table.noise_to_next[k] * drawn
        clipped = np.clip(x, -5, 5)
        np.testing.assert_allclose(clipped, original, atol=2e-4)
    assert table.bound == 5 and (x == clipped).all() and (np.abs(clipped) == 5).any()


def test_other_samplers(saved: Path) -> None:
    asked = LoadOptions(sampler="ddim", steps=5, loops=(("dpmsolver++", 4), ("ddpm", 10)))
    spec = load_checkpoint_policy(saved / "one", options=asked)[1]
    assert (spec.sampler.name, spec.sampler.steps) == ("ddpm", 20)
    assert list(spec.loops) == ["ddim-5", "dpmsolver++-4", "ddpm-10"]
    assert spec.loops["ddim-5"].clip == 5


def test_whose_actions(saved: Path, tmp_path: Path) -> None:
    """One data set, by its name or without one; of several nobody knows which."""
    folder = unpack(tmp_path) / "one"
    assert load_checkpoint_policy(folder)[1].source["statistics"] == "toy"
    path = folder / "dataset_statistics.json"
    change(path, lambda entries: entries.update(entries.pop("toy")))
    normalizer = load_checkpoint_policy(folder)[1].chunk.normalizer
    assert normalizer is not None
    np.testing.assert_allclose(normalizer.unnormalize(np.ones(3, np.float32)), [0.4, 1.3, 1.0], rtol=1e-6)
    change(path, lambda entries: entries.update(a={"action": entries.pop("action")}, b={}))
    with pytest.warns(UserWarning, match="holds 4 data sets .*actions have mean 0 and deviation 1"):
        assert load_checkpoint_policy(folder)[1].chunk.normalizer is None
    path.write_text("null")  # which Octo writes of a model without statistics
    with pytest.warns(UserWarning, match=r"holds 0 data sets \(none\): actions have mean 0 and deviation 1"):
        assert load_checkpoint_policy(folder)[1].chunk.normalizer is None
    path.unlink()
    with pytest.warns(UserWarning, match="is not there"):
        load_checkpoint_policy(folder)


def test_depth_images_are_floats_that_the_original_takes_for_pixels(tmp_path: Path) -> None:
    """It divides whatever a tokenizer stacks by 127.5, so pixels in the place of a depth image act as pixels do."""
    folder = unpack(tmp_path) / "one"
    example = folder / "example_batch.msgpack"
    batch = msgpack.unpackb(example.read_bytes())
    batch["observation"]["depth_primary"] = batch["observation"].pop("image_primary")
    example.write_bytes(msgpack.packb(batch))
    entry = ("model", "observation_tokenizers", "primary", "kwargs")
    change(folder / "config.json", lambda entries: reduce(getitem, entry, entries).pop("obs_stack_keys"))
    module, spec = load_checkpoint_policy(folder)
    seen = {key: torch.from_numpy(shown("one", "all")[key]) for key in (TOKENS, MASK)}
    seen["depth_primary"] = 255 * torch.from_numpy(shown("one", "all")["image_primary"])
    assert list(spec.observations) == ["depth_primary", TOKENS, MASK]
    assert spec.observations["depth_primary"].bounds is None
    found = eager_policy(module, spec)(seen, noise("one", "all")).numpy()
    assert np.abs(spec.chunk.unnormalized(found) - actions("one", "all")).max() < ALLOWED


REFUSED: Refusals = {
    "config.json/model/heads/action": [
        ({"name": "L1ActionHead"}, r"heads\.action is a L1ActionHead; expected DiffusionActionHead: another is"),
        ({"name": "UNetDDPMActionHead"}, r"action is a UNetDDPMActionHead; .*compile_denoiser"),
        ({"args": [3]}, "args is .3.; expected arguments by name"),
    ],
    "config.json/model/heads/action/kwargs": [
        ({"use_map": True}, r"use_map is True; expected false: another is not rebuilt here\. Build the network"),
        ({"readout_key": "obs"}, r"readout_key is 'obs'; expected readout_action"),
        ({"max_action": 0}, "max_action is 0; expected a positive number"),
        ({"time_dim": 7}, "time_dim is 7; expected an even number"),
    ],
    "config.json/model/observation_tokenizers/primary/kwargs/encoder": [
        ({"name": "ViTResnet"}, r"encoder is a ViTResnet; expected SmallStem or SmallStem16 or SmallStem32")
    ],
    "config.json/model/observation_tokenizers/primary/kwargs/encoder/kwargs": [
        ({"use_film": True}, "use_film is True; expected false"),
        ({"features": [32, 33]}, "expected lists of sizes, of one length"),
        ({"features": [32, 32, 64, 65]}, "expected multiples of 32"),
        ({"patch_size": 512}, "images of 48 x 32 become .* tokens; expected 1 to"),
    ],
    "config.json/model/observation_tokenizers/primary/kwargs": [
        ({"task_film_keys": ["language_instruction"]}, r"task_film_keys is .*expected none \(FiLM"),
        ({"use_token_learner": True}, "use_token_learner is True; expected none"),
        ({"obs_stack_keys": ["(a+)+$"]}, "obs_stack_keys is .*expected names, or beginnings of names"),
        ({"obs_stack_keys": ["image_top"]}, "expected one that reads something in example_batch"),
    ],
    "config.json/model/observation_tokenizers/primary": [
        ({"name": "LowdimObsTokenizer"}, "primary is a LowdimObsTokenizer; expected ImageTokenizer")
    ],
    "config.json/model": [
        ({"task_tokenizers": {}}, r"task_tokenizers is {}; expected one, of language\. Build the network"),
        ({"readouts": {"action": 1, "value": 1}}, r"readouts is .*; expected one, for the actions\. Build the network"),
        ({"max_horizon": 0}, "max_horizon is 0; expected a positive whole number"),
        ({"token_embedding_size": 34}, "num_attention_heads is 4; expected one that divides 34"),
    ],
    "config.json/model/task_tokenizers/language/kwargs": [
        ({"encoder": "distilbert"}, "encoder is 'distilbert'; .*a T5")
    ],
    "config.json/model/transformer_kwargs": [({"num_layers": 3}, "missing octo_transformer.*encoderblock_2")],
    "config.json": [
        ({"dataset_kwargs": {"action_proprio_normalization_type": "bounds"}}, "_type is 'bounds'; expected normal")
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_not_rebuilt_is_refused(place: str, changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    assert_refused(unpack(tmp_path) / "one", place, changes, message, tmp_path / "one")


def test_cameras_that_cannot_be_left_out(saved: Path) -> None:
    for names, message in (
        (["image_top"], "the cameras are image_primary, image_wrist; image_top cannot be left out"),
        (["image_primary", "image_wrist"], "all cannot be left out"),
    ):
        assert_not_read(saved / "two", message, options=LoadOptions(without_cameras=names))


def test_a_task_needs_a_tokenizer(saved: Path, tmp_path: Path) -> None:
    folder = unpack(tmp_path) / "one"
    (tmp_path / "t5-base" / "tokenizer.json").unlink()
    assert_not_read(
        folder, r"the tokenizer 't5-base' is not on this machine.*tokenizer\.json", options=LoadOptions(task="pick up")
    )
    assert TOKENS not in load_checkpoint_policy(saved / "one", options=LoadOptions(task="pick up"))[1].observations


def _array(shape: list[int], kind: str, content: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(1, msgpack.packb([shape, kind, content]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a msgpack file of flax, or a damaged one"),
        (b"\x93\x01", "not a msgpack file of flax, or a damaged one"),
        (msgpack.packb([1]), "the file is a list; expected arrays by name"),
        (msgpack.packb({"a": msgpack.ExtType(2, b"")}), "holds a complex number; expected arrays"),
        (msgpack.packb({"a": msgpack.ExtType(9, b"")}), "holds an extension 9"),
        (msgpack.packb({"a": _array([2], "object", b"12345678")}), "an array of 'object'; expected numbers"),
        (msgpack.packb({"a": _array([2**40], "float32", b"1234")}), "cannot reshape array"),
        (msgpack.packb({"a": _array([-1], "float32", b"1234")}), r"an array of shape \[-1\]"),
        (struct.pack(">BI", 0xDF, 2**32 - 1), "damaged one"),  # a map of four billion entries, without any
        (b"\x81\xa1a" * 5000, "damaged one"),
        (
            msgpack.packb({str(i): {str(n): 0 for n in range(1000)} for i in range(101)}),
            "has more than 100,000 entries",
        ),
        (msgpack.packb({"a": "PLACEHOLDER://a"}), r"a is in files of its own \(tensorstore\).*save_pretrained"),
        (msgpack.packb({"a": 3}), "a is a int; expected an array"),
    ],
)
def test_damaged_and_hostile_files_are_refused(saved: Path, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=message) as caught:
        flax_files.for_torch(flax_files.read_tree(path), path, octo._AGAIN)
    assert str(path) in str(caught.value)


def test_incomplete_folders_are_refused(tmp_path: Path) -> None:
    folder = unpack(tmp_path) / "one"
    whole = (folder / CHECKPOINT).read_bytes()
    (folder / CHECKPOINT).write_bytes(whole[: len(whole) // 2])
    result = CliRunner().invoke(main, ["convert", str(folder), "-o", str(tmp_path / "out")])
    assert result.exit_code == 2 and "damaged one" in " ".join(result.output.split())
    (folder / CHECKPOINT).unlink()
    (folder / "300" / "default" / "manifest.ocdbt").touch()
    assert_not_read(folder, r"found arrays in files of their own \(tensorstore\).*save_pretrained")
    (folder / "300").rename(folder / "last")
    assert_not_read(folder, "no folder of a step")


def test_examples_that_tell_no_sizes(tmp_path: Path) -> None:
    folder = unpack(tmp_path) / "one"
    example = folder / "example_batch.msgpack"
    batches: list[tuple[dict[str, Any], str]] = [
        ({}, "holds no observation"),
        ({"observation": {}, "task": {}}, "has no timestep_pad_mask"),
    ]
    for batch, message in batches:
        example.write_bytes(msgpack.packb(batch))
        assert_not_read(folder, message)


def test_without_msgpack_it_says_what_to_install(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def absent(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "msgpack":
            raise ModuleNotFoundError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    assert_not_read(saved / "one", r"needs the package msgpack, .*Install 'ttscompile\[octo\]'")


def test_weights_in_bfloat16(tmp_path: Path) -> None:
    values = np.array([1.5, -2.0], np.float32)
    path = tmp_path / "tree"
    path.write_bytes(
        msgpack.packb(
            {"a": {"bias": _array([2], "bfloat16", (values.view(np.uint32) >> 16).astype(np.uint16).tobytes())}}
        )
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = flax_files.for_torch(flax_files.read_tree(path), path, "")
    torch.testing.assert_close(made["a.bias"], torch.from_numpy(values))
