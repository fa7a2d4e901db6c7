"""An example of every row of the table of operations, as the network of a policy would call it.

Each takes ``x``: float32 ``[B, 4, 6]`` between 0.1 and 0.9, and ``i``: int64 ``[B, 4, 6]`` of 0, 1 and 2, and gives a
tensor, or several of which the first one counts.
"""

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

aten = torch.ops.aten

UNARY = """
    clone alias detach relu relu6 silu mish tanh sigmoid softplus elu celu selu leaky_relu log_sigmoid hardswish gelu
    hardtanh hardsigmoid erf erfc special_erf special_erfc special_expit sinc logit exp exp2 expm1 log log2 log10 log1p
    sqrt rsqrt square reciprocal special_expm1 special_log1p sin cos tan sinh cosh asin acos atan asinh atanh arcsin
    arccos arctan deg2rad rad2deg abs absolute sign sgn ceil floor round trunc fix frac nan_to_num neg negative isnan
    isinf isfinite lgamma digamma erfinv i0 special_i0 zeros_like ones_like zero triu tril
    sort argsort glu
"""
BINARY = """
    add sub subtract rsub mul multiply div divide true_divide floor_divide pow float_power remainder fmod atan2 arctan2
    hypot copysign heaviside xlogy logaddexp logaddexp2 maximum minimum max.other min.other fmax fmin eq ne lt le gt ge
    not_equal less less_equal greater greater_equal isclose logical_and logical_or logical_xor copy type_as
    cosine_similarity pairwise_distance
"""
OVER_AXIS = "prod max min argmax argmin any all median nanmedian"
OVER_AXES = "sum mean amax amin std var std_mean var_mean count_nonzero nansum nanmean"
INTEGER = "__and__ __or__ __xor__ bitwise_and bitwise_or bitwise_xor bitwise_left_shift bitwise_right_shift"
"""Of two tensors of integers."""

Example = Callable[[Tensor, Tensor], Any]


def _named(name: str, arguments: Callable[[Tensor, Tensor], tuple[Any, ...]]) -> Example:
    packet = getattr(aten, name.partition(".")[0])
    return lambda x, i: packet(*arguments(x, i))


def square(x: Tensor) -> Tensor:
    """An invertible symmetric matrix a stream."""
    return x[:, :, :4] + x[:, :, :4].mT + 8 * torch.eye(4)


