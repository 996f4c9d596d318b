"""Forecasts of a chaotic series recorded under bursts of interference: the error against the series itself.

    python examples/lightning/bursty_series.py [--seeds 5] [--share 0.2] [--output PICTURE.png]

The Mackey-Glass equation with sensor noise of 5 %, and bursts that lift 20 % of the samples. A perceptron learns from
recorded windows of 24 samples, bursts included, to predict the recording 1, 2, 4 and 8 steps later. Prints the RMS
error of each loss against the undisturbed series that follows, in standard deviations of the series, as mean ±
standard error over seeds: from quiet windows, from windows with as many bursts as in training, and without bursts.

A window with a burst predicts less well, so the noise differs between windows. The rows "each window" have a head
that predicts the noise.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import torch
from peers import MKC_EM, Regression, losses, mean_and_error, perceptron, quiet, train
from torch import Tensor, nn

from mkc_torch import HeteroscedasticMKCLoss, MKCHead, MKCLoss, inlier_weight
from mkc_torch.losses.heteroscedastic import MKCHeadOutput

WINDOW, AHEAD = 24, (1, 2, 4, 8)
TRAINING, HELD_OUT, NOISE, EPOCHS = 3000, 2000, 0.05, 30
BOUND = 50.0  # of an error, in standard deviations of the series: where the recorder saturates
PRECISION = 0.01  # of the recorder
LOSSES = losses(len(AHEAD), BOUND)
STUDENT_HEAD, MKC_HEAD, ORACLE = "Student t, each window", "MKC, each window", "MSE, bursts masked"
NAMES = (*LOSSES, STUDENT_HEAD, MKC_HEAD, ORACLE)


class MaskedMSE(nn.Module):
    """The mean squared error over the targets that are not NaN."""

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        present = target.isfinite()
        return torch.where(present, input - target, 0.0).square().sum() / present.sum()


class StudentTHead(nn.Linear):
    """Features to location, degrees of freedom and scale of each output, as :class:`StudentTHeadLoss` takes them."""

    def __init__(self, in_features: int, num_channels: int) -> None:
        super().__init__(in_features, 3 * num_channels)

    def forward(self, input: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        location, freedom, scale = super().forward(input).chunk(3, -1)
        return location, 1.0 + freedom.exp(), scale.exp()


class StudentTHeadLoss(nn.Module):
    """Negative log-likelihood of Student's t with degrees of freedom and scale of each element."""

    def forward(self, input: tuple[Tensor, Tensor, Tensor], target: Tensor) -> Tensor:
        location, freedom, scale = input
        return -torch.distributions.StudentT(freedom, location, scale).log_prob(target).mean()


class MKCHeadLoss(nn.Module):
    """Negative log-likelihood of MKC with the parameters that an MKCHead predicts."""

    def __init__(self) -> None:
        super().__init__()
        self.loss = HeteroscedasticMKCLoss(bound=BOUND)

    def forward(self, input: MKCHeadOutput, target: Tensor) -> Tensor:
        value: Tensor = self.loss(input.location, target, input.sigma, input.d)
        return value


def network(name: str) -> tuple[nn.Sequential, nn.Module]:
    """The network and its loss."""
    net = perceptron(WINDOW, 64, 64, len(AHEAD))
    if name == MKC_HEAD:
        net[-1] = MKCHead(64, len(AHEAD), bound=BOUND, d_min=PRECISION)
        return net, MKCHeadLoss()
    if name == STUDENT_HEAD:
        net[-1] = StudentTHead(64, len(AHEAD))
        return net, StudentTHeadLoss()
    return net, MaskedMSE() if name == ORACLE else LOSSES[name]()


def mackey_glass(samples: int, seed: int) -> Tensor:
    """dx/dt = 0.2 x(t - 17) / (1 + x(t - 17)^10) - 0.1 x, sampled once a unit of time, of mean 0 and deviation 1.

    Mackey and Glass, "Oscillation and chaos in physiological control systems", Science 197 (1977).
    """
    per_unit, settling = 10, 500
    delay = 17 * per_unit
    start = 0.9 + 0.4 * torch.rand(1, generator=torch.Generator().manual_seed(seed)).item()
    x = [start] * (delay + 1)
    for _ in range((settling + samples) * per_unit):
        late = x[-1 - delay]
        x.append(x[-1] + (0.2 * late / (1.0 + late**10) - 0.1 * x[-1]) / per_unit)
    series = torch.tensor(x[-samples * per_unit :: per_unit])
    return (series - series.mean()) / series.std()


