"""Artifacts and checkpoints from a hub, and back: what is downloaded, what is not, what is there without a network."""

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.passes.modules import MODULES, spec
from tests.policies.lerobot_tiny import save_policy
from ttscompile.artifact.load import load_artifact
from ttscompile.cli import main
from ttscompile.core.spec import PolicySpec
from ttscompile.driver import compile_denoiser
from ttscompile.errors import HubError, RuntimeUnavailableError, TtscompileError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.hub import fetch_artifact, fetch_checkpoint
from ttscompile.hub.repository import HubName, read_name
from ttscompile.report.push import card

from .served import Hub, serving

pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=<...>' to upload:DeprecationWarning")  # the library's

CARD = b"---\nlicense: apache-2.0\n---\n# A policy\n"
HOSTILE = {
    "setup.py": b"raise SystemExit",
    "policy.pkl": pickle.dumps(0),
    "pytorch_model.bin": b"\x80",
    "modeling.py": b"x",
    "../escape.json": b"{}",
    ".gitattributes": b"",
}


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("hf://org/name", HubName("org/name")),
        ("hf://org/name@v1.0", HubName("org/name", "v1.0")),
        ("hf://org/name@refs%2Fpr%2F1/a/b.ckpt", HubName("org/name", "refs/pr/1", "a/b.ckpt")),
        ("hf://o.r-g/na_me/folder/", HubName("o.r-g/na_me", None, "folder")),
    ],
)
def test_a_name_is_read(text: str, name: HubName) -> None:
    assert read_name(text) == name


@pytest.mark.parametrize(
    "text",
    [
        "hf://",
        "hf://org",
        "hf:///name",
        "hf://org/na me",
        "hf://org/../x",
        "hf://org/na--me",
        "hf://org/name@",
        "hf://org/name@../x",
        "hf://org/name@a\nb",
        "hf://org/name/../../etc",
        "hf://org/name//etc",
        "hf://org/name/*",
        "hf://org/name/.cache",
        "hf://org/name/\x1b[31m",
    ],
)
def test_what_is_no_name_is_refused_before_anything_is_asked(text: str, hub: Hub, tmp_path: Path) -> None:
    for call in (ttscompile.load, lambda name: ttscompile.convert(name, tmp_path / "out")):
        with pytest.raises(HubError, match="expected hf://ORGANISATION/NAME"):
            call(text)
    assert hub.asked == []