EXAMPLES: dict[str, Example] = {
    **{name: _named(name, lambda x, i: (x,)) for name in UNARY.split()},
    **{name: _named(name, lambda x, i: (x, x.flip(2))) for name in BINARY.split()},
    **{name: _named(name, lambda x, i: (i, i.flip(2))) for name in INTEGER.split()},
    **{name: _named(name, lambda x, i: (x, 2)) for name in OVER_AXIS.split()},
    **{name: _named(name, lambda x, i: (x, [2])) for name in OVER_AXES.split()},
    "norm": lambda x, i: aten.norm(x, 2, [2]),
    "linalg_vector_norm": lambda x, i: torch.linalg.vector_norm(x, dim=2),
    "linalg_norm": lambda x, i: torch.linalg.norm(x, dim=2),
    "getitem": lambda x, i: x.split(2, 2)[1],
    "reshape": lambda x, i: x.reshape(-1, 8, 3),
    "unsqueeze": lambda x, i: x[:, None],
    "squeeze": lambda x, i: x[:, :1].squeeze(1),
    "permute": lambda x, i: x.permute(0, 2, 1),
    "transpose": lambda x, i: x.transpose(1, -1),
    "t": lambda x, i: aten.t(x[:, 0]).mT,
    "slice": lambda x, i: x[:, 1:3],
    "select": lambda x, i: x[:, 1],
    "unbind": lambda x, i: x.unbind(1),
    "split": lambda x, i: x.split(2, 2),
    "split_with_sizes": lambda x, i: x.split([2, 4], 2),
    "diagonal": lambda x, i: x.diagonal(0, 1, 2),
    "expand": lambda x, i: x[:, :1].expand(-1, 3, -1),
    "repeat": lambda x, i: x.repeat(1, 2, 1),
    "tile": lambda x, i: x.tile((1, 2, 1)),
    "repeat_interleave": lambda x, i: x.repeat_interleave(2, 1),
    "flip": lambda x, i: x.flip(1),
    "roll": lambda x, i: x.roll(1, 2),
    "_to_copy": lambda x, i: x.double(),
    "div.Tensor_mode": lambda x, i: torch.div(x, x.flip(2), rounding_mode="floor"),
    "divide.Tensor_mode": lambda x, i: torch.divide(x, x.flip(2), rounding_mode="trunc"),
    "threshold": lambda x, i: F.threshold(x, 0.5, 0.2),
    "acosh": lambda x, i: (x + 1).acosh(),
    "clamp": lambda x, i: x.clamp(0.2, 0.8),
    "clip": lambda x, i: torch.clip(x, 0.2, 0.8),
    "clamp_min": lambda x, i: x.clamp_min(0.2),
    "clamp_max": lambda x, i: x.clamp_max(0.8),
    "where": lambda x, i: torch.where(x > 0.5, x, 0.0),
    "masked_fill": lambda x, i: x.masked_fill(x > 0.5, 1.0),
    "lerp": lambda x, i: torch.lerp(x, x.flip(2), 0.3),
    "addcmul": lambda x, i: torch.addcmul(x, x, x.flip(2)),
    "addcdiv": lambda x, i: torch.addcdiv(x, x, x.flip(2)),
    "logical_not": lambda x, i: (x > 0.5).logical_not(),
    "bitwise_not": lambda x, i: i.bitwise_not(),
    "linear": lambda x, i: F.linear(x, torch.ones(3, 6), torch.ones(3)),
    "matmul": lambda x, i: x @ x.mT,
    "bmm": lambda x, i: torch.bmm(x, x.mT),
    "mm": lambda x, i: torch.mm(x[:, 0], torch.ones(6, 2)),
    "mv": lambda x, i: torch.mv(x[:, 0], torch.ones(6)),
    "dot": lambda x, i: x[:, 0, 0] * torch.dot(torch.arange(3.0), torch.ones(3)),
    "addmm": lambda x, i: torch.addmm(torch.ones(2), x[:, 0], torch.ones(6, 2)),
    "baddbmm": lambda x, i: torch.baddbmm(x[..., :4], x, x.mT),
    "addmv": lambda x, i: torch.addmv(torch.ones(1), x[:, 0], torch.ones(6)),
    "einsum": lambda x, i: torch.einsum("btd,bsd->bts", x, x),
    "tensordot": lambda x, i: torch.tensordot(x, torch.ones(4, 6, 2), ([1, 2], [0, 1])),
    "bilinear": lambda x, i: F.bilinear(x, x, torch.ones(2, 6, 6)),
    "outer": lambda x, i: torch.outer(x[:, 0, 0], torch.arange(3.0)),
    "ger": lambda x, i: torch.ger(x[:, 0, 0], torch.arange(3.0)),
    "kron": lambda x, i: x @ torch.kron(torch.ones(2, 1), torch.ones(3, 2)),
    "conv1d": lambda x, i: F.conv1d(x, torch.ones(2, 4, 3)),
    "conv2d": lambda x, i: F.conv2d(x[:, None], torch.ones(2, 1, 3, 3), padding=1),
    "conv3d": lambda x, i: F.conv3d(x[:, None, None], torch.ones(2, 1, 1, 3, 3)),
    "conv_transpose1d": lambda x, i: F.conv_transpose1d(x, torch.ones(4, 2, 3)),
    "conv_transpose2d": lambda x, i: F.conv_transpose2d(x[:, None], torch.ones(1, 2, 3, 3)),
    "conv_transpose3d": lambda x, i: F.conv_transpose3d(x[:, None, None], torch.ones(1, 2, 1, 3, 3)),
    "layer_norm": lambda x, i: F.layer_norm(x, (6,)),
    "rms_norm": lambda x, i: F.rms_norm(x, (6,), eps=1e-6),
    "scaled_dot_product_attention": lambda x, i: F.scaled_dot_product_attention(x[:, None], x[:, None], x[:, None]),
    "softmax": lambda x, i: x.softmax(2),
    "log_softmax": lambda x, i: x.log_softmax(2),
    "cumsum": lambda x, i: x.cumsum(1),
    "cumprod": lambda x, i: x.cumprod(1),
    "gru.input": lambda x, i: torch.gru(x, _state(x), _gates(3), True, 1, 0.0, False, False, True),
    "lstm.input": lambda x, i: torch.lstm(x, [_state(x), _state(x)], _gates(4), True, 1, 0.0, False, False, True),
    "zeros": lambda x, i: x[:, 0, :2] + torch.zeros(x.shape[0], 2),
    "ones": lambda x, i: x[:, 0, :2] + torch.ones(x.shape[0], 2),
    "full": lambda x, i: x[:, 0, :2] + torch.full((x.shape[0], 2), 0.5),
    "new_zeros": lambda x, i: x[:, 0, :2] + x.new_zeros(x.shape[0], 2),
    "new_ones": lambda x, i: x[:, 0, :2] + x.new_ones(x.shape[0], 2),
    "new_full": lambda x, i: x[:, 0, :2] + x.new_full((x.shape[0], 2), 0.5),
    "full_like": lambda x, i: torch.full_like(x, 0.5),
    "fill": lambda x, i: aten.fill(x, 0.5),
    "inner": lambda x, i: torch.inner(x, torch.ones(3, 6)),
    "empty_like": lambda x, i: torch.empty_like(x).fill_(2.0),
    "empty": lambda x, i: x * torch.empty(6).fill_(2.0),
    "new_empty": lambda x, i: x * x.new_empty(6).fill_(2.0),
    "arange": lambda x, i: x + torch.arange(6),
    "linspace": lambda x, i: x + torch.linspace(0, 1, 6),
    "logspace": lambda x, i: x + torch.logspace(0, 1, 6),
    "eye": lambda x, i: x @ torch.eye(6),
    "scalar_tensor": lambda x, i: x + torch.scalar_tensor(0.5),
    "meshgrid": lambda x, i: torch.meshgrid(x[:, 0, 0], torch.arange(3.0), indexing="ij"),
    "cat": lambda x, i: torch.cat([x, x], 2),
    "concat": lambda x, i: torch.concat([x, x], 2),
    "stack": lambda x, i: torch.stack([x, x], 1),
    "pad": lambda x, i: F.pad(x, (1, 1)),
    "constant_pad_nd": lambda x, i: aten.constant_pad_nd(x, (1, 1)),
    "logsumexp": lambda x, i: x.logsumexp(2),
    "topk": lambda x, i: x.topk(2, 2),
    "diff": lambda x, i: x.diff(dim=1),
    "trapezoid": lambda x, i: torch.trapezoid(x, dim=1),
    "cummax": lambda x, i: x.cummax(1),
    "cummin": lambda x, i: x.cummin(1),
    "quantile": lambda x, i: x.quantile(0.5, 2),
    "kthvalue": lambda x, i: x.kthvalue(2, 2),
    "index": lambda x, i: x[:, [0, 2]],
    "index_select": lambda x, i: x.index_select(1, torch.tensor([2, 0])),
    "gather": lambda x, i: x.gather(1, i),
    "take_along_dim": lambda x, i: x * torch.take_along_dim(torch.arange(6.0)[None], torch.tensor([[2]]), 1),
    "embedding": lambda x, i: F.embedding(i, torch.arange(6.0).view(3, 2)),
    "one_hot": lambda x, i: F.one_hot(i, 3),
    "isin": lambda x, i: torch.isin(i, torch.tensor([0, 2])),
    "bucketize": lambda x, i: torch.bucketize(x, torch.tensor([0.3, 0.6])),
    "searchsorted": lambda x, i: torch.searchsorted(torch.tensor([0.3, 0.6]), x),
    "index_put": lambda x, i: aten.index_put(x, [None, torch.tensor([1])], x[:, :1]),
    "index_add": lambda x, i: x.index_add(1, torch.tensor([1]), x[:, :1]),
    "index_copy": lambda x, i: x.index_copy(1, torch.tensor([1]), x[:, :1]),
    "index_fill": lambda x, i: x.index_fill(1, torch.tensor([1]), 0.5),
    "scatter": lambda x, i: x.scatter(1, i, 0.5),
    "scatter_add": lambda x, i: x.scatter_add(1, i, x),
    "select_scatter": lambda x, i: torch.select_scatter(x, x[:, 0], 1, 2),
    "slice_scatter": lambda x, i: torch.slice_scatter(x, x[:, :1], 1, 2, 3),
    "group_norm": lambda x, i: F.group_norm(x, 2),
    "instance_norm": lambda x, i: F.instance_norm(x),
    "_native_batch_norm_legit_no_training": lambda x, i: F.batch_norm(x, torch.zeros(4), torch.ones(4)),
    "avg_pool1d": lambda x, i: F.avg_pool1d(x, 2),
    "avg_pool2d": lambda x, i: F.avg_pool2d(x[:, None], 2),
    "max_pool1d": lambda x, i: F.max_pool1d(x, 2),
    "max_pool2d": lambda x, i: F.max_pool2d(x[:, None], 2),
    "adaptive_avg_pool1d": lambda x, i: F.adaptive_avg_pool1d(x, 2),
    "adaptive_avg_pool2d": lambda x, i: F.adaptive_avg_pool2d(x[:, None], (1, 1)),
    "upsample_nearest1d": lambda x, i: F.interpolate(x, scale_factor=2),
    "upsample_nearest2d": lambda x, i: F.interpolate(x[:, None], scale_factor=2),
    "upsample_linear1d": lambda x, i: F.interpolate(x, 8, mode="linear"),
    "upsample_bilinear2d": lambda x, i: F.interpolate(x[:, None], (8, 12), mode="bilinear"),
    "upsample_bicubic2d": lambda x, i: F.interpolate(x[:, None], (8, 12), mode="bicubic"),
    "pixel_shuffle": lambda x, i: F.pixel_shuffle(x[..., None], 2),
    "pixel_unshuffle": lambda x, i: F.pixel_unshuffle(x[:, None], 2),
    "im2col": lambda x, i: F.unfold(x[:, None], 2),
    "unfold": lambda x, i: x.unfold(1, 2, 1),
    "grid_sampler": lambda x, i: F.grid_sample(x[:, None], x[:, :, None, :2], align_corners=False),
    "prelu": lambda x, i: F.prelu(x - 0.5, torch.full((1,), 0.3)),
    "cross": lambda x, i: torch.cross(x[..., :3], x[..., 3:], 2),
    "linalg_cross": lambda x, i: torch.linalg.cross(x[..., :3], x[..., 3:]),
    "broadcast_tensors": lambda x, i: aten.broadcast_tensors([x, x[:, :1]]),
    "block_diag": lambda x, i: x @ torch.block_diag(torch.ones(3, 3), torch.ones(3, 3)),
    "diag_embed": lambda x, i: torch.diag_embed(x[:, 0]),
    "rot90": lambda x, i: x.rot90(1, (1, 2)),
    "cdist": lambda x, i: torch.cdist(x, x),
    "_weight_norm": lambda x, i: x @ torch._weight_norm(torch.ones(6, 2), torch.ones(6, 1)),
    "linalg_det": lambda x, i: torch.linalg.det(square(x)),
    "linalg_eigh": lambda x, i: torch.linalg.eigh(square(x)),
    "linalg_inv": lambda x, i: torch.linalg.inv(square(x)),
    "linalg_solve": lambda x, i: torch.linalg.solve(square(x), x),
    "linalg_qr": lambda x, i: torch.linalg.qr(square(x)),
    "linalg_cholesky": lambda x, i: torch.linalg.cholesky(square(x)),
    "matrix_exp": lambda x, i: torch.matrix_exp(x[:, :, :4]),
}
"""By the name of the row."""


def _state(x: Tensor) -> Tensor:
    """The first state of a recurrent layer of width 5."""
    return x[:, 0, :5].unsqueeze(0)


def _gates(number: int) -> list[Tensor]:
    """Weights of a recurrent layer from 6 channels to 5."""
    return [torch.ones(number * 5, 6), torch.ones(number * 5, 5), torch.ones(number * 5), torch.ones(number * 5)]
