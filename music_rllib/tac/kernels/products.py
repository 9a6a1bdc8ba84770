"""The matrix products of a perceptron, by the library that is faster on this CPU.

PyTorch leaves float32 products to MKL, which uses AVX-512 on Intel's CPUs only; it has oneDNN too,
which uses it everywhere. AMD's Zen 5 computes 512 bits at once, so that there oneDNN has twice
MKL's rate; Zen 4 takes them in two halves, as fast as AVX2 (docs/performance.md has a table). The
choice follows from the machine's description and not from a measurement: a seed has to give the
same numbers.

Shape legend: R rows, I inputs, O outputs of a layer. Results are written to `out` where the library
can, and returned.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import torch
from torch import Tensor

from music_rllib.tac.kernels.precision import cpu_family, cpu_flags, cpu_vendor

__all__ = ["Blas", "OneDnn", "Products", "has_onednn", "onednn_product", "products"]

_pass_where_positive = torch.ops.aten.threshold_backward.grad_input


class Products(Protocol):
    """What a layer and its derivatives are made of."""

    def hidden(self, inputs: Tensor, weight: Tensor, bias: Tensor, out: Tensor) -> Tensor:
        """relu(inputs @ weight + bias): [R, I], [I, O], [O] -> [R, O]."""

    def through(self, gradient: Tensor, weight: Tensor, below: Tensor, out: Tensor) -> Tensor:
        """The gradient [R, O] of a layer's output, before its inputs' ReLU gave `below` [R, I]."""

    def of_weight(self, inputs: Tensor, gradient: Tensor, out: Tensor) -> None:
        """Sum of the rows' outer products: [R, I], [R, O] -> [I, O]."""


class Blas:
    """PyTorch's own products."""

    def hidden(self, inputs: Tensor, weight: Tensor, bias: Tensor, out: Tensor) -> Tensor:
        return torch.addmm(bias, inputs, weight, out=out).relu_()

    def through(self, gradient: Tensor, weight: Tensor, below: Tensor, out: Tensor) -> Tensor:
        torch.mm(gradient, weight.t(), out=out)
        _pass_where_positive(out, below, 0, grad_input=out)
        return out

    def of_weight(self, inputs: Tensor, gradient: Tensor, out: Tensor) -> None:
        torch.mm(inputs.t(), gradient, out=out)


# The overload, since to choose it at each call takes a tenth of a small product's time. It has no
# public name; it is what torch.compile makes of a linear layer on a CPU.
try:
    _linear_pointwise: Any = torch.ops.mkldnn._linear_pointwise.default
except AttributeError:
    _linear_pointwise = None
_shuffle_channels = torch.ops.aten.native_channel_shuffle.default

_NARROW = 16
"""With fewer rows or columns, oneDNN takes longer to call than it saves."""


class OneDnn(Blas):
    """oneDNN's products where matrices are wide enough; it makes a new tensor of each."""

    def hidden(self, inputs: Tensor, weight: Tensor, bias: Tensor, out: Tensor) -> Tensor:
        if _is_narrow(inputs, weight):
            return super().hidden(inputs, weight, bias, out)
        hidden: Tensor = _linear_pointwise(inputs, weight.t(), bias, "relu", [], "")
        return hidden

    def through(self, gradient: Tensor, weight: Tensor, below: Tensor, out: Tensor) -> Tensor:
        if _is_narrow(gradient, weight):
            return super().through(gradient, weight, below, out)
        product = onednn_product(gradient, weight)
        _pass_where_positive(product, below, 0, grad_input=product)
        return product

    def of_weight(self, inputs: Tensor, gradient: Tensor, out: Tensor) -> None:
        if _is_narrow(inputs, gradient):
            super().of_weight(inputs, gradient, out)
        # oneDNN takes a copy of the first factor, which is transposed: cheaper of the narrower one.
        elif gradient.shape[1] < inputs.shape[1] // 2:
            out.t().copy_(onednn_product(_transposed(gradient), inputs.t()))
        else:
            out.copy_(onednn_product(_transposed(inputs), gradient.t()))


def onednn_product(left: Tensor, right: Tensor) -> Tensor:
    """[M, K], [N, K] -> [M, N], float32 by oneDNN."""
    product: Tensor = _linear_pointwise(left, right, None, "none", [], "")
    return product


def _is_narrow(left: Tensor, right: Tensor) -> bool:
    return any(size < _NARROW for size in (*left.shape, *right.shape))


def _transposed(matrix: Tensor) -> Tensor:
    """[M, N] -> [N, M], a copy, in two thirds of the time of `t().contiguous()`.

    With their channels last, M groups of N channels are shuffled by a transposition in AVX-512.
    """
    rows, columns = matrix.shape
    size = rows * columns
    channels = matrix.contiguous().as_strided((1, size, 1, 1), (size, 1, size, size))
    transposed: Tensor = _shuffle_channels(channels, rows).as_strided((columns, rows), (rows, 1))
    return transposed


def has_onednn() -> bool:
    """Whether this build of PyTorch has what `OneDnn` calls."""
    return torch.backends.mkldnn.is_available() and _linear_pointwise is not None


@functools.cache
def products() -> Products:
    """Those for this machine."""
    zen_5 = cpu_vendor() == "AuthenticAMD" and cpu_family() >= 26 and "avx512f" in cpu_flags()
    return OneDnn() if zen_5 and has_onednn() else Blas()
