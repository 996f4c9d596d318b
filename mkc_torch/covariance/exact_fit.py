"""Samples of which h lie on a hyperplane: their covariance is singular, and the hyperplane is reported."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.small_factors import symmetric_eigen
from mkc_torch.covariance._concentration import FAR, singular_below
from mkc_torch.covariance._moments import moments_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mkc_torch.covariance._sample import Sample

_TERMS_SHOWN = 6
"""Terms of the hyperplane's equation in the message, at most."""


class ExactFitError(ValueError):
    """So many samples lie on a hyperplane ``normal · x = offset`` that a robust scatter is singular.

    Attributes:
        normal: unit normal of the hyperplane, (p,).
        offset: offset of the hyperplane, in the unit of the data.
        samples: mask of the samples on the hyperplane, (N,).
        problem: index of the first such problem in the batch dimensions.
        columns: numbers of the columns in the message.
    """

    def __init__(
        self,
        normal: Float[Tensor, p],
        offset: float,
        samples: Bool[Tensor, N],
        problem: tuple[int, ...] = (),
        columns: Sequence[int] | None = None,
        involved: Sequence[int] | None = None,
    ) -> None:
        self.normal, self.offset, self.samples, self.problem = normal, offset, samples, problem
        p = normal.shape[0]
        self.columns = tuple(range(p) if columns is None else columns)
        self._involved = tuple(range(p) if involved is None else involved)
        on, N = int(samples.sum()), samples.shape[0]
        where = f" of problem {problem}" if problem else ""
        above = f", or, if the samples off it matter, take `h` well above {on}" if on < N else ""
        super().__init__(
            f"Expected samples in general position but {on} of {N}{where} lie on the hyperplane {self._equation()}, "
            f"so that the scatter is singular; leave out one of these columns{above}. The error has `normal`, `offset` "
            "and `samples`."
        )

    def __reduce__(self) -> tuple[type[ExactFitError], tuple[object, ...]]:
        return type(self), (
            self.normal, self.offset, self.samples, self.problem, self.columns, self._involved,
        )  # fmt: skip

    def among(self, columns: Sequence[int]) -> ExactFitError:
        """The same error with the columns renumbered."""
        return ExactFitError(self.normal, self.offset, self.samples, self.problem, columns, self._involved)

    def _equation(self) -> str:
        terms = [(float(self.normal[j]), self.columns[j]) for j in self._involved]
        text = " ".join(f"{'-' if a < 0 else '+'} {abs(a):.4g}·x{column}" for a, column in terms[:_TERMS_SHOWN])
        text = f"-{text[2:]}" if text.startswith("-") else text[2:]
        return f"{text}{' + …' if len(terms) > _TERMS_SHOWN else ''} = {self.offset:.6g}"


def refuse_exact_fit(sample: Sample, counts: Bool[Tensor, "B N"]) -> None:
    """Raise ExactFitError if a support lies on a hyperplane, within the rounding of the values.

    Raises:
        ExactFitError: for the first such problem.
        ValueError: the support contains an outlier so far out that rounding hides the other samples.
    """
    points = sample.standardised
    mean, covariance = moments_of(points, counts, torch.zeros_like(sample.centre))
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt().clamp(min=singular_below(points.dtype))
    shape = covariance / deviation.unsqueeze(-1) / deviation.unsqueeze(-2)
    least, direction = (part[..., 0] for part in symmetric_eigen(shape))
    flat = least <= (2.0 * sample.resolution).square().clamp(min=singular_below(points.dtype))
    if not flat.any():
        return
    b = int(flat.nonzero()[0])
    if float(deviation[b].max()) > FAR:
        raise ValueError(
            f"Expected argument `X` whose support has no far outlier but h = {int(counts[b].sum())} includes an "
            "outlier so far out that rounding hides the other samples; take a smaller `h`."
        )
    across = direction[b] / deviation[b]
    height = torch.matmul(points[b] - mean[b], across).abs()
    rounding = sample.resolution[b] * torch.matmul(points[b].abs() + 1.0, across.abs())
    on = height <= 2.0 * height[counts[b]].max() + 8.0 * rounding
    normal = across / sample.scale[b]
    normal = normal / torch.linalg.vector_norm(normal)
    normal = normal * torch.sign(normal[normal.abs().argmax()])
    at = sample.centre[b] + sample.scale[b] * mean[b]
    problem = tuple(int(i) for i in torch.unravel_index(torch.tensor(b), sample.batch)) if sample.batch else ()
    share = (across * deviation[b]).abs()
    involved = (share > 1e-6 * share.max()).nonzero().flatten().tolist()
    raise ExactFitError(normal.to(sample.dtype), float(torch.dot(normal, at)), on, problem, involved=involved)
