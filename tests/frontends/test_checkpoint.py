"""Reading files that are hostile, damaged or foreign: one clear error, and nothing of the file is executed."""

import argparse
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.checkpoint import _Container, _Node, plain_config, read_checkpoint


class Payload:
    """Unpickling this creates a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.target),)


def replace_pickle(path: Path, data: bytes) -> None:
    """Put other bytes in place of a torch zip's ``data.pkl``."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, data if name.endswith("/data.pkl") else content)


def test_payload_works_where_pickle_is_trusted(tmp_path: Path) -> None:
    """The control: the payload of the tests below does create its target in an ordinary load."""
    torch.save(Payload(tmp_path / "mark"), tmp_path / "evil.ckpt")
    torch.load(tmp_path / "evil.ckpt", weights_only=False)
    assert (tmp_path / "mark").exists()


@pytest.mark.parametrize("place", ["top", "cfg", "state_dicts"])
def test_unknown_global_is_named_and_not_run(
    payload: Callable[..., Any], save: Callable[..., Path], tmp_path: Path, place: str
) -> None:
    """Refused wherever it hides; the message names it and says that nothing was executed."""
    hostile = payload()
    (hostile if place == "top" else hostile[place])["extra"] = Payload(tmp_path / "mark")
    with pytest.raises(CheckpointError, match=r"posix\.mkdir.*Nothing of the file was executed"):
        load_checkpoint_policy(save(hostile))
    assert not (tmp_path / "mark").exists()


def test_unknown_class_is_named(payload: Callable[..., Any], save: Callable[..., Path]) -> None:
    """Not only functions."""
    with pytest.raises(CheckpointError, match=r"argparse\.Namespace"):
        load_checkpoint_policy(save({**payload(), "args": argparse.Namespace(a=1)}))


def test_inner_pickles_are_never_opened(payload: Callable[..., Any], save: Callable[..., Path], tmp_path: Path) -> None:
    """Diffusion Policy keeps its counters as bytes of dill; they are not needed, and stay bytes."""
    hostile = payload()
    hostile["pickles"]["epoch"] = pickle.dumps(Payload(tmp_path / "mark"))
    path = save(hostile)
    load_checkpoint_policy(path)
    assert isinstance(read_checkpoint(path)["pickles"]["epoch"], bytes)
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("protocol", [0, 4])
def test_hand_made_pickle_of_another_protocol(
    payload: Callable[..., Any], save: Callable[..., Path], tmp_path: Path, protocol: int
) -> None:
    """Opcodes that torch.save does not write are refused, too."""
    path = save(payload())
    replace_pickle(path, pickle.dumps(Payload(tmp_path / "mark"), protocol))
    with pytest.raises(CheckpointError, match="Nothing of the file was"):
        load_checkpoint_policy(path)
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("name", ["CodeType", "FunctionType", "eval", "__import__"])
def test_dill_types_are_plain_types_only(payload: Callable[..., Any], save: Callable[..., Path], name: str) -> None:
    """dill's _load_type would give callables for some names."""
    path = save(payload())
    text = name.encode()
    replace_pickle(path, b"\x80\x02cdill._dill\n_load_type\nX" + len(text).to_bytes(4, "little") + text + b"\x85R.")
    with pytest.raises(CheckpointError, match=rf"'{name}'.*Nothing of the file was executed"):
        load_checkpoint_policy(path)


