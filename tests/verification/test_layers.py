"""A network that is one block: its layers are recorded, and the first that differs is named."""

import shutil
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.passes.modules import MODULES, compiled
from tests.passes.specs import toy_spec
from ttscompile.artifact import tensors
from ttscompile.artifact.bind import EMBEDDED_BYTES
from ttscompile.artifact.golden import load_golden, probe_stream, project
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.artifact.view import View, view_of
from ttscompile.core.spec import PolicySpec
from ttscompile.driver import transform
from ttscompile.errors import ArtifactError
from ttscompile.ir.layers import layers, layers_graph
from ttscompile.ir.operations import operation
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.runtimes.onnxruntime import sessions
from ttscompile.verification.network import RESIDUAL, Probe, relative
from ttscompile.verification.rung import Rung

from .broken import edit_manifest, edited

pytestmark = pytest.mark.slow


def spec() -> PolicySpec:
    """With more steps than those at which layers are recorded."""
    return toy_spec(sample=(4, 2), obs=(3, 7), steps=7)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Program]:
    """A small U-Net, compiled."""
    directory = tmp_path_factory.mktemp("unet") / "compiled"
    torch.manual_seed(0)
    return directory, ttscompile.compile_denoiser(MODULES["U-Net"]().eval(), spec(), directory)


@pytest.fixture
def artifact(made: tuple[Path, Program], tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(made[0], tmp_path / "compiled"))


def failure(artifact: Path) -> Rung:
    """The lowest rung that fails."""
    found = ttscompile.verify(artifact)
    assert found.first_failure is not None
    return found.first_failure


def weighted(program: Program) -> list[str]:
    """Weights of the layers that have any too large to be kept in the graph, in the order of execution."""
    return [name for name in map("{}.weight".format, layers(program)) if program.weights[name].nbytes > EMBEDDED_BYTES]


def test_every_layer_of_the_network_is_recorded(made: tuple[Path, Program]) -> None:
    directory, program = made
    found = layers(program)
    inside = program.pieces.blocks[0].graph
    convolutions = [n.name for n in inside.nodes if operation(n.op).name.startswith("conv")]
    assert set(convolutions) - set(inside.outputs) <= set(found.values())
    assert next(iter(found)) == "net.down_modules.0.0.blocks.0.block.0"
    graph = layers_graph(program)
    assert graph is not None and graph.outputs == tuple(found)
    artifact = load_artifact(directory)
    golden = load_golden(artifact)
    assert golden.layers is not None and golden.layers.shape[1] == len(found)
    probe = Probe(view_of(artifact, "dense"), golden.network_observations(artifact.manifest.spec))
    stream = probe_stream(0, artifact.manifest.blocks[0].type, golden.streams, float(golden.scales[0]))
    for k, expected in zip(golden.evaluated.tolist(), golden.layers, strict=True):
        results = probe.layers(k, stream)
        assert list(results) == list(found)
        for result, one in zip(results.values(), expected, strict=True):
            assert relative(project(result, None)[0], one) < RESIDUAL / 10


@pytest.mark.parametrize("place", [0, -1])
def test_the_weights_of_one_layer(place: int, artifact: Path, made: tuple[Path, Program]) -> None:
    name = weighted(made[1])[place]
    with edited(artifact, "weights") as arrays:
        arrays[name][:, 0] *= 1.2  # not all of them: a norm of each channel follows
    rung = failure(artifact)
    assert (rung.name, rung.blocks, rung.details["layer"]) == ("block", (0,), name.removesuffix(".weight"))
    assert f"Inside it {name.removesuffix('.weight')!r} is the first layer that differs, at step 0" in rung.told


def test_weights_of_two_layers_exchanged(artifact: Path, made: tuple[Path, Program]) -> None:
    weights = made[1].weights
    names = weighted(made[1])
    one, other = next((a, b) for a, b in combinations(names, 2) if weights[a].shape == weights[b].shape)
    with edited(artifact, "weights") as arrays:
        arrays[one], arrays[other] = arrays[other].copy(), arrays[one].copy()
    assert failure(artifact).details["layer"] == one.removesuffix(".weight")


def test_a_fault_that_is_in_no_layer(artifact: Path) -> None:
    """The table of one step that is not among those at which layers are recorded."""
    manifest, golden = read_manifest(artifact), load_golden(load_artifact(artifact))
    (step,) = set(range(manifest.steps)) - set(golden.evaluated.tolist())
    with edited(artifact, "weights") as arrays:
        for name in arrays:
            if name.startswith("table/"):
                arrays[name][step] += 0.1
    rung = failure(artifact)
    assert (rung.name, rung.step, rung.details["layer"]) == ("block", step, None)
    assert golden.layers is not None
    assert f"Each of its {golden.layers.shape[1]} layers is right at steps 0, 1, " in rung.told


def test_a_record_of_other_layers_is_refused(artifact: Path) -> None:
    path = artifact / "golden.safetensors"
    arrays = tensors.read(path)
    path.write_bytes(tensors.serialize({**arrays, "layers": arrays["layers"][:, 1:].copy()}))
    edit_manifest(artifact)
    with pytest.raises(ArtifactError, match="golden record"):
        ttscompile.verify(artifact)


def test_no_call_opens_the_layers(artifact: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: set[str] = set()
    original = sessions._open_file

    def watched(view: View, file: str, *options: Any) -> Any:
        opened.add(file)
        return original(view, file, *options)

    monkeypatch.setattr(sessions, "_open_file", watched)
    ttscompile.load(artifact)
    assert "advance.onnx" in opened and "layers.onnx" not in opened


def test_a_policy_of_several_blocks_has_no_layers() -> None:
    """Its blocks are named already."""
    _, program = compiled("tokens")
    assert layers(program) == {} and layers_graph(program) is None


class Normalized(nn.Module):
    """A network without a residual, with a batch normalisation, which gives several values, inside."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.norm, self.last = nn.Conv1d(2, 4, 3, padding=1), nn.BatchNorm1d(4), nn.Conv1d(4, 2, 1)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        h = self.norm(self.first(sample.transpose(1, 2))) * obs.mean((1, 2))[:, None, None]
        return self.last(torch.tanh(h)).transpose(1, 2)


class Masked(nn.Module):
    """Attention without a residual, written out, with a mask of infinite numbers that stands in a buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.qkv, self.last = nn.Linear(2, 12), nn.Linear(4, 2)
        self.register_buffer("seen", torch.ones(4, 4).tril())

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        q, k, v = (self.qkv(sample) * obs.mean((1, 2))[:, None, None]).chunk(3, -1)
        scores = (q @ k.transpose(1, 2)).masked_fill(self.seen == 0, float("-inf"))
        return self.last(torch.softmax(scores, -1) @ v)


def test_infinite_numbers_of_a_mask_are_no_numbers_of_a_layer(tmp_path: Path) -> None:
    """Else its record were NaN, numpy warned, and this were the first layer that differs whatever is broken."""
    torch.manual_seed(0)
    program = ttscompile.compile_denoiser(Masked().eval(), spec(), tmp_path)
    golden = load_golden(load_artifact(tmp_path))
    assert golden.layers is not None and golden.layers.shape[1] == len(layers(program))
    assert np.isfinite(golden.layers).all()
    assert ttscompile.verify(tmp_path).first_failure is None


def test_a_layer_that_gives_several_values_is_not_recorded() -> None:
    program = transform(Normalized().eval(), spec())
    assert list(layers(program)) == ["first", "last"]
    inside = program.pieces.blocks[0].graph
    assert any(len(node.types) > 1 for node in inside.nodes)
    assert set(lower_program(program)) >= {"block_00", "layers"}
