"""The manifest of an artifact: everything about a compiled policy that is not an array or a graph.

Frozen records; ``codec`` writes and reads them. ``docs/design.md`` section 5.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from ..core.correction import Correction, numbers_of
from ..core.lattice import PlanArray, plan_flops
from ..core.plan import ORIGINAL, UNIFORM, TokenReuse
from ..core.rules import OMITTED, LoopName, Positive, Rule, Sha256, Share
from ..core.spec import FP32, INT4, INT8, PolicySpec, SamplerTable
from ..ir.graph import TensorType
from ..ir.pieces import BLOCKS, PRUNER, is_block, part_of
from ..ir.program import Binding
from .towers import TokensRecord

FORMAT = "ttscompile artifact"
SCHEMA_VERSION = 12
MANIFEST = "manifest.json"

FileName = Annotated[
    str,
    Rule(
        "a plain file name: no folder, no leading dot, not manifest.json",
        lambda name: re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}", name) and name != MANIFEST,
    ),
]
PLAN_NAME = Rule("letters, digits and _ . % -", re.compile(r"[A-Za-z0-9][A-Za-z0-9_.%-]{0,63}").fullmatch)
PlanName = Annotated[str, PLAN_NAME]
Version = Annotated[str, Rule("a version like 1.23", re.compile(r"[0-9]{1,9}(\.[0-9]{1,9}){0,9}").fullmatch)]
FEW = Rule("at most 256 entries", lambda them: len(them) <= 256)
MANY = Rule("at most 4096 entries", lambda them: len(them) <= 4096)
"""Of what each is held against the others, and of what there is one a block or a piece. Push-T has 24 blocks."""
OfContext = Annotated[
    Binding, Rule("table, condition or step", (Binding.TABLE, Binding.CONDITION, Binding.STEP).__contains__)
]


@dataclass(frozen=True)
class BlockRecord:
    """One residual block; its index is its position in ``Manifest.blocks``.

    Attributes:
        kind: ``self_attention``, ``cross_attention``, ``feed_forward`` or a structural signature.
        type: of the residual, and of the residual stream that it is added to.
        group: number of its FORWARD group.
        flops: of one evaluation for one stream.
        reason: why it is coarse; empty for a plain residual.
    """

    kind: str
    type: TensorType
    group: int
    flops: int
    reason: str


@dataclass(frozen=True)
class PieceRecord:
    """One ONNX graph.

    Attributes:
        inputs: names of all its inputs, in order.
        stream: the input that carries the sample (``stem``) or the residual stream (blocks, ``advance``); None for the
            pieces outside the loop.
        contexts: the values that its other inputs want: names in ``Manifest.contexts``. The input of a context has the
            name of the context, in ``advance`` after ``tail.`` or ``stem.``, in ``dense_step`` after ``context.``.
        outputs: names of its outputs, in order.
    """

    file: FileName
    inputs: tuple[str, ...]
    stream: str | None
    contexts: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class ContextRecord:
    """A value that the loop reads beside the residual stream: when it is known, and what it is for one step."""

    binding: OfContext
    type: TensorType


@dataclass(frozen=True)
class FlopsRecord:
    """FLOPs for one stream, multiply and add counted as two.

    Attributes:
        dense: one call of the captured denoiser as it was: K evaluations.
        prologue: once a call: condition, step values for all K steps, and what a correction reads of the condition.
        pruner: once a call.
        stem: one evaluation of sample to stream; there are K a call.
        tail: one evaluation of stream to prediction, and of a correction; there are K a call.
        blocks: one evaluation of each block.
    """

    dense: int
    prologue: int
    pruner: int
    stem: int
    tail: int
    blocks: tuple[int, ...]

    def call(self, plan: PlanArray, pruned: bool, correction: Correction | None = None) -> float:
        """FLOPs of one call of one stream with a plan, int8 ``[K, blocks]``, and its correction, whose jumps count.

        ``pruned`` says whether the pruner ran to make the plan.
        """
        fixed = 0 if correction is None else correction.flops_of_jumps
        fixed += self.prologue + (self.pruner if pruned else 0) + len(plan) * (self.stem + self.tail)
        return fixed + plan_flops(plan, self.blocks)

    def ceiling(self, steps: int) -> float:
        """How many times the FLOPs of a call are that computes step 0 alone, in a dense call: no plan saves more."""
        fixed, blocks = self.prologue + steps * (self.stem + self.tail), sum(self.blocks)
        return (fixed + steps * blocks) / (fixed + blocks)


@dataclass(frozen=True)
class StartRecord:
    """A loop that is the last steps of another, and begins with the chunk of the call before (``core.start``).

    Attributes:
        loop: name of the other, which begins with noise.
        steps: how many of its steps are left.
    """

    loop: str
    steps: Positive


@dataclass(frozen=True)
class PlanRecord:
    """A plan of the artifact. ``core.plan.Plan`` says what its fields mean.

    Attributes:
        kind: where its cells are: ``schedule``, in the file of plans; ``pruner``, made for each observation; ``all``,
            every cell is computed.
        otherwise: name of the plan of a call that has no chunk to begin with; None for loops that begin with noise.
        sparsity: share of reused cells; of a pruner the measured mean, None if it was not measured.
        flops_sparsity: the same with each cell weighed by its FLOPs.
    """

    kind: Literal["schedule", "pruner", "all"]
    loop: str = ORIGINAL
    weights: str = ORIGINAL
    precision: Mapping[str, str] = field(default_factory=dict)
    tokens: TokenReuse | None = None
    otherwise: str | None = None
    sparsity: Share | None = 0.0
    flops_sparsity: Share | None = 0.0

    @property
    def pruned(self) -> bool:
        """Whether the pruner makes its cells."""
        return self.kind == PRUNER


@dataclass(frozen=True)
class FileRecord:
    """What a file of the artifact must be."""

    sha256: Sha256
    bytes: int


@dataclass(frozen=True)
class Stores:
    """Names of the files that are not ONNX; None where the artifact has none.

    Attributes:
        program: graphs of all pieces.
        weights: constants of all pieces but the pruner's, and tables.
        plans: schedules and corrections.
        golden: what the original network answered (``artifact.golden``).
        golden_plans: what the reference runtime made of the plans when they were calibrated.
        tokenizer: what makes an instruction's text the policy's tokens.
    """

    program: FileName
    weights: FileName
    pruner: FileName | None
    plans: FileName | None
    golden: FileName | None = None
    golden_plans: FileName | None = None
    tokenizer: FileName | None = field(default=None, metadata=OMITTED)


@dataclass(frozen=True)
class Requires:
    """What the ONNX graphs need: the least onnxruntime, and their opset."""

    onnxruntime: Version
    opset: Positive


@dataclass(frozen=True)
class PrecisionRecord:
    """Parts with weights of another precision than fp32, which the artifact holds beside those in fp32.

    Attributes:
        name: ``int8``; or ``int4``, which is of blocks, prefix and step, beside frame pieces in int8.
        weights: name of the file with their weights.
        models: name of the ONNX file by piece, where it is not the file of the piece: of blocks, and with them of the
            pieces that hold all of them; and of pieces of the prologue.
        asked: parts (``ir.pieces.part_of``) that stay fp32 because it was asked for.
        fp32: name of the file with what is read in fp32 alone. A copy of the artifact may lack it, and computes no plan
            in fp32 then. None where that would save little.
    """

    name: Annotated[str, Rule("one of 'int8', 'int4'", (INT8, INT4).__contains__)]
    weights: FileName
    models: Mapping[str, FileName]
    asked: tuple[str, ...] = ()
    fp32: FileName | None = field(default=None, metadata=OMITTED)

    @property
    def files(self) -> set[str]:
        """Names of all its files."""
        return {self.weights, *self.models.values()} | ({self.fp32} if self.fp32 else set())

    @property
    def blocks(self) -> int:
        """How many residual blocks have such weights."""
        return sum(map(is_block, self.models))

    @property
    def kept(self) -> tuple[str, ...]:
        """The parts that have such weights, those of the prologue first."""
        own = {str(part_of(piece)) for piece in self.models}
        return tuple(sorted(own, key=lambda part: (part == BLOCKS, part)))

    @property
    def told(self) -> str:
        """``int8 in blocks and condition``."""
        return f"{self.name} in {' and '.join(self.kept)}"


@dataclass(frozen=True)
class WeightsRecord:
    """Weights of residual blocks that a plan may have in place of the original's; both are in the artifact.

    Attributes:
        weights: name of the file with the constants that differ.
        models: name of the ONNX file by piece, of each block and of the pieces that hold all of them.
        precision_weights: name of the file with what the artifact's other precision makes of them; None where no block
            has another precision.
        precision_models: name of the ONNX file by piece, of those of these that have another precision.
    """

    weights: FileName
    models: Mapping[str, FileName]
    precision_weights: FileName | None
    precision_models: Mapping[str, FileName]

    @property
    def files(self) -> set[str]:
        """Names of all its files."""
        own = {self.weights, *self.models.values(), *self.precision_models.values()}
        return own if self.precision_weights is None else own | {self.precision_weights}


@dataclass(frozen=True)
class Manifest:
    """The manifest.

    Attributes:
        identity: sha256 of what the artifact computes; independent of paths, time and calibration record.
        model_identity: the same without plans and pruner weights: what a calibration belongs to.
        spec: the policy beside its network.
        blocks: block table, in order of execution.
        pieces: ONNX graphs: ``condition``, ``step``, ``pruner``, ``stem``, ``advance``, ``block_00``...; those that the
            policy has; ``blocks``, all of its blocks in one (``ir.pieces``); of one block alone ``layers``; and
            ``pixels_00`` and ``tokens_00`` of each frame piece in ``tokens``.
        contexts: binding and type of every context.
        features: condition values that the pruner reads, and corrections.
        plans: beside ``dense``, by name.
        default_plan: ``dense`` or a name in ``plans``.
        calibration: record of the calibration, JSON (``codec.check_record``); None before any.
        stores: names of the files that are not ONNX.
        files: every file but the manifest.
        precision: models in another precision than fp32, which plans may take; None if there are none.
        loop_pruners: by further loop with a pruner of its own, name of the file with its constants.
        starts: by name, the loops that begin with the chunk of the call before. The others are in ``spec``.
        weights: by name, the weights that plans may have in place of the original's.
        tokens: by frame piece, the tokens of those that are vision transformers.
    """

    schema_version: int
    ttscompile_version: str
    identity: Sha256
    model_identity: Sha256
    spec: PolicySpec
    blocks: Annotated[tuple[BlockRecord, ...], MANY]
    pieces: Annotated[Mapping[str, PieceRecord], MANY]
    contexts: Annotated[Mapping[str, ContextRecord], MANY]
    features: tuple[str, ...]
    flops: FlopsRecord
    plans: Annotated[Mapping[PlanName, PlanRecord], FEW]
    default_plan: str
    calibration: Mapping[str, Any] | None
    stores: Stores
    requires: Requires
    files: Annotated[Mapping[FileName, FileRecord], MANY]
    precision: PrecisionRecord | None = None
    loop_pruners: Annotated[Mapping[LoopName, FileName], FEW] = field(default_factory=dict)
    starts: Annotated[Mapping[LoopName, StartRecord], FEW] = field(default_factory=dict)
    weights: Annotated[Mapping[PlanName, WeightsRecord], FEW] = field(default_factory=dict)
    tokens: Annotated[Mapping[str, TokensRecord], FEW] = field(default_factory=dict)

    @property
    def loops(self) -> tuple[str, ...]:
        """Names of all loops, the original's first."""
        return (ORIGINAL, *self.spec.loops, *self.starts)

    @property
    def precision_name(self) -> str:
        """The precision that some parts have models of beside fp32; ``fp32`` where none has."""
        return FP32 if self.precision is None else self.precision.name

    @property
    def held(self) -> dict[str, str]:
        """By part, the precision beside fp32 that there are models of."""
        return {} if self.precision is None else dict.fromkeys(self.precision.kept, self.precision.name)

    @property
    def apart(self) -> str | None:
        """Name of the file with what is read in fp32 alone; None where nothing stands apart."""
        return None if self.precision is None else self.precision.fp32

    @property
    def pruner_files(self) -> dict[str, str | None]:
        """By loop that has a pruner of its own, the file with its constants; None for the original if it has none."""
        return {ORIGINAL: self.stores.pruner, **self.loop_pruners}

    def whole_loop(self, loop: str) -> str:
        """The loop whose last steps this one is, where it begins with a chunk; itself where it begins with noise."""
        return self.starts[loop].loop if loop in self.starts else loop

    def steps_of(self, loop: str) -> int:
        """K of a loop, whatever it begins with."""
        start = self.starts.get(loop)
        return self.sampler_of(loop).steps if start is None else start.steps

    def sampler_of(self, loop: str) -> SamplerTable:
        """The table of a loop that begins with noise."""
        return self.spec.sampler if loop == ORIGINAL else self.spec.loops[loop]

    @property
    def models(self) -> set[str]:
        """Names of all files that onnxruntime is given as models, whatever they are called."""
        own = {piece.file for piece in self.pieces.values()}
        if self.precision is not None:
            own |= set(self.precision.models.values())
        for weights in self.weights.values():
            own |= {*weights.models.values(), *weights.precision_models.values()}
        return own

    @property
    def acting(self) -> dict[str, FileRecord]:
        """The files that actions depend on: all but those that only ``verify`` reads."""
        golden = (self.stores.golden, self.stores.golden_plans)
        return {name: record for name, record in self.files.items() if name not in golden}

    @property
    def steps(self) -> int:
        """K of the original loop."""
        return self.spec.sampler.steps

    @property
    def condition_numbers(self) -> int:
        """N: how many numbers of one stream's condition a correction may read; 0 where there are too many."""
        return numbers_of(self.contexts[name].type.at(1) for name in self.features)

    @property
    def groups(self) -> tuple[int, ...]:
        """FORWARD group of each block, as ``lattice`` wants them."""
        return tuple(block.group for block in self.blocks)

    @property
    def short_identity(self) -> str:
        """Of the identity what people are shown."""
        return abbreviated(self.identity)


def abbreviated(identity: str) -> str:
    """The first 12 digits of an identity, for people; JSON has all 64."""
    return identity[:12]


def marked(plan: str) -> str:
    """The name of a plan in a table: the baseline, which no robot should run, is called so."""
    return plan + " (baseline)" * (plan == UNIFORM)
