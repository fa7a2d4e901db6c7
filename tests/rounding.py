"""How far two computations of the same thing in floating point may be apart; every tolerance of the tests is from here.

A product or sum that is computed in another order is rounded otherwise: by another library, on another processor, with
another number of threads or of rows. Nothing else may differ. So a tolerance follows from what is computed, and is not
read off the machine that the test was written on.

**Sums.** Added up in any order, n terms are off by at most ``gamma_n = n u / (1 - n u)`` of the sum of their absolute
values, where u is half the distance of 1 to the next number (Higham, *Accuracy and Stability of Numerical Algorithms*,
2nd edition, sections 3.1 and 4.2). Rounding errors are about independent of each other, which makes it ``sqrt(n) u``
with a small factor (section 2.8; Higham and Mary, SIAM J. Sci. Comput. 41, 2019). The factor: a rounding error is
spread over -u..u, standard deviation 0.4 u of the number that is rounded (averaged over the mantissas), and partial
sums grow to the last one, which takes another 0.7; so one sum deviates by 0.3 sqrt(n) u, the difference of two by 0.42.
``FACTOR`` is seven times that: one number in 10^11 is further off.

**Networks.** Sums in sequence add their terms: errors are independent, so their squares are added, and sums of
n_1, n_2, ... terms one after the other are off by ``sqrt(n_1 + n_2 + ...) u``. That holds where an operation hands on
an error as it hands on a number: weights of norm 1, normalised layers, functions of slope 1. The networks of these
tests are drawn like that (``tests/families/weights.py``, torch's own initial weights). So the terms of a network are
all that it adds: the width of each matrix product, the tokens of each attention, the features of each norm, and one for
any other operation. A function such as tanh counts as 16: libraries compute it up to four u off, each in its own way.
``Counted`` counts them while torch computes.

**Loops.** A sampler's last sample is an average of the predictions of its steps: the weights of Euler's steps add up
to one, those of DDPM and DDIM too (of clean samples). An average is no further off than what it is taken of, so a long
loop may be given the terms of one evaluation and those of its updates. For a few steps all evaluations are counted, as
the next prediction hands on errors of the sample, too. A sampler that divides noise by a small signal makes them
larger: ``amplified`` has the weights of its table.

**Waves.** The sine of an angle is off by the error of the angle, however exact the sine: by u times the angle, which at
timestep 1000 is a thousand times u. Frequency and product are each rounded, in two computations: 4 u times the angle of
the fastest wave. Embeddings have waves whose frequencies fall by the same factor, over four decades, and the layer that
follows sums over them: the root of their mean square is ``sqrt(1 / (2 log 10^4))``, a quarter, of the fastest. That
leaves u times the largest angle.

**Promises.** For real policies and their originals the support table promises 1e-5 of the range of the actions. That is
about the bound of one evaluation of networks of that size, and ten times what is found; tests of it have that figure.

What is compared may be larger or smaller than 1, so all of this is times its largest number: an error of a small
element comes from the large ones that it was computed with. ``tests/test_rounding.py`` shows that other orders of
summation stay within these bounds, and that what a defect changes does not.
"""

from __future__ import annotations

from math import prod, sqrt
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ttscompile import SamplerTable

FLOAT32 = 2.0**-24
"""u: half of what 1 and the next number are apart."""

FLOAT64 = 2.0**-53

PROMISED = 1e-5
"""Of the range of the actions: what the support table says of compiled policies and their originals."""

FACTOR = 3
"""By which the difference of two sums may exceed ``sqrt(terms) u``; see above."""


FUNCTIONS = frozenset("exp expm1 log tanh sigmoid gelu silu erf sin cos pow rsqrt softplus mish".split())
"""That count for 16 terms: each library has an approximation of its own."""


def bound(terms: float, angle: float = 0.0, unit: float = FLOAT32) -> float:
    """Largest difference that rounding explains, in units of the largest number compared.

    Args:
        terms: that are added one after the other on the way to the result, as the module says.
        angle: largest angle in radians whose sine or cosine is taken; 0 for a network that is given no timestep, or
            where both sides read the same table of sines.
        unit: u of the type that is computed in.
    """
    return unit * (FACTOR * sqrt(terms) + angle)