def test_legacy_file_is_refused_unread(payload: Callable[..., Any], tmp_path: Path) -> None:
    """A file of torch < 1.6 is one bare pickle."""
    torch.save(
        {**payload(), "x": Payload(tmp_path / "mark")}, tmp_path / "old.ckpt", _use_new_zipfile_serialization=False
    )
    with pytest.raises(CheckpointError, match=r"not a torch checkpoint.*torch >= 1\.6"):
        load_checkpoint_policy(tmp_path / "old.ckpt")
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 and nothing"])
def test_no_checkpoint(tmp_path: Path, content: bytes) -> None:
    """Empty, text, the beginning of a zip."""
    (tmp_path / "policy.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match="not a torch checkpoint, or a truncated one"):
        load_checkpoint_policy(tmp_path / "policy.ckpt")


def test_missing_file_and_directory(tmp_path: Path) -> None:
    """Said for what they are."""
    with pytest.raises(CheckpointError, match="no such file"):
        load_checkpoint_policy(tmp_path / "none.ckpt")
    with pytest.raises(CheckpointError, match="is a directory.*compile_denoiser"):
        load_checkpoint_policy(tmp_path)
    with pytest.raises(CheckpointError, match="format 'onnx' is not known"):
        load_checkpoint_policy(tmp_path / "none.ckpt", format="onnx")


def test_another_zip(tmp_path: Path) -> None:
    """A zip without a pickle."""
    with zipfile.ZipFile(tmp_path / "policy.ckpt", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(CheckpointError, match="a zip archive that torch.save did not write .*no data.pkl"):
        load_checkpoint_policy(tmp_path / "policy.ckpt")


def test_truncated_anywhere(payload: Callable[..., Any], save: Callable[..., Path]) -> None:
    """Cut off at any tenth of its length, a file is refused as such."""
    path = save(payload())
    whole = path.read_bytes()
    for tenths in range(10):
        path.write_bytes(whole[: len(whole) * tenths // 10])
        with pytest.raises(CheckpointError, match="truncated"):
            load_checkpoint_policy(path)


def test_truncated_pickle_inside_a_whole_zip(payload: Callable[..., Any], save: Callable[..., Path]) -> None:
    """Its message is one line and does not repeat torch's advice to load without protection."""
    path = save(payload())
    with zipfile.ZipFile(path) as archive:
        data = archive.read(next(name for name in archive.namelist() if name.endswith("/data.pkl")))
    replace_pickle(path, data[: len(data) // 2])
    with pytest.raises(CheckpointError, match="damaged") as caught:
        load_checkpoint_policy(path)
    assert "\n" not in str(caught.value)
    assert "weights_only" not in str(caught.value)


def test_payload_that_is_no_dictionary(tmp_path: Path) -> None:
    """A bare tensor."""
    torch.save(torch.zeros(3), tmp_path / "policy.ckpt")
    with pytest.raises(CheckpointError, match="holds a Tensor"):
        load_checkpoint_policy(tmp_path / "policy.ckpt")


@pytest.mark.slow
def test_neither_omegaconf_nor_dill_is_imported(shared: Path) -> None:
    """The golden checkpoints name both packages; reading one imports neither."""
    path = shared / "golden" / "diffusion_policy" / "bert.ckpt"
    code = (
        "import sys; sys.modules['omegaconf'] = sys.modules['dill'] = None\n"
        "from ttscompile.frontends.checkpoint import plain_config, read_checkpoint\n"
        f"print(plain_config(read_checkpoint({str(path)!r})['cfg'])['policy']['model']['n_emb'])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert result.stdout.strip() == "64"


def inert(cls: type[Any], state: Any) -> Any:
    """An object as the reader leaves it."""
    value = cls()
    value.__setstate__(state)
    return value


def test_plain_config_unwraps_nodes() -> None:
    """Containers of nodes of containers; omegaconf writes None and a missing list as such."""
    tree = inert(
        _Container,
        {
            "_content": {
                "a": inert(_Node, {"_val": 3}),
                "b": inert(_Container, {"_content": [inert(_Node, {"_val": "x"}), inert(_Node, {"_val": None})]}),
                "c": inert(_Container, {"_content": None}),
            }
        },
    )
    assert plain_config(tree) == {"a": 3, "b": ["x", None], "c": None}


@pytest.mark.parametrize("state", [None, {}, {"_val": 1}, "text"])
def test_plain_config_refuses_malformed_objects(state: Any) -> None:
    """A container without content, with its place."""
    with pytest.raises(CheckpointError, match=r"cfg\.a: .*_content"):
        plain_config({"a": inert(_Container, state)})


def test_plain_config_refuses_cycles_and_foreign_values() -> None:
    """A configuration that contains itself has no plain form; nor has a tensor in it."""
    content: dict[str, Any] = {}
    content["again"] = inert(_Container, {"_content": content})
    with pytest.raises(CheckpointError, match="nested deeper than 64"):
        plain_config(content)
    with pytest.raises(CheckpointError, match=r"cfg\.a\[1\]: found a Tensor"):
        plain_config({"a": [1, torch.zeros(1)]})