def bursts(samples: int, share: float, generator: torch.Generator) -> Tensor:
    """Draw bursts of rectified noise: 3 to 10 samples long, strength 2 to 8; 0 between them."""
    out = torch.zeros(samples)
    while int((out > 0.0).sum()) < share * samples:
        length = int(torch.randint(3, 11, (1,), generator=generator))
        start = int(torch.randint(0, samples - length, (1,), generator=generator))
        strength = 2.0 + 6.0 * torch.rand(1, generator=generator)
        out[start : start + length] = strength * torch.randn(length, generator=generator).abs()
    return out


@dataclass(frozen=True)
class Series:
    """A series and its recording, (samples,); `interference` is 0 outside bursts."""

    clean: Tensor
    quiet: Tensor
    interference: Tensor

    @property
    def recorded(self) -> Tensor:
        return self.quiet + self.interference


def sample(share: float, seed: int) -> tuple[Series, Series]:
    """Return the training series, and the series that follows it."""
    generator = torch.Generator().manual_seed(seed)
    clean = mackey_glass(TRAINING + HELD_OUT, seed)
    quiet_recording = clean + NOISE * torch.randn(len(clean), generator=generator)
    interference = bursts(len(clean), share, generator)
    parts = [t.split([TRAINING, HELD_OUT]) for t in (clean, quiet_recording, interference)]
    return Series(*(p[0] for p in parts)), Series(*(p[1] for p in parts))


def windows(series: Tensor) -> Tensor:
    """Return the windows with complete targets, (windows, WINDOW)."""
    return series[: -max(AHEAD)].unfold(0, WINDOW, 1)


def ahead(series: Tensor) -> Tensor:
    """Return the targets of each window, (windows, AHEAD)."""
    last = torch.arange(WINDOW - 1, len(series) - max(AHEAD))
    return torch.stack([series[last + h] for h in AHEAD], -1)


def trained(name: str, share: float, seed: int, epochs: int = EPOCHS) -> Regression:
    """Train the network with a loss on the first series."""
    series, _ = sample(share, seed)
    target = ahead(series.recorded)
    if name == ORACLE:
        target = torch.where(ahead(series.interference) > 0.0, torch.nan, target)
    torch.manual_seed(seed)
    module = Regression(*network(name), annealed=True)
    train(module, windows(series.recorded), target, epochs=epochs)
    return module


@torch.no_grad()
def forecast(module: Regression, series: Tensor) -> Tensor:
    """Return the forecasts of each window, (windows, AHEAD)."""
    out = module.net(windows(series))
    return out[0] if isinstance(out, tuple) else out


def errors(module: Regression, share: float, seed: int) -> Tensor:
    """Return the RMS errors against the clean series, from quiet and from disturbed windows, (2, AHEAD)."""
    _, series = sample(share, seed)
    truth = ahead(series.clean)
    found = [forecast(module, recording) - truth for recording in (series.quiet, series.recorded)]
    return torch.stack(found).square().mean(1).sqrt()


def table(share: float, seeds: int) -> dict[str, Tensor]:
    """Print a table of the losses. Returns their errors with bursts, (seeds, 2, AHEAD)."""
    print(f"{share:.0%} of the samples in bursts, {seeds} seeds, {EPOCHS} epochs")
    print(f"{'':24}{'from quiet windows':^32}{'from disturbed windows':^32}{'no burst,':>16}")
    print(f"{'steps ahead':24}" + 2 * f"{AHEAD[0]:>16}{AHEAD[-1]:>16}" + f"{'over MSE':>16}")
    disturbed: dict[str, Tensor] = {}
    undisturbed: dict[str, Tensor] = {}
    for name in NAMES:
        modules = [trained(name, share, seed) for seed in range(seeds)]
        disturbed[name] = torch.stack([errors(m, share, seed) for seed, m in enumerate(modules)])
        columns = [mean_and_error(disturbed[name][:, i, j].tolist()) for i in (0, 1) for j in (0, -1)]
        if name != ORACLE:  # without bursts it is the mean squared error
            each = torch.stack([errors(trained(name, 0.0, seed), 0.0, seed) for seed in range(seeds)])
            undisturbed[name] = each[:, 0].square().mean(-1).sqrt()
            columns.append(mean_and_error((undisturbed[name] / undisturbed["MSE"]).tolist()))
        print(f"{name:24}" + "".join(f"{m:8.3f} ± {e:.3f}" for m, e in columns), flush=True)
        own = [m.criterion for m in modules if isinstance(m.criterion, MKCLoss)]
        if own:
            sigma, d = (torch.stack([getattr(c, key).detach() for c in own]).median(0).values for key in ("sigma", "d"))
            print(f"{'':24}  sigma {sigma[0]:.3g} to {sigma[-1]:.3g}, d {d[0]:.3g} to {d[-1]:.3g}")
    return disturbed


