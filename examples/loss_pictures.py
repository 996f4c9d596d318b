"""Pictures of every loss in the manual: value ρ, derivative by the error, and weight of the error.

python examples/loss_pictures.py --output docs/pictures
"""

from __future__ import annotations

import argparse
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from mkc_torch import GeneralizedCrossEntropyLoss, HeteroscedasticMKCLoss, LELoss, MKCLoss
from mkc_torch.functional import mkc_nll
from mkc_torch.losses.bandwidth_schedule import BandwidthSchedule

SIZE, DPI, COLORS = (9.0, 3.3), 90, 48
"""Inches, dots an inch and colours: small enough to be kept in the repository."""

Curves = dict[str, tuple[Tensor, Tensor, Tensor]]
"""Value, influence and weight of each curve."""


def fixed(panels: Sequence[Any]) -> None:
    """MKCLoss with fixed parameters at four bandwidths."""
    error = torch.linspace(-8.0, 8.0, 401, dtype=torch.float64).unsqueeze(-1)
    curves: Curves = {}
    for sigma in (math.inf, 3.0, 2.0, 1.0):
        loss = MKCLoss(1, sigma=sigma, d=1.0, learn_sigma=False, learn_d=False).double()
        values = loss.rho(error), loss.influence(error), loss.weight(error)
        curves[f"σ = {sigma:g}".replace("inf", "∞")] = tuple(curve[:, 0] for curve in values)  # type: ignore[assignment]
    draw(panels, error[:, 0], curves, "error / d", ("value ρ", "influence · d", "weight"))
    panels[0].set_ylim(-0.3, 12.0)
    panels[1].set_ylim(-3.2, 3.2)


def scheduled(panels: Sequence[Any]) -> None:
    """The network term of the robust objective, from the start of the schedule to its end."""
    error = torch.linspace(-8.0, 8.0, 401, dtype=torch.float64)
    curves: Curves = {}
    for share, name in ((0.0, "share 0, at the start"), (0.5, "share 0.5"), (1.0, "share 1, at the end")):
        schedule = BandwidthSchedule(1).double()
        schedule.share.fill_(share)
        schedule.log_bandwidth.fill_(math.log(2.0))
        z = error.clone().requires_grad_()
        value = schedule.energy(z.unsqueeze(-1)).squeeze(-1)
        (influence,) = torch.autograd.grad(value.sum(), z)
        # at an error of 0 the weight is its limit
        weight = torch.where(error == 0.0, 1.0, influence / torch.where(error == 0.0, 1.0, error))
        curves[name] = (value.detach(), influence, weight)
    draw(panels, error, curves, "error / scale", ("network term", "influence · scale", "weight"))


def heteroscedastic(panels: Sequence[Any]) -> None:
    """HeteroscedasticMKCLoss of samples with different scales."""
    error, loss = torch.linspace(-8.0, 8.0, 401, dtype=torch.float64), HeteroscedasticMKCLoss(bound=50.0)
    curves: Curves = {}
    for d in (0.5, 1.0, 2.0):
        value = mkc_nll(error, 2.0, d, 50.0)
        curves[f"d = {d:g}"] = (value, loss.influence(error, 2.0, d), loss.weight(error, 2.0, d))
    draw(panels, error, curves, "error", ("value with the log-normaliser", "influence", "weight"))


def labels(panels: Sequence[Any]) -> None:
    """GeneralizedCrossEntropyLoss over the probability of the label."""
    p = torch.linspace(0.0, 1.0, 401, dtype=torch.float64)
    curves: Curves = {}
    for sigma in (math.inf, 2.0, 1.2, 0.8):
        loss = GeneralizedCrossEntropyLoss(sigma=sigma).double()
        value = loss.rho(p.clamp(min=1e-3) if sigma == math.inf else p)
        name = "σ = ∞, cross-entropy" if sigma == math.inf else f"σ = {sigma:g}"
        curves[name] = (value, loss.weight_at(p) * (1.0 - p), loss.weight_at(p))
    draw(panels, p, curves, "probability of the label", ("value ρ", "influence on the logit", "weight"))
    panels[0].set_ylim(-0.1, 4.0)


def entropy(panels: Sequence[Any]) -> None:
    """LELoss of one error among 200 Gaussian errors."""
    level = (torch.arange(200, dtype=torch.float64) + 0.5) / 200.0
    batch, loss = torch.special.ndtri(level), LELoss()
    error = torch.linspace(-6.0, 6.0, 400, dtype=torch.float64)  # an even number: at 0 the weight is infinite
    count = len(batch) + 1
    value = count * (loss.rho(error, batch) - loss.rho(torch.zeros((), dtype=torch.float64), batch))
    curve = value, count * loss.influence(error, batch), count * loss.weight(error, batch)
    names = ("change of the value · N", "influence · N", "weight · N")
    draw(panels, error, {"": curve}, "error / scale of the others", names)
    panels[2].set_ylim(-1.0, 4.0)


PICTURES: dict[str, Callable[[Sequence[Any]], None]] = {
    f"losses_{curves.__name__}": curves for curves in (fixed, scheduled, heteroscedastic, labels, entropy)
}


def draw(panels: Sequence[Any], x: Tensor, curves: Curves, xlabel: str, titles: tuple[str, str, str]) -> None:
    """Draw three panels: value, influence and weight."""
    for panel, title in zip(panels, titles, strict=True):
        panel.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
        panel.set_title(title, fontsize="medium")
        panel.set_xlabel(xlabel)
    for name, values in curves.items():
        for panel, value in zip(panels, values, strict=True):
            panel.plot(x.tolist(), value.detach().tolist(), label=name)
    if len(curves) > 1:
        panels[0].figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(curves), frameon=False
        )


def save(figure: Figure, path: Path) -> None:
    """Save as a PNG of few colours, which halves the file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI)
    Image.open(buffer).convert("P", palette=Image.Palette.ADAPTIVE, colors=COLORS).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=Path, required=True, help="folder for the PNG files")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name, plot in PICTURES.items():
        figure = Figure(figsize=SIZE, layout="constrained")
        plot(figure.subplots(1, 3))
        save(figure, options.output / f"{name}.png")
        print(options.output / f"{name}.png")


if __name__ == "__main__":
    main()
