"""What is left out of a model that torch's exporter wrote: constants that can be computed now, and detours.

onnxscript's own ``optimize`` tries 46 rules at every operation, which takes a third of an export. The rules here are
those that have changed a model of this project, so its models come out the same, to the byte. onnxruntime knows the
others, and applies them where it opens a model.
"""

import onnx_ir as ir
import onnx_ir.passes.common as common
from onnxscript import optimizer
from onnxscript.rewriter import RewritePass, onnx_fusions
from onnxscript.rewriter.rules import common as rules

RULES = (
    rules.materialize_reshape_shape_rule,
    rules.squeeze_reshape_1d_rule,
    rules.reshape_reshape_rule,
    rules.transpose_transpose_rule,
    rules.remove_optional_bias_from_conv_rule,
)
_UNUSED = ir.passes.Sequential(common.RemoveUnusedNodesPass(), common.RemoveUnusedOpsetsPass())
_TIDY = ir.passes.Sequential(
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
    common.LiftSubgraphInitializersToMainGraphPass(),
    common.DeduplicateInitializersPass(),
    common.CommonSubexpressionEliminationPass(),
    common.OutputFixPass(),
    common.NameFixPass(),
)
ROUNDS = 2
"""Folding makes room for rules, and these for folding."""


def simplify(model: ir.Model) -> None:
    """Simplify a model of torch's exporter in place; its inputs and outputs stay."""
    rewrite = RewritePass(RULES)
    optimizer.inline(model)
    for _ in range(ROUNDS):
        folded = optimizer.fold_constants(model, onnx_shape_inference=True).modified
        changed = rewrite(model).modified
        if not (_UNUSED(model).modified or folded or changed):
            break
    _TIDY(model)
    onnx_fusions.fuse(model)