def picture(path: str, disturbed: dict[str, Tensor], share: float) -> None:
    """Draw the weights of MKC-EM, forecasts of an unseen quiet stretch, and the errors."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    rows = figure.add_gridspec(2, 2, width_ratios=(3, 2))
    recording, ahead_of, bars = (figure.add_subplot(place) for place in (rows[0, :], rows[1, 0], rows[1, 1]))
    modules = {name: trained(name, share, 0) for name in ("MSE", MKC_EM)}
    series, unseen = sample(share, 0)
    criterion = modules[MKC_EM].criterion
    assert isinstance(criterion, MKCLoss)
    weight = inlier_weight(criterion, forecast(modules[MKC_EM], series.recorded), ahead(series.recorded))[:, 0]
    stretch = slice(1000, 1240)
    time = torch.arange(WINDOW, WINDOW + len(weight))[stretch]
    recording.plot(time, series.clean[time], color="0.2", lw=1.2, label="the series")
    dots = recording.scatter(
        time, series.recorded[time], c=weight[stretch], s=14.0, cmap="coolwarm_r", vmin=0.0, vmax=1.0, label="recorded"
    )
    recording.set_title("weight of each sample in MKC-EM, one step ahead", loc="left")
    recording.set_xlabel("time")
    recording.set_ylabel("standard deviations")
    low, high = recording.get_ylim()
    recording.set_ylim(low, high + 0.15 * (high - low))  # room for the legend
    recording.legend(frameon=False, loc="upper right", ncols=2)
    figure.colorbar(dots, ax=recording, label="inlier weight")
    stretch = slice(200, 380)
    time = torch.arange(WINDOW - 1, len(unseen.clean))[stretch] + AHEAD[-1]
    ahead_of.plot(time, unseen.clean[time], color="0.2", lw=2.5, label="the series")
    for (name, module), color in zip(modules.items(), ("C1", "C0"), strict=True):
        ahead_of.plot(time, forecast(module, unseen.quiet)[stretch, -1], color=color, lw=1.2, label=name)
    ahead_of.set_title(f"forecasts {AHEAD[-1]} steps ahead, after training on bursts", loc="left")
    ahead_of.set_xlabel("time")
    ahead_of.set_ylabel("standard deviations")
    ahead_of.legend(frameon=False, loc="upper right", ncols=3)
    low, high = ahead_of.get_ylim()
    ahead_of.set_ylim(low, high + 0.15 * (high - low))
    names = [name for name in reversed(NAMES) if name != ORACLE]
    for i, color, label in ((0, "C0", "from quiet windows"), (1, "C3", "from disturbed ones")):
        all_steps = {name: disturbed[name][:, i].square().mean(-1).sqrt().tolist() for name in NAMES}
        found = [mean_and_error(all_steps[name]) for name in names]
        bars.errorbar([m for m, _ in found], names, xerr=[e for _, e in found], fmt="o", color=color, label=label)
        best = mean_and_error(all_steps[ORACLE])[0]
        bars.axvline(best, color=color, ls=":", zorder=0)
    bars.plot([], [], ":", color="0.5", label=ORACLE)
    bars.set_xscale("log")
    low, high = bars.get_xlim()
    ticks = [t for t in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0) if low < t < high]
    bars.set_xticks(ticks, [f"{t:g}" for t in ticks])
    bars.minorticks_off()
    bars.set_xlabel("root mean square error, 1 to 8 steps ahead")
    figure.legend(*bars.get_legend_handles_labels(), loc="outside lower right", ncols=3, frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--share", type=float, default=0.2)
    parser.add_argument("--output", metavar="PICTURE.png")
    options = parser.parse_args()
    quiet()
    disturbed = table(options.share, options.seeds)
    if options.output:
        picture(options.output, disturbed, options.share)


if __name__ == "__main__":
    main()
