"""The MKC density as a torch distribution."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from mkc_torch._support.arguments import (
    as_numbers,
    first_of,
    format_value,
    refuse_complex,
    refuse_no_tensor,
    refuse_other_shapes,
)
from mkc_torch.density.energy import as_computed, energy, inverse_square
from mkc_torch.density.head import head_rule, tail_density
from mkc_torch.density.normalizer import log_partition, partition, refuse_bad_ratio

if TYPE_CHECKING:
    from jaxtyping import Float

SIGMA_MIN = 0.05
_Shape = torch.Size | list[int] | tuple[int, ...]
_Integrand = Callable[[Tensor, Tensor], Tensor]
_CHUNK = 1 << 16
_MAX_ITERATIONS = 200


class _Finite(constraints.Constraint):
    """Positive and finite: a flat tail on an infinite domain has no density."""

    def check(self, value: Tensor) -> Tensor:
        return (value > 0.0) & (value < torch.inf)


class MKCDistribution(Distribution):
    """Distribution with a Gaussian head and heavy tails on a bounded domain, (17) of Li et al. (2023).

    The head is a Gaussian of standard deviation ``d``, the tail is flat at ``exp(-sigma²)`` of the peak, and the domain
    is ``[loc - bound, loc + bound]``. ``sigma = inf`` is the Gaussian truncated to the domain.

    Args:
        sigma: bandwidth in [0.05, inf], dimensionless.
        d: scale > 0, in the unit of the values.
        bound: half-width of the domain, above 0 and finite, in the unit of the values.
        loc: centre.
        validate_args: whether to check the values of all arguments. By default they are checked except in compiled
            code. (The first ``torch.compile`` switches off torch's own default for the whole process.)

    The parameters broadcast. ``rsample`` and ``icdf`` are differentiable once in all four by implicit differentiation
    of the distribution function.

    Raises:
        TypeError: a parameter that is neither a number nor a tensor, or a value that is not a tensor.
        ValueError: a parameter out of range, a value outside the domain, or shapes that do not broadcast.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), Theorem 2, Corollary 1.
        Figurnov et al., "Implicit reparameterization gradients" (2018), for ``rsample``.

    Example:
        >>> p = MKCDistribution(sigma=2.0, d=1.0, bound=10.0)
        >>> p.log_prob(torch.tensor([0.0, 9.0]))
        tensor([-1.1224, -5.1222])
        >>> p.cdf(torch.tensor(0.0))
        tensor(0.5000)
    """

    arg_constraints = {  # noqa: RUF012 - a class attribute of torch.distributions
        "sigma": constraints.greater_than_eq(SIGMA_MIN),
        "d": _Finite(),
        "bound": _Finite(),
        "loc": constraints.real,
    }
    has_rsample = True

    def __init__(
        self,
        sigma: Float[Tensor, "*batch"] | float,
        d: Float[Tensor, "*batch"] | float,
        bound: Float[Tensor, "*batch"] | float,
        loc: Float[Tensor, "*batch"] | float = 0.0,
        validate_args: bool | None = None,
    ) -> None:
        for name, value in (("sigma", sigma), ("d", d), ("bound", bound), ("loc", loc)):
            as_numbers(name, value)
        values = as_computed(sigma, d, bound, loc)
        refuse_other_shapes(**dict(zip(("sigma", "d", "bound", "loc"), values, strict=True)))
        self.sigma, self.d, self.bound, self.loc = torch.broadcast_tensors(*values)
        validated = not torch.compiler.is_compiling() if validate_args is None else validate_args
        super().__init__(self.sigma.shape, validate_args=validated)
        if validated:
            refuse_bad_ratio(self._length)

    def expand(self, batch_shape: _Shape, _instance: MKCDistribution | None = None) -> MKCDistribution:
        """The same distribution with its batch dimensions broadcast to ``batch_shape``."""
        _refuse_no_shape("batch_shape", batch_shape)
        new = self._get_checked_instance(MKCDistribution, _instance)  # type: ignore[no-untyped-call]
        shape = torch.Size(batch_shape)
        for name in ("sigma", "d", "bound", "loc"):
            setattr(new, name, getattr(self, name).expand(shape))
        Distribution.__init__(new, shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self) -> constraints.Constraint:
        """The closed interval from ``loc - bound`` to ``loc + bound``."""
        return constraints.interval(self.loc - self.bound, self.loc + self.bound)

    @property
    def _kappa(self) -> Tensor:
        return inverse_square(self.sigma)

    @property
    def _length(self) -> Tensor:
        return self.bound / self.d

    def log_normalizer(self) -> Float[Tensor, "*batch"]:
        """``log(d Z)``, the negative log-density at ``loc``."""
        return torch.log(self.d) + log_partition(self._kappa, self._length)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density; ``-inf`` outside the domain if validation is off."""
        value = self._checked_value(value)
        error = value - self.loc
        inside = (value >= self.loc - self.bound) & (value <= self.loc + self.bound)
        log_density = -energy(torch.where(inside, error, 0.0) / self.d, self._kappa) - self.log_normalizer()
        return torch.where(inside, log_density, -torch.inf)

    def _checked_value(self, value: Tensor) -> Tensor:
        if self._validate_args:
            refuse_no_tensor("value", value, "a tensor")
            refuse_complex("value", value)
            value = value.to(self.d) if value.dtype == torch.bool else value
            self._validate_sample(value)
        return value

    def cdf(self, value: Tensor) -> Tensor:
        """Probability of a value at most ``value``."""
        value = self._checked_value(value)
        error = torch.minimum(torch.maximum(value - self.loc, -self.bound), self.bound)
        return _cumulative(error / self.d, self._kappa, self._length)

    def icdf(self, value: Tensor) -> Tensor:
        """Quantile of a probability in [0, 1].

        Raises:
            TypeError: ``value`` is not a tensor.
            ValueError: a probability outside [0, 1], if validation is on.
        """
        refuse_no_tensor("value", value, "a tensor of probabilities")
        wrong = ~((value >= 0) & (value <= 1))
        if self._validate_args and bool(wrong.any()):
            raise ValueError(
                f"Expected argument `value` to be probabilities in [0, 1] but got {first_of(value, wrong)}; "
                "divide percentages by 100."
            )
        kappa, length = self._kappa, self._length
        value, kappa, length = torch.broadcast_tensors(value.to(kappa), kappa, length)
        u = _quantile(value, kappa, length)
        # implicit differentiation: the term's value is 0, its tangent minus the derivative of the cdf
        density = torch.exp(-energy(u, kappa.detach()) - log_partition(kappa.detach(), length.detach()))
        residual = _cumulative(u, kappa, length) - value
        u = u - (residual - residual.detach()) / density.clamp(min=torch.finfo(density.dtype).tiny)
        quantile = self.loc + self.d * u
        return torch.minimum(torch.maximum(quantile, self.loc - self.bound), self.loc + self.bound)

    def rsample(self, sample_shape: _Shape = torch.Size()) -> Tensor:  # noqa: B008 - the default of torch.distributions
        """Samples, differentiable in sigma, d, bound and loc; drawn from torch's global generator."""
        _refuse_no_shape("sample_shape", sample_shape)
        shape = self._extended_shape(torch.Size(sample_shape))
        uniform = torch.rand(shape, dtype=self.d.dtype, device=self.d.device)
        return self.icdf(
            uniform.clamp(min=torch.finfo(uniform.dtype).eps / 4)
        )  # a draw of 0 would be an end of the domain

    @property
    def mean(self) -> Tensor:
        """``loc``, by symmetry."""
        return self.loc

    @property
    def mode(self) -> Tensor:
        """``loc``."""
        return self.loc

    @property
    def variance(self) -> Tensor:
        """Variance; the contribution of the flat tail in closed form."""
        return self.d.square() * self._expectation(lambda u, _: u * u, lambda length, _: length * length / 3.0)

    def entropy(self) -> Tensor:
        """Differential entropy in nats."""
        return self.log_normalizer() + self._expectation(lambda _, e: e, lambda _, tail_energy: tail_energy)

    def _expectation(self, head: _Integrand, tail_mean: _Integrand) -> Tensor:
        """Mean of ``head(u, energy)``; ``tail_mean(length, sigma²)`` is its mean over a uniform domain."""
        kappa, length = self._kappa, self._length
        tail = tail_density(kappa)
        tail_energy = torch.where(tail > 0, 1.0 / torch.where(tail > 0, kappa, 1.0), 0.0)
        nodes, weights = head_rule(kappa, length)
        e = energy(nodes, kappa.unsqueeze(-1))
        on_tail = tail.unsqueeze(-1) * head(nodes, tail_energy.unsqueeze(-1))
        excess = (weights * (head(nodes, e) * torch.exp(-e) - on_tail)).sum(-1)
        return (2.0 * length * tail * tail_mean(length, tail_energy) + excess) / partition(kappa, length)


