"""What the generators of this folder share: a clone at its commit, modules that are left out, weights and noise."""

import importlib
import io
import subprocess
import sys
import tarfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from unittest.mock import patch

import click
import numpy as np
import torch
from torch import nn

from ..weights import draw_weights

Arrays = dict[str, Any]


def generator(run: Callable[[Path], Mapping[str, Arrays]], commit: str, *parts: str) -> click.Command:
    """Command line of a generator: ``CLONE [-o FOLDER]``.

    Args:
        run: from a folder with the sources to what each file holds, by its name.
        commit: of the original.
        parts: the folders and files of it that are needed.
    """

    @click.command(help=f"Run an original from a CLONE that has commit {commit}, and write what it gives.")
    @click.argument("clone", type=click.Path(exists=True, file_okay=False, path_type=Path))
    @click.option(
        "-o",
        "--output",
        type=click.Path(exists=True, file_okay=False, path_type=Path),
        default=Path(__file__).parent,
        help="Folder of the files; this one if left out.",
    )
    def command(clone: Path, output: Path) -> None:
        torch.set_num_threads(1)  # sums are taken in the same order everywhere
        git = ["git", "-C", str(clone), "archive", "--format=tar", commit, *parts]
        archive = subprocess.run(git, check=False, stdout=subprocess.PIPE)
        if archive.returncode:
            raise click.ClickException(f"{clone}: git cannot read {' '.join(parts)} at {commit}; fetch that commit")
        with TemporaryDirectory() as folder, torch.no_grad():
            with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
                tar.extractall(folder, filter="data")
            for name, arrays in run(Path(folder)).items():
                path = output / f"{name}.npz"
                np.savez_compressed(path, **arrays)
                print(path, path.stat().st_size, "bytes")

    return command


def package(name: str, path: Path) -> None:
    """A package of an original whose ``__init__`` is not run: its modules can be imported, nothing else of it is."""
    module = ModuleType(name)
    module.__path__ = [str(path)]
    sys.modules[name] = module


class _Absent(ModuleType):
    """A module in which every name is an empty class."""

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *args, **kwargs: None})


def absent(*names: str) -> None:
    """Modules that an original imports and that take no part in what is run."""
    sys.modules.update({name: _Absent(name) for name in names})


def timm(version: str) -> None:
    """The layers of timm without torchvision, which is for its images and for networks that nobody runs here.

    Args:
        version: that the original asks for.
    """
    absent("timm.data", "torchvision.ops.misc")
    found = importlib.import_module("timm").__version__
    if found != version:
        raise click.ClickException(f"timm {version} is needed, {found} is installed; put {version} on PYTHONPATH")


def lerobot(folder: Path, *policies: str) -> None:
    """LeRobot without what needs Python 3.12 or robots: only the modules of the networks are imported.

    Args:
        folder: of the sources.
        policies: whose modules are wanted.
    """
    root = folder / "src" / "lerobot"
    names = [
        "",
        ".utils",
        ".policies",
        ".policies.common",
        ".policies.rtc",
        *(f".policies.{name}" for name in policies),
    ]
    for name in names:
        package(f"lerobot{name}", root / name.strip(".").replace(".", "/"))
    absent("lerobot.configs", "lerobot.utils.import_utils", "lerobot.policies.pretrained", "lerobot.policies.utils")
    absent("lerobot.policies.rtc.modeling_rtc", *(f"lerobot.policies.{n}.configuration_{n}" for n in policies))


def seeded(module: nn.Module, seed: int, *without: str) -> None:
    """Give a module the weights that the tests draw for it, and switch it to evaluation.

    Args:
        module: its weights are replaced.
        seed: of the weights.
        without: beginnings of names; these parameters stay as they are, and take no part in what is run.
    """
    own = {name: tuple(value.shape) for name, value in module.state_dict().items() if not name.startswith(without)}
    drawn = draw_weights(own, seed)
    unknown = module.load_state_dict(drawn, strict=False)
    assert not unknown.unexpected_keys
    assert all(name.startswith(without) for name in unknown.missing_keys), unknown.missing_keys
    module.eval()


def normal(seed: int) -> Callable[..., np.ndarray]:
    """Draw standard normal float32 arrays of a shape, one after the other."""
    rng = np.random.default_rng(seed)
    return lambda *shape: rng.standard_normal(shape, dtype=np.float32)


def noise_from(initial: np.ndarray) -> AbstractContextManager[Any]:
    """What ``torch.randn`` gives inside: the noise that a call starts from."""
    return patch("torch.randn", lambda *args, **kwargs: torch.from_numpy(initial.copy()))


def on_cpu() -> AbstractContextManager[Any]:
    """``Tensor.cuda`` does nothing inside: for originals that send tensors to a GPU by name."""
    return patch.object(torch.Tensor, "cuda", lambda self, *args, **kwargs: self)