def test_an_artifact_is_loaded_and_nothing_else_is_downloaded(
    hub: Hub, toy_artifact: Path, toy_files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = hub.commit("org/name", {**toy_files, **HOSTILE, "README.md": CARD, "more.safetensors": b"unlisted"})
    policy = ttscompile.load("hf://org/name", seed=0)
    assert policy.origin == f"hf://org/name@{commit}"
    assert hub.downloaded() == {*toy_files, "README.md"}
    here = ttscompile.load(toy_artifact, seed=0)
    assert policy.info.identity == here.info.identity and here.origin is None
    obs = {"obs": np.ones((1, 2), np.float32)}
    for plan in ("dense", None):
        for each in (policy, here):
            each.reset(seed=1)
        assert (policy.predict_action(obs, plan=plan)["action"] == here.predict_action(obs, plan=plan)["action"]).all()


def test_without_a_network_there_is_what_was_downloaded(
    hub: Hub, toy_files: dict[str, bytes], monkeypatch: Any
) -> None:
    commit = hub.commit("org/name", toy_files)
    first = ttscompile.load("hf://org/name").origin
    before = len(hub.asked)
    assert ttscompile.load("hf://org/name").origin == first
    assert hub.asked[before:] == ["GET /api/models/org/name/revision/main"]
    hub.commit("org/name", {"README.md": b"another"})  # main goes on; the commit stays what it was
    assert ttscompile.load(f"hf://org/name@{commit}").origin == first
    assert len(hub.asked) == before + 1
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert ttscompile.load(f"hf://org/name@{commit}").origin == first
    with pytest.raises(HubError, match=r"^hf://org/other: .*Is the name right, is there a network"):
        ttscompile.load("hf://org/other")


def test_main_means_what_was_downloaded_last_where_nobody_answers(
    hub: Hub, toy_files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    hub.commit("org/name", toy_files)
    first = ttscompile.load("hf://org/name").origin
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    before = list(hub.asked)
    assert ttscompile.load("hf://org/name").origin == first
    assert hub.asked == before


@pytest.mark.parametrize(
    ("name", "files", "why"),
    [
        ("hf://org/none", None, "RepositoryNotFoundError|404"),
        ("hf://org/name@nothing", {}, "Revision|404"),
        ("hf://org/name", {"README.md": CARD}, "no manifest.json in it, so it is no artifact"),
        ("hf://org/name", {"manifest.json": b"{"}, "manifest.json lists no files"),
        ("hf://org/name", {"manifest.json": b"[" * 10_000}, "manifest.json lists no files"),
        ("hf://org/name", {"manifest.json": b'{"files": 3}'}, "manifest.json lists no files"),
        ("hf://org/name", {"manifest.json": b'{"files": {"../../x.json": 1}}'}, "is no file of an artifact"),
        ("hf://org/name", {"manifest.json": b'{"files": {"/etc/passwd": 1}}'}, "is no file of an artifact"),
        ("hf://org/name", {"manifest.json": b'{"files": {"*.json": 1}}'}, "is no file of an artifact"),
        ("hf://org/name", {"manifest.json": b'{"files": {"a.py": 1}}', "a.py": b""}, "is no file of an artifact"),
        (
            "hf://org/name",
            {"manifest.json": b'{"files": {"a.onnx": 1}}'},
            "a.onnx is not there: the repository is not whole",
        ),
        (
            "hf://org/name",
            {"manifest.json": json.dumps({"files": {f"{i}.onnx": 1 for i in range(1001)}}).encode()},
            "it lists 1002 files; expected 1000 at most",
        ),
    ],
)
def test_a_repository_that_holds_no_artifact_is_one_error(
    name: str, files: dict[str, bytes] | None, why: str, hub: Hub
) -> None:
    if files is not None:
        hub.commit("org/name", files)
    with pytest.raises(HubError, match=why) as caught:
        ttscompile.load(name)
    assert str(caught.value).count("\n") <= 2
    assert hub.downloaded() <= {"manifest.json", "README.md"}


@pytest.mark.slow
def test_a_checkpoint_is_converted_and_passes_its_licence_on(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint is read as it is; a smaller network is compiled in its place, which takes less long."""

    def read(path: Path, format: str, options: LoadOptions) -> tuple[Any, PolicySpec]:
        _, own = load_checkpoint_policy(path, format, options)
        return MODULES["adaLN"]().eval(), replace(spec(), source=own.source)

    monkeypatch.setattr("ttscompile.driver.load_checkpoint_policy", read)
    folder = save_policy(tmp_path)
    files = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    clip = {"clip-small/config.json": (tmp_path / "clip-small" / "config.json").read_bytes()}
    commit = hub.commit("org/base", {**files, **clip, "README.md": CARD, **HOSTILE})
    words = ["convert", "hf://org/base", "-o", str(tmp_path / "compiled"), "--steps", "2"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert f"base hf://org/base@{commit}" in " ".join(result.stdout.split()), result.stdout
    assert hub.downloaded() == {*files, *clip, "README.md"}
    source = load_artifact(tmp_path / "compiled").manifest.spec.source
    assert (source["base"], source["base_licence"]) == (f"hf://org/base@{commit}", "apache-2.0")
    pushed = CliRunner().invoke(main, ["push", str(tmp_path / "compiled"), "org/made"])
    assert pushed.exit_code == 0, pushed.output
    card = hub.find("org/made", "main")[1]["README.md"].decode()
    for told in (
        'license: "apache-2.0"',
        'base_model: "org/base"',
        f"org/base, commit {commit}",
        f"{spec().sampler.name}, K = {spec().sampler.steps}",
        "It was not calibrated",
        f"`ttscompile convert hf://org/base@{commit} -o DIR --sampler {spec().sampler.name} ",
    ):
        assert told in card, card
    refused = CliRunner().invoke(main, ["push", str(tmp_path / "compiled"), "org/made", "--license", "mit"])
    assert refused.exit_code == 2 and "the base is under the licence apache-2.0" in refused.stderr
    assert pushed.stdout == f"pushed hf://org/made@{hub.find('org/made', 'main')[0]}\n"


@pytest.mark.slow
def test_the_card_tells_what_was_left_out(tmp_path: Path) -> None:
    """Else the command on it makes another artifact."""
    shorter = {"task": "push", "without": "observation.images.side, observation.images.`top`"}
    compile_denoiser(MODULES["adaLN"]().eval(), replace(spec(), source=shorter), tmp_path / "compiled")
    artifact = load_artifact(tmp_path / "compiled")
    manifest = replace(artifact.manifest, spec=replace(artifact.manifest.spec, left_out=3))
    told = card(replace(artifact, manifest=manifest), "org/made", [], [], None)
    names = "--without-camera observation.images.side --without-camera observation.images.top"
    assert f" --task TASK {names} --prediction-horizon {spec().sample[0]}`" in told, told


def lerobots_files() -> dict[str, bytes]:
    root = Path(__file__).parents[2] / "examples" / "policies" / "flow" / "policy"
    return {each.relative_to(root).as_posix(): each.read_bytes() for each in root.rglob("*") if each.is_file()}


def test_of_a_directory_of_lerobot_its_own_files_are_taken(hub: Hub) -> None:
    files = lerobots_files()
    hub.commit("org/lerobot", {**files, **HOSTILE, "optimizer.json": b"{}", "a/b/config.json": b"{}"})
    fetched = fetch_checkpoint("hf://org/lerobot")
    assert hub.downloaded() == set(files) and fetched.licence is None
    hub.commit("org/inner", {f"pretrained_model/{name}": content for name, content in files.items()})
    inner = fetch_checkpoint("hf://org/inner/pretrained_model").path
    for folder in (fetched.path, inner):
        assert {each.relative_to(folder).as_posix() for each in folder.rglob("*") if each.is_file()} == set(files)


def test_of_several_checkpoints_one_has_to_be_named(hub: Hub, tmp_path: Path) -> None:
    hub.commit("org/two", {"a.ckpt": b"a", "b/c.ckpt": b"c", "config.json": b"{}"})
    with pytest.raises(HubError, match="it has 2 checkpoints. Say which: hf://org/two@REVISION/a.ckpt"):
        fetch_checkpoint("hf://org/two")
    assert fetch_checkpoint("hf://org/two/b/c.ckpt").path.read_bytes() == b"c"
    hub.commit("org/code", HOSTILE)
    with pytest.raises(HubError, match="there is no checkpoint in it; expected config.json and model.safetensors"):
        fetch_checkpoint("hf://org/code")


def test_without_a_listing_a_part_of_the_cache_is_not_taken_for_all(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two checkpoints one is there; of a directory all is, or its processors are not."""
    from huggingface_hub import constants

    files = lerobots_files()
    processors = {"policy_preprocessor.json", "policy_postprocessor.json"}
    hub.commit("org/two", {"a.ckpt": b"a", "b.ckpt": b"b"})
    commit = hub.commit("org/whole", files)
    hub.commit("org/part", {name: content for name, content in files.items() if name not in processors})
    fetch_checkpoint("hf://org/two/a.ckpt")
    fetch_checkpoint("hf://org/whole")
    fetch_checkpoint("hf://org/part")
    for name in ("HF_HUB_OFFLINE", "without_lists"):
        with monkeypatch.context() as lost:
            lost.setattr(hub if name == "without_lists" else constants, name, True)
            for refused in ("hf://org/two", "hf://org/part"):
                with pytest.raises(HubError, match=f"^{refused}: .*Is the name right, is there a network"):
                    fetch_checkpoint(refused)
            assert fetch_checkpoint("hf://org/two/a.ckpt").path.read_bytes() == b"a"
            assert fetch_checkpoint("hf://org/whole").origin == f"hf://org/whole@{commit}"


def test_of_names_in_a_repository_plain_ones_alone_are_shown(hub: Hub) -> None:
    hub.commit("org/two", {"\x1b[31m.ckpt": b"a", "in/a.ckpt": b"b", "in/\x1b.ckpt": b"c"})
    for name, example in (("hf://org/two", "in/a.ckpt"), ("hf://org/two/in", "in/a.ckpt")):
        with pytest.raises(HubError, match="checkpoints. Say which: ") as caught:
            fetch_checkpoint(name)
        assert str(caught.value).endswith(f": hf://org/two@REVISION/{example}")
    hub.commit("org/two", {"\x1b[31m.ckpt": b"a", "\x1b[32m.ckpt": b"b"})
    with pytest.raises(HubError, match=r"Say which: hf://org/two@REVISION/PATH\.ckpt$"):
        fetch_checkpoint("hf://org/two")


class Runs:
    """Unpickled, it would make a folder."""

    def __init__(self, made: Path) -> None:
        self.made = str(made)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.made,)


def test_no_pickle_of_a_repository_runs(hub: Hub, tmp_path: Path) -> None:
    hub.commit("org/evil", {"policy.ckpt": pickle.dumps(Runs(tmp_path / "ran"))})
    with pytest.raises(TtscompileError):
        ttscompile.convert("hf://org/evil", tmp_path / "out")
    assert not (tmp_path / "ran").exists() and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("card", "licence"),
    [
        (CARD, "apache-2.0"),
        (b"# no head", None),
        (b"---\nlicense: [a, b]\n---\n", None),
        (b'---\nlicense: "a\\n---\\ninjected"\n---\n', None),
        (b"---\nlicense: !!python/object/apply:os.mkdir [/tmp/ran]\n---\n", None),
        (b"\xff\xfe", None),
        (b"---\nlicense: mit\n---\n" + b"x" * (1 << 20), None),
    ],
)
def test_the_licence_of_a_card_is_a_word_or_nothing(card: bytes, licence: str | None, hub: Hub) -> None:
    hub.commit("org/name", {"a.ckpt": b"a", "README.md": card})
    assert fetch_checkpoint("hf://org/name").licence == licence


def test_a_pushed_artifact_is_the_same_when_it_is_loaded(
    hub: Hub, toy_artifact: Path, toy_files: dict[str, bytes]
) -> None:
    origin = ttscompile.push(toy_artifact, "hf://org/new", runs=1, licence="mit")
    commit, files = hub.find("org/new", "main")
    assert origin == f"hf://org/new@{commit}"
    assert {name: content for name, content in files.items() if name != "README.md"} == toy_files
    assert b'license: "mit"' in files["README.md"] and b"from the hub" in files["README.md"]
    assert ttscompile.load(origin).info.identity == load_artifact(toy_artifact).manifest.identity
    assert ttscompile.push(toy_artifact, "org/new", runs=1) == f"hf://org/new@{hub.find('org/new', 'main')[0]}"


def test_a_repository_with_something_else_is_left_alone(hub: Hub, toy_artifact: Path) -> None:
    commit = hub.commit("org/mine", {"README.md": CARD, "model.safetensors": b"years of work"})
    with pytest.raises(HubError, match="expected an empty repository or an artifact; it has model.safetensors"):
        ttscompile.push(toy_artifact, "org/mine", runs=1)
    assert hub.find("org/mine", "main")[0] == commit
    for name in ("mine", "org/mine@v1", "org/mine/folder"):
        with pytest.raises(HubError, match=r"no name of a repository; expected ORGANISATION/NAME\.$"):
            ttscompile.push(toy_artifact, name, runs=1)


def test_what_is_to_be_private_goes_into_no_public_repository(hub: Hub, toy_artifact: Path) -> None:
    hub.commit("org/public", {})
    before = len(hub.asked)
    with pytest.raises(HubError, match=r"^org/public: expected a private repository; it is public"):
        ttscompile.push(toy_artifact, "org/public", runs=1, private=True)
    assert len(hub.commits["org/public"]) == 1
    assert not [each for each in hub.asked[before:] if "preupload" in each or "commit" in each or "lfs" in each]
    ttscompile.push(toy_artifact, "org/own", runs=1, private=True)
    ttscompile.push(toy_artifact, "org/own", runs=1, private=True)
    assert hub.private == {"org/own"} and len(hub.commits["org/own"]) == 2


def test_without_the_library_names_of_the_hub_say_what_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(RuntimeUnavailableError, match=r"pip install 'ttscompile\[hub\]'"):
        fetch_artifact("hf://org/name")


@pytest.mark.slow
def test_the_environment_says_which_hub_and_the_cache_serves_when_it_is_gone(
    toy_artifact: Path, tmp_path: Path
) -> None:
    """As a user has it: commands, ``HF_ENDPOINT``, and then no server any more."""
    pytest.importorskip("huggingface_hub")
    code = "import ttscompile, sys; policy = ttscompile.load(sys.argv[1]); print(policy.origin)"

    def run(*words: str) -> str:
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=env, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    with serving() as hub:
        settings = {"HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path), "HF_HUB_DISABLE_XET": "1", "HF_TOKEN": "none"}
        env = {**os.environ, **settings}
        pushed = run("-P", "-m", "ttscompile", "push", str(toy_artifact), "org/name")
        origin = pushed.removeprefix("pushed ")
        assert origin == f"hf://org/name@{hub.find('org/name', 'main')[0]}"
        assert run("-P", "-c", code, "hf://org/name") == origin
    assert run("-P", "-c", code, "hf://org/name") == origin