def _refuse_no_shape(name: str, shape: object) -> None:
    if not isinstance(shape, (tuple, list)) or not all(isinstance(size, (int, torch.SymInt)) for size in shape):
        raise TypeError(
            f"Expected argument `{name}` to be a shape but got {format_value(shape)}; write (1000,) for a thousand."
        )


def _cumulative(u: Tensor, kappa: Tensor, length: Tensor) -> Tensor:
    return 0.5 + 0.5 * partition(kappa, u) / partition(kappa, length)


@torch.no_grad()
def _quantile(probability: Tensor, kappa: Tensor, length: Tensor) -> Tensor:
    """Quantile u, by a bracketed Newton's method in chunks."""
    flat = [t.detach().reshape(-1).split(_CHUNK) for t in (probability, kappa, length)]
    parts = [_quantile_chunk(*chunk) for chunk in zip(*flat, strict=True)]
    return torch.cat(parts).reshape(probability.shape) if parts else probability.detach().clone()


def _quantile_chunk(probability: Tensor, kappa: Tensor, length: Tensor) -> Tensor:
    total = partition(kappa, length)
    # work on the positive side with the mass from the middle, so that neither tail loses digits
    mass = (2.0 * (probability - 0.5)).abs() * total
    low, high = torch.zeros_like(mass), length.clone()
    u = torch.minimum(0.5 * mass, length)
    tolerance = 4.0 * torch.finfo(u.dtype).eps
    for _ in range(_MAX_ITERATIONS):
        excess = partition(kappa, u) - mass
        low, high = torch.where(excess <= 0, u, low), torch.where(excess >= 0, u, high)
        newton = u - excess / (2.0 * torch.exp(-energy(u, kappa)))
        inside = (newton > low) & (newton < high)
        following = torch.where(inside, newton, 0.5 * (low + high))
        moved = (following - u).abs()
        u = following  # with zero excess, both ends of the bracket
        if bool((moved <= tolerance * u.abs()).all()):
            break
    u = torch.where(mass >= total, length, u)
    return torch.where(probability < 0.5, -u, u)