def allowed(expected: Any, terms: float, angle: float = 0.0, unit: float = FLOAT32) -> float:
    """The same in the units of ``expected``, an array or a tensor: an absolute tolerance.

    Args:
        expected: what is compared with.
        terms: as for ``bound``.
        angle: as for ``bound``.
        unit: as for ``bound``.
    """
    numbers = np.abs(_array(expected))
    return bound(terms, angle, unit) * float(numbers.max(where=np.isfinite(numbers), initial=0.0))


def assert_equal_but_for_rounding(
    found: Any, expected: Any, terms: float, angle: float = 0.0, unit: float = FLOAT32
) -> None:
    """Both have one shape, and no two numbers are further apart than ``allowed``.

    Args:
        found: an array or a tensor.
        expected: another.
        terms: as for ``bound``.
        angle: as for ``bound``.
        unit: as for ``bound``.

    Raises:
        AssertionError: they are further apart, or of different shapes.
    """
    assert np.shape(_array(found)) == np.shape(_array(expected))
    atol = allowed(expected, terms, angle, unit)
    np.testing.assert_allclose(_array(found), _array(expected), rtol=0, atol=atol)


def _array(value: Any) -> Any:
    """A tensor without its gradient."""
    return np.asarray(value.detach() if isinstance(value, torch.Tensor) else value)


def amplified(terms: float, table: SamplerTable) -> float:
    """Terms of a call, where a table gives the predictions of its steps weights above one in the last sample.

    Errors of K evaluations count by the squares of these weights. They are those of the linear table: a clip makes them
    smaller.

    Args:
        terms: of all evaluations together.
        table: of the call.
    """
    squares = 0.0
    for changed in range(table.steps):
        sample, memory = 0.0, np.zeros(table.memories)
        for k in range(table.steps):
            prediction = float(k == changed)
            clean = table.sample_to_x0[k] * sample + table.out_to_x0[k] * prediction
            known = np.array([clean, sample, prediction, *memory])
            own = np.array(
                [table.x0_to_next[k], table.sample_to_next[k], table.out_to_next[k], *table.memory_to_next[k]]
            )
            sample, memory = float(own @ known), table.to_memory[k] @ known
        squares += sample**2
    return terms * max(1.0, squares / table.steps)


class Counted(TorchDispatchMode):
    """Counts the terms of what torch computes in a ``with`` statement, and its largest angle.

    Attributes:
        terms: as for ``bound``, of all operations on floating point numbers.
        angle: as for ``bound``, of those in float32; what is computed in float64 and then rounded counts as exact.
    """

    def __init__(self) -> None:
        super().__init__()
        self.terms, self.angle = 0, 0.0

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation, and count it; one that consists of others, which inference mode leaves whole, by these."""
        with self:
            parts = op.decompose(*args, **(kwargs or {}))
        if parts is not NotImplemented:
            return parts
        result = op(*args, **(kwargs or {}))
        first = result[0] if isinstance(result, tuple | list) else result
        if isinstance(first, torch.Tensor) and first.is_floating_point() and not op.is_view:
            name = op.overloadpacket.__name__
            self.terms += _terms(name, args, first)
            if name in ("sin", "cos") and first.dtype == torch.float32 and first.numel():
                self.angle = max(self.angle, float(args[0].abs().max()))
        return result


def _terms(name: str, args: Any, result: torch.Tensor) -> int:
    """Terms of one element of an operation's result."""
    if name in ("mm", "bmm", "mv", "dot"):
        return int(args[0].shape[-1])
    if name in ("addmm", "baddbmm"):
        return int(args[1].shape[-1]) + 1
    if name == "convolution":
        return prod(args[1].shape[1:]) + 1
    if "attention" in name:
        return int(args[0].shape[-1] + args[1].shape[-2]) + 16
    if name in ("native_layer_norm", "layer_norm"):
        return prod(args[1])
    if name in ("_softmax", "softmax"):
        return int(args[0].shape[args[1]]) + 16
    if name.removesuffix("_backward").removesuffix("_") in FUNCTIONS:
        return 16
    if name in ("sum", "mean", "var", "native_group_norm"):
        return args[0].numel() // max(result.numel(), 1) or 1
    return 1
