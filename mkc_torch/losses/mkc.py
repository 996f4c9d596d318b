"""The MKC likelihood as a loss module."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import format_value, refuse_bad_batch
from mkc_torch._support.initial_values import is_readable
from mkc_torch._support.torch_internals import in_backward, is_transformed
from mkc_torch.losses._channel_density import ChannelDensity, Objective, is_auto
from mkc_torch.losses._checks import (
    Reduction,
    checked_axis,
    checked_weight,
    format_channels,
    format_tensor,
    refuse_no_dimension,
    refuse_other_reduction,
    refuse_other_shapes,
)
from mkc_torch.losses._curves import ChannelCurves
from mkc_torch.losses._fused import fused_loss
from mkc_torch.losses._implementation import Implementation, checked_implementation, runs_kernels
from mkc_torch.losses._inspection import tails_of, training_warnings
from mkc_torch.losses._terms import Batch, LossSettings, LossTerms, loss_terms, loss_value

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mkc_torch.density.noise_spread import TailsOverInput


class MKCLoss(ChannelCurves, ChannelDensity):
    """Multi-kernel correntropy loss with a bandwidth σ and a scale d for each channel.

    The likelihood is (17) of Li et al. (2023). If σ or d is learned, the loss is ``energy + log_normalizer``. With
    both fixed it is the paper's loss, ``energy = σ² (1 - exp(-e² / (2 d² σ²)))`` with e = input - target. Learning
    without the normaliser is refused: the energy alone is smallest at σ → 0 or d → ∞, whatever the data.

    ``objective`` selects the loss that trains the network:

    - ``"likelihood"``: the negative log-likelihood, for the network as for σ and d.
    - ``"robust"``: in training the value is the sum of two terms. ``network`` has a gradient only with respect to the
      predictions: it is the loss of a :class:`BandwidthSchedule`, of residuals divided by their running
      :class:`ResidualScale`. This loss starts sharper than the absolute value, and is annealed to Welsch's loss of the
      widest bandwidth whose estimated risk is within a tenth of the smallest. ``density`` is the negative
      log-likelihood of detached residuals, and has a gradient only with respect to σ and d. In evaluation the value is
      the negative log-likelihood. Up to half of the targets may be wrong.

    Without a ``d``, the scale of each channel follows the residuals robustly during training, so that targets of any
    unit need no tuning.

    Args:
        num_channels: m, the size of the channel dimension.
        sigma: initial or fixed bandwidths in [0.05, inf], a number or (m,). ``inf`` is the Gaussian; a σ that is to be
            learned must start finite, because its gradient is 0 at ``inf``.
        d: initial or fixed scales > 0 in the unit of the target, a number or (m,); "auto" takes them from the
            residuals of each training batch, and ``learn_d`` then learns a factor on them.
        bound: half-width a of the domain of the errors, in the unit of the target, a number or (m,). "auto" and None
            mean half the range of the residuals, and at least ten scales, if ``d`` is "auto"; else 100 times the
            initial d. The likelihood of σ depends on the bound: a physical bound is better, and likelihoods are
            comparable only at equal bounds. Errors beyond the bound have a finite loss and gradient.
        objective: "robust" or "likelihood"; None is robust if d is "auto".
        learn_sigma: whether σ is a parameter.
        learn_d: whether d is a parameter; it stays in [d_min, bound].
        normalize: whether to add the log-normaliser; None does so if anything is learned.
        channel_dim: the dimension of the input that holds the channels, 1 for (N, C, H, W); None for the last. An input
            of four dimensions or more whose second and last dimension both have size m needs an explicit value.
        reduction: "none", "mean" (over elements, weighted if weights are given) or "sum".
        d_min: floor of d, a number or (m,); None means a thousandth of the initial d, or of the running scale of the
            residuals. The likelihood of a network that interpolates its targets grows without limit as d → 0.
        impl: "auto" runs Triton kernels on a GPU that has them and torch elsewhere; "eager", "compile" or "triton"
            select an implementation. All give the same results.

    Attributes:
        sigma, d: current values (m,), differentiable; assign to set them.
        bound, d_min: current values (m,).
        residual_scale: the :class:`ResidualScale`, or None if d is given and the objective is the likelihood.
        schedule: the :class:`BandwidthSchedule`, or None if the objective is the likelihood.

    Raises:
        TypeError: an argument that is not a number.
        ValueError: an argument out of range, or ``normalize=False`` with a learned σ or d.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (9) and (17).

    Example:
        >>> loss = MKCLoss(2, sigma=3.0, d=1.0, bound=50.0)
        >>> output = torch.zeros(4, 2, requires_grad=True)
        >>> value = loss(output, torch.tensor([[0.1, -0.2], [0.3, 0.0], [-0.1, 0.2], [0.0, 40.0]]))
        >>> value.backward()
        >>> bool(output.grad[3, 1].abs() < 1e-6)  # the outlier has no influence
        True
    """

    def __init__(
        self,
        num_channels: int,
        *,
        sigma: float | Float[Tensor, " m"] = 3.0,
        d: float | Float[Tensor, " m"] | Literal["auto"] = "auto",
        bound: float | Float[Tensor, " m"] | Literal["auto"] | None = "auto",
        objective: Objective | None = None,
        learn_sigma: bool = True,
        learn_d: bool = True,
        normalize: bool | None = None,
        channel_dim: int | None = None,
        reduction: Reduction = "mean",
        d_min: float | Float[Tensor, " m"] | None = None,
        impl: Implementation = "auto",
    ) -> None:
        if isinstance(num_channels, bool) or not isinstance(num_channels, int) or num_channels < 1:
            raise ValueError(
                f"Expected argument `num_channels` to be a positive integer but got {num_channels!r}; it is the number "
                "of outputs, the size of the input along `channel_dim`."
            )
        refuse_other_reduction(reduction)
        refuse_no_dimension(-1 if channel_dim is None else channel_dim)
        learned = learn_sigma or learn_d
        if normalize is None:
            normalize = learned
        if learned and not normalize:
            raise ValueError(
                "Expected `learn_sigma=False, learn_d=False` with `normalize=False`: without the normaliser the loss "
                "is smallest at sigma -> 0 or d -> inf, whatever the data. Drop `normalize=False` to learn them."
            )
        if objective not in (None, "robust", "likelihood"):
            raise ValueError(
                f"Expected argument `objective` to be 'robust', 'likelihood' or None but got {objective!r}."
            )
        super().__init__(
            num_channels,
            sigma=sigma,
            d=d,
            bound=bound,
            d_min=d_min,
            learn_sigma=learn_sigma,
            learn_d=learn_d,
            robust=objective == "robust" or (objective is None and is_auto(d)),
        )
        self.normalize = normalize
        self.channel_dim, self._named_dim = -1 if channel_dim is None else channel_dim, channel_dim is not None
        self.reduction = reduction
        self.impl = checked_implementation(impl)

    def _settings(self, batch: Batch, *, robust: bool, updated: bool) -> LossSettings:
        running = self._running()[0] if robust else self.residual_scale
        fresh = not (updated or running is None or torch.compiler.is_compiling())
        if (
            fresh
            and running is not None
            and running.batches.device.type == "cpu"
            and not is_transformed(running.batches)
        ):
            fresh = bool((running.batches == 0).any())
        state = self._state(batch if fresh else None, robust=robust)
        return LossSettings(self.fixed_kappa, self.fixed_d, state, self._follows, self.normalize, self.reduction)

    def forward(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> Tensor:
        """The loss of predictions against targets.

        Args:
            input: predictions, any shape whose ``channel_dim`` has size m; (m,) is a single sample of m channels. Give
                N samples of one channel the shape (N, 1), and the loss ``num_channels=1``.
            target: targets of the same shape; nothing is broadcast.
            weight: non-negative weights, or a boolean mask (True: used); of the shape of the input, with size 1 along
                dimensions in which it is constant, or without the channel dimension. Elements of weight 0 or False, NaN
                included, affect neither the value nor a gradient.

        Returns:
            A scalar, or with reduction "none" the shape of the input with 0 where masked; float32 at least. The mean is
            the weighted mean over elements, and 0 if all weights are 0.

        Raises:
            TypeError: integer or complex input or target, or an argument that is not a tensor.
            ValueError: shapes that differ, are empty, or have another number of channels; a weight that is negative,
                NaN or infinite; an unmasked input or target that is NaN or infinite. The last two are checked on the
                CPU in eager code only; on an accelerator, in compiled code and under vmap a NaN gives NaN. So does a
                NaN prediction in float16, so that a gradient scaler sees an overflow. The running scale ignores
                residuals that are not finite.
        """
        value = self._value(input, target, weight)
        if not torch.compiler.is_compiling() and not self._watch.is_done:
            self._watch.after_forward(self, value)
        return value

    def _value(self, input: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
        if runs_kernels(self, input):
            from mkc_torch.losses.kernels.entry import kernel_loss

            return kernel_loss(self, input, target, weight)
        if self.impl == "compile" and not torch.compiler.is_compiling():
            return _compiled()(self, input, target, weight)
        return self._computed(input, target, weight)

    def _computed(self, input: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
        batch = self._batch(input, target, weight)
        updated = self._update(batch)
        settings = self._settings(batch, robust=self.training and self._running()[1] is not None, updated=updated)
        compiling = torch.compiler.is_compiling()
        plain = not compiling and not any(map(is_transformed, self._tensors(batch)))
        if not plain or self.reduction == "none" or (batch.weight is not None and batch.weight.requires_grad):
            return loss_value(batch, self.raw_kappa, self.raw_d, settings)
        return fused_loss(batch, self.raw_kappa, self.raw_d, settings)

    def terms(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> LossTerms:
        """The two terms of the robust objective at the current state, which is not changed.

        ``network`` has a gradient only with respect to input and target, ``density`` only with respect to σ and d. A
        scheduler or early stopping should monitor ``network`` after the annealing, or the value in evaluation. With
        ``objective="likelihood"``, ``network`` is 0 and ``density`` the negative log-likelihood with all gradients.

        Args:
            input, target, weight: as in :meth:`forward`.

        Example:
            >>> loss = MKCLoss(1)
            >>> x, y = torch.randn(2, 50, 1, generator=torch.Generator().manual_seed(0))
            >>> value = loss(x, y)
            >>> network, density = loss.terms(x, y)
            >>> bool(torch.isclose(network + density, value))
            True
        """
        batch = self._batch(input, target, weight)
        settings = self._settings(batch, robust=self._running()[1] is not None, updated=False)
        return loss_terms(batch, self.raw_kappa, self.raw_d, settings)

    def check(
        self,
        input: Float[Tensor, "*shape"] | None = None,
        target: Float[Tensor, "*shape"] | None = None,
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
        *,
        optimizer: torch.optim.Optimizer | None = None,
    ) -> tuple[str, ...]:
        """Warnings about a training, a sentence each; empty if there are none. Waits for the device.

        The checks: a d close to its floor; errors several times as large as those of the training; more than 1 % of the
        errors beyond a given bound; σ or d missing from the optimizer; SGD with the robust objective, whose gradient
        grows as the residuals shrink and should be clipped.

        Args:
            input, target, weight: as in :meth:`forward`; None for the most recent residuals, if the loss keeps them.
            optimizer: the optimizer of the training; None skips its check.

        Example:
            >>> loss, net = MKCLoss(1), torch.nn.Linear(3, 1)
            >>> [text[:44] for text in loss.check(optimizer=torch.optim.Adam(net.parameters()))]
            ['The optimizer does not have sigma and d of t']
        """
        return training_warnings(self, input, target, weight, optimizer)

    def tails(
        self,
        input: Float[Tensor, "*shape"] | None = None,
        target: Float[Tensor, "*shape"] | None = None,
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
        *,
        features: Float[Tensor, "*samples p"] | None = None,
    ) -> TailsOverInput:
        """Whether the errors have heavier tails than a Gaussian, and the share expected beyond three d.

        A finite σ is not evidence of heavy tails: it is finite for about half of all Gaussian samples. Noise whose
        spread depends on the input has heavy tails too, without any outlier; then the network should predict the
        spread, with :class:`mkc_torch.MKCHead`.

        Args:
            input, target, weight: as in :meth:`forward`; None for the most recent residuals, if the loss keeps them.
            features: inputs of the network over which the spread is compared, in addition to the predictions: the
                shape of ``input`` with p columns in place of the channels, and as the last dimension.

        Returns:
            A :class:`mkc_torch.density.TailsOverInput` at the loss's bound; ``print`` shows a line for each channel.

        Raises:
            TypeError: features that are not a tensor of real numbers.
            ValueError: no residuals: none were passed, and the loss keeps none or has seen none yet; features of
                another shape, not finite, or without ``input``.

        Example:
            >>> loss = MKCLoss(1)
            >>> x, noise = torch.randn(2, 400, 1, generator=torch.Generator().manual_seed(1))
            >>> _ = loss(x, x + noise)
            >>> print(loss.tails())
            Gaussian
        """
        return tails_of(self, input, target, weight, features)

    def _tensors(self, batch: Batch) -> list[Tensor]:
        given = (batch.input, batch.target, batch.weight, self.raw_kappa, self.raw_d)
        return [value for value in given if value is not None]

    def _batch(self, input: Tensor, target: Tensor, weight: Tensor | None) -> Batch:
        """The checked batch in the dtype of the computation."""
        axis = self._checked_axis(input, target)
        dtype = torch.promote_types(torch.promote_types(input.dtype, target.dtype), self._dtype)
        prediction, wanted, counts = input.to(dtype), target.to(dtype), None
        error = None
        if weight is not None:
            weight, counts = checked_weight(weight, prediction, axis)
            error = torch.where(counts, prediction - wanted, 0.0)
        advice = "" if self.schedule is None else _SEVERAL_CALLS
        # the gradient scaler handles an overflow of half precision
        overflows = input.dtype == torch.float16
        refuse_bad_batch(None if overflows else prediction, wanted, counts, None if overflows else error, advice)
        return Batch(prediction, wanted, weight, counts, axis)

    def _update(self, batch: Batch) -> bool:
        """Update the running state by the batch, in training. Returns whether it was updated."""
        scale, schedule = self._running()
        if scale is None or not self.training:
            return False
        # function transforms have no state; activation checkpointing repeats the forward pass during the backward pass
        if not torch.compiler.is_compiling() and (in_backward() or any(map(is_transformed, self._tensors(batch)))):
            return False
        growth = scale.update(batch.input, batch.target, batch.weight, batch.axis)
        if growth is not None:
            self._watch.warn_of_other_fit(growth)
        if schedule is not None:
            schedule.update(scale)
        return True

    def _checked_axis(self, input: Tensor, target: Tensor) -> int:
        refuse_other_shapes(input, target)
        axis = checked_axis(input, self.channel_dim)
        m = self.num_channels
        if input.shape[axis] != m:
            fix = "; give each sample a dimension for its channel, unsqueeze(-1)" if m == 1 else ""
            if input.dim() > 2 and input.shape[1] == m:
                fix = "; give the loss `channel_dim=1` where the channels are the second dimension, (N, C, ...)"
            raise ValueError(
                f"Expected {m} channel{'' if m == 1 else 's'} in dimension {self.channel_dim} but got "
                f"{tuple(input.shape)}{fix}."
            )
        if not self._named_dim and input.dim() > 3 and input.shape[1] == m:
            raise ValueError(
                f"Expected argument `channel_dim` to be given for an input of shape {tuple(input.shape)}, whose second "
                f"and last dimension both have size {m}: 1 for (N, C, ...), -1 for channels last."
            )
        return axis

    def __repr__(self) -> str:
        learned = [n for n, p in (("sigma", self.raw_kappa), ("d", self.raw_d)) if p is not None]
        unread = [format_tensor(p) for p in (self.raw_kappa, self.raw_d) if p is not None and not is_readable(p)]
        if unread:
            return f"MKCLoss({self.num_channels}, {unread[0]}, learns={learned})"
        with torch.no_grad():
            sigma, d, bound = (format_channels(values) for values in (self.sigma, self.d, self.bound))
        if self._follows:
            d, bound = f"auto: {d}", bound if self.fixed_bound is not None else f"auto: {bound}"
        return (
            f"MKCLoss({self.num_channels}, sigma={sigma}, d={d}, bound={bound}, objective={self.objective!r}, "
            f"learns={learned}, normalize={self.normalize}, channel_dim={self.channel_dim}, "
            f"reduction={self.reduction!r})"
        )


_SEVERAL_CALLS = (
    "An optimiser that calls the loss several times a step, such as L-BFGS, needs loss.freeze_scale() first"
)


@functools.cache
def _compiled() -> Callable[..., Tensor]:
    return torch.compile(MKCLoss._computed)


def checked_loss(loss: nn.Module) -> MKCLoss:
    """The MKCLoss, unwrapped if it was compiled.

    Raises:
        TypeError: ``loss`` is not an MKCLoss.
    """
    own = getattr(loss, "_orig_mod", loss)
    if not isinstance(own, MKCLoss):
        got = format_value(loss) if isinstance(loss, type) else type(loss).__name__
        raise TypeError(
            f"Expected argument `loss` to be an MKCLoss but got {got}; pass the loss that is trained with. "
            "MKCDistribution and mkc_torch.functional take σ and d of each sample."
        )
    return own
