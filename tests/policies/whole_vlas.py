"""What holds of every vision-language-action model that is compiled whole from what lerobot saved."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

import ttscompile
from tests.once import Once
from ttscompile.core.spec import ChunkSpec, Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.ir.program import Program

from ..families.support import record
from . import eo1s, evo1s, groots, originals, vla_jepas, wall_xs, xvlas
from .refused import Refusals as Refusals, assert_not_read, refusals as refusals
from .vlas import CAMERAS, MASK, TOKENS, Array, as_given


@dataclass(frozen=True)
class Whole:
    """A model of which lerobot saved tiny policies, and what is particular about them.

    Attributes:
        name: lerobot's; ``golden/lerobot_NAME.npz`` has the actions that lerobot gave, by kind and call.
        kinds: of policies; the first is compiled.
        save: ``save(kind, folder, call)`` writes a policy, for images of this call. Gives its directory.
        observation: ``observation(kind, call)``, one frame.
        noise: ``noise(kind)``, ``[1, T, D]``.
        tasks: the instruction of each call.
        tokenizer: the folder with the tokenizer of a kind's policy.
        loop: sampler and steps.
        executed: so many actions, of so many numbers.
        doctor: parts of what ``doctor`` finds.
        elsewhere: folders beside a policy by the place and the entry that names each, as of ``assert_refused``.
        told: what the table of supported policies says of the comparison.
        cameras: of the first kind.
        missing: which camera of a kind the robot lacks.
        calls: whose images a single artifact takes.
        close: the largest difference of an action before it is compiled.
        eight_bits: the same, in eight bits.
        numbers: so many of an action eight bits change a little; the others have two values.
        too_long: an instruction that is refused, and what is said of it; None where it is cut.
        compiled_in: kinds whose instruction has to be compiled in.
        files: whether lerobot's commands take a policy with its task alone.
    """

    name: str
    kinds: Sequence[str]
    save: Callable[[str, Path, int], Path]
    observation: Callable[[str, int], Mapping[str, Array]]
    noise: Callable[[str], Array]
    tasks: Sequence[str]
    tokenizer: Callable[[str], Path]
    loop: str
    executed: tuple[int, int]
    doctor: Mapping[str, str]
    elsewhere: Mapping[str, tuple[str, str]]
    told: str = "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4"
    cameras: Sequence[str] = CAMERAS
    missing: Mapping[str, str] = field(default_factory=dict)
    calls: Sequence[int] = (0, 1)
    close: float = 1e-4
    eight_bits: float = 0.2
    numbers: int | None = None
    too_long: tuple[str, str] | None = None
    compiled_in: Sequence[str] = ()
    files: bool = True

    def golden(self) -> Mapping[str, Array]:
        """The actions that lerobot gave, by kind and call."""
        return originals.golden(f"lerobot_{self.name}")

    def eager(self, directory: Path, kind: str, call: int, options: LoadOptions = AS_SAVED) -> Array:
        """As much of the rebuilt network's chunk, not compiled, as lerobot gave: all of it, or what is executed."""
        told = self.tokenizer(kind), self.tasks[call]
        found = eager_chunk(directory, options, self.observation(kind, call), self.noise(kind), *told)[1]
        executed = self.golden().get(f"{kind}.{call}")
        return found if executed is None else found[:, : executed.shape[1]]

    def compiled(self, once: Once, folder: Path) -> tuple[Path, Program]:
        """The artifact of the first kind, whose instruction is an observation, and its program."""
        name = f"whole {self.name}"
        artifact, program = once.compiled(
            name, lambda to: ttscompile.convert(self.save(self.kinds[0], folder / name, 0), to)
        )
        record(f"LeRobot {self.name}", self.told, self.loop, program)
        return artifact, program


EO1 = Whole(
    "eo1",
    eo1s.KINDS,
    eo1s.save,
    eo1s.observation,
    lambda kind: eo1s.noise(),
    eo1s.TASKS,
    lambda kind: eo1s.SAVED / kind / eo1s.BACKBONE,
    "euler 10",
    (4, eo1s.ACTION_DIM),
    {"tokenizer": "263 tokens; 273 are known", "normaliser of action": "5 numbers"},
    {eo1s.BACKBONE: ("step/qwen", "processor_name")},
    calls=(0,),
    close=2e-5,
    eight_bits=0.3,
    too_long=("x" * 65, r"has 65 tokens, and the policy reads 64\. Use fewer words"),
)
EVO1 = Whole(
    "evo1",
    evo1s.KINDS,
    lambda kind, folder, call: evo1s.save(kind, folder),
    lambda kind, call: evo1s.observation(call),
    evo1s.noise,
    evo1s.TASKS,
    lambda kind: evo1s.SAVED / kind / evo1s.LANGUAGE,
    "euler 4",
    (4, 5),
    {"tokenizer": "are known", "normaliser of action": "5 numbers"},
    {evo1s.LANGUAGE: ("config.json", "vlm_model_name")},
)
GROOT = Whole(
    "groot",
    groots.KINDS,
    lambda kind, folder, call: groots.save(kind, folder),
    lambda kind, call: groots.observation(call),
    lambda kind: groots.noise(),
    groots.TASKS,
    lambda kind: groots.SAVED / kind / groots.BACKBONE,
    "euler 4",
    (4, groots.ACTION_DIM),
    {
        "tokenizer": "263 tokens; 263 are known",
        "normaliser of observation.state": "in column 1 of 4, which the policy does not see",
        "normaliser of action": "range of 5 numbers",
    },
    {groots.BASE: ("config.json", "base_model_path"), groots.BACKBONE: (f"../{groots.BASE}/config.json", "model_name")},
    "actions that lerobot 0.6.1 gave, raw observation to action, also relative to state and pose, 1e-4",
    too_long=("x" * 71, r"has 74 tokens, and the policy reads 64\. Use fewer words"),
)
VLA_JEPA = Whole(
    "vla_jepa",
    vla_jepas.KINDS,
    vla_jepas.save,
    vla_jepas.observation,
    lambda kind: vla_jepas.noise(),
    vla_jepas.TASKS,
    lambda kind: vla_jepas.SAVED / kind / vla_jepas.BACKBONE,
    "euler 4",
    (3, vla_jepas.ACTION_DIM),
    {"tokenizer": "263 tokens; 284 are known", "normaliser of action": "range of 7 numbers"},
    {vla_jepas.BACKBONE: ("config.json", "qwen_model_name")},
    numbers=-1,
    too_long=("x" * 65, r"has 121 tokens, and the policy reads 120\. Use fewer words"),
)
WALL_X = Whole(
    "wall_x",
    wall_xs.KINDS,
    wall_xs.save,
    wall_xs.observation,
    wall_xs.noise,
    wall_xs.TASKS,
    lambda kind: wall_xs.SAVED / kind / wall_xs.BASE,
    "euler 10",
    (4, wall_xs.ACTION_DIM["flow"]),
    {"tokenizer": "266 tokens; 266 are known", "normaliser of action": "5 numbers"},
    {wall_xs.BASE: ("config.json", "pretrained_name_or_path")},
    cameras=wall_xs.CAMERAS["flow"],
    missing={kind: wall_xs.CAMERAS[kind][index] for kind, index in wall_xs.MISSING.items()},
    calls=(0,),
    close=6e-5,  # of actions up to 7; rounding alone makes half of it
    eight_bits=1,
    too_long=("x" * 65, r"has 81 tokens, and the policy reads 80\. Use fewer words"),
)
XVLA = Whole(
    "xvla",
    xvlas.KINDS,
    lambda kind, folder, call: xvlas.save(kind, folder),
    lambda kind, call: xvlas.observation(call, kind),
    xvlas.noise,
    xvlas.TASKS,
    lambda kind: xvlas.SAVED / xvlas.LANGUAGE,
    "remix 4",
    (3, 20),
    {"tokenizer": "259 tokens; 259 are known"},
    {},
    close=1e-5,
    compiled_in=("auto", "so101"),
    files=False,
)
WHOLE = (EO1, EVO1, GROOT, VLA_JEPA, WALL_X, XVLA)


def eager_chunk(
    directory: Path, options: LoadOptions, frame: Mapping[str, Array], noise: Array, tokenizer: Path, task: str
) -> tuple[ChunkSpec, Array]:
    """The whole chunk of the rebuilt network, not compiled, in robot units, given the task's tokens if it reads any."""
    module, spec = load_checkpoint_policy(directory, options=options)
    given = {key: value[None] for key, value in frame.items()}
    if spec.instruction is not None and TOKENS not in given:
        length = spec.observations[TOKENS].shape[0]
        own = Tokenizer(tokenizer, CheckpointError).of_task(task, spec.instruction, length)
        given[TOKENS], given[MASK] = padded([own], length)
    seen = {key: as_given(key, given, spec) for key in spec.observations}
    obs = {key: torch.from_numpy(value) for key, value in seen.items()}
    sample = eager_policy(module, spec)(obs, Noise(noise)).numpy()
    return spec.chunk, spec.chunk.unnormalized(sample, spec.chunk.reference(seen))


def rename_weight(directory: Path, before: str, after: str) -> None:
    """Save a policy's weights with another name for one of them."""
    path = directory / "model.safetensors"
    weights = load_file(path)
    weights[after] = weights.pop(before)
    path.unlink()  # it is mapped
    save_file(weights, path)


def assert_refused(
    directory: Path, place: str, changes: Mapping[str, object], message: str, names: Path | None = None
) -> None:
    """A policy is refused with a message where entries of a file, or of a step around it, are others.

    Args:
        directory: of the policy, which is changed.
        place: ``FILE.json``, ``FILE.json/ENTRY/ENTRY`` of what is inside, or ``step/PART`` of a step's name.
        changes: entries there; ``registry_name`` is the name of a step.
        message: regular expression.
        names: the place that the message begins with, where it is told.
    """
    if place.startswith("step/"):
        change_step(directory, place.removeprefix("step/"), changes)
    else:
        name, _, inside = place.partition(".json")
        file = directory / f"{name}.json"
        entries = own = json.loads(file.read_text())
        for part in inside.split("/")[1:]:
            own = own[part]
        own.update(changes)
        file.write_text(json.dumps(entries))
    assert_not_read(directory, message, names=names)


def change_step(directory: Path, name: str, changes: Mapping[str, object]) -> None:
    """Change entries of the steps around a policy whose name holds this one, or, with ``registry_name``, their name."""
    for file in (directory / f"policy_{each}processor.json" for each in ("pre", "post")):
        pipeline = json.loads(file.read_text())
        for step in pipeline["steps"]:
            if name in step["registry_name"]:
                step["registry_name"] = changes.get("registry_name", step["registry_name"])
                step["config"] |= {key: value for key, value in changes.items() if key != "registry_name"}
        file.write_text(json.dumps(pipeline))
