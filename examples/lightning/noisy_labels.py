"""Handwritten digits, some of whose training labels are wrong: the error on right labels with each loss.

    python examples/lightning/noisy_labels.py [--seeds 5] [--epochs 60] [--output PICTURE.png]

Prints a table, and the weights of wrong and right training labels; ``--output`` writes the picture.
"""

from __future__ import annotations

import argparse
import logging
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from lightning.pytorch import LightningModule, Trainer
from sklearn.datasets import load_digits
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from mkc_torch import GeneralizedCrossEntropyLoss, graduated_sigma

CLASSES, TRAINING = 10, 1200
SHARES = (0.0, 0.2, 0.4, 0.6)
SHOWN = 0.4

CROSS_ENTROPY, BEST_EPOCH = "cross-entropy", "cross-entropy, best epoch"
FIXED, GRADUATED = "correntropy, σ = 1.2", "correntropy, graduated σ"


class MeanAbsoluteError(nn.Module):
    """Mean absolute error of the probabilities; Ghosh, Kumar and Sastry, AAAI 2017."""

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        probability: Tensor = input.softmax(1).gather(1, target.unsqueeze(1))
        return 2.0 * (1.0 - probability).mean()


class CLoss(nn.Module):
    """Correntropy of the error of the probabilities at σ = 0.5; Singh, Pokharel and Principe, 2014."""

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        error = nn.functional.one_hot(target, CLASSES) - input.softmax(1)
        return -0.25 * torch.expm1(-2.0 * error.square().sum(1)).mean()


LOSSES: dict[str, Callable[[], nn.Module]] = {
    CROSS_ENTROPY: nn.CrossEntropyLoss,
    "label smoothing 0.1": lambda: nn.CrossEntropyLoss(label_smoothing=0.1),
    "mean absolute error": MeanAbsoluteError,
    "C-loss": CLoss,
    FIXED: GeneralizedCrossEntropyLoss,
    GRADUATED: GeneralizedCrossEntropyLoss,
}


class Digits(NamedTuple):
    """Training images (N, 64) in [0, 1] with given and true labels, and test images."""

    images: Tensor
    given: Tensor
    true: Tensor
    test_images: Tensor
    test_labels: Tensor


def digits(share: float, seed: int) -> Digits:
    """Split the 1797 images; a share of the training labels becomes another digit at random."""
    generator = torch.Generator().manual_seed(seed)
    data, target = load_digits(return_X_y=True)
    order = torch.randperm(len(target), generator=generator)
    x, y = torch.as_tensor(data / 16.0, dtype=torch.float32)[order], torch.as_tensor(target)[order].long()
    true = y[:TRAINING]
    hit = torch.rand(TRAINING, generator=generator) < share
    other = (true + torch.randint(1, CLASSES, (TRAINING,), generator=generator)) % CLASSES
    return Digits(x[:TRAINING], torch.where(hit, other, true), true, x[TRAINING:], y[TRAINING:])


class Classifier(LightningModule):
    """A perceptron large enough to memorise its labels; it records the test error after each epoch."""

    def __init__(self, criterion: nn.Module, graduated: bool, test: tuple[Tensor, Tensor]) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(64, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, CLASSES))
        self.criterion = criterion
        self.graduated = graduated
        self.test = test
        self.history: list[float] = []

    def on_train_epoch_start(self) -> None:
        if self.graduated:
            assert isinstance(self.criterion, GeneralizedCrossEntropyLoss)
            assert self.trainer.max_epochs is not None
            self.criterion.sigma = graduated_sigma(self.current_epoch / self.trainer.max_epochs)

    def training_step(self, batch: tuple[Tensor, Tensor], batch_idx: int) -> Tensor:  # noqa: ARG002 - signature of Lightning
        x, y = batch
        loss: Tensor = self.criterion(self.net(x), y)
        return loss

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        x, y = self.test
        self.history.append(float((self.net(x).argmax(1) != y).double().mean()))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.net.parameters(), lr=1e-3)


def trained(name: str, data: Digits, seed: int, epochs: int) -> Classifier:
    """Train the network with a loss."""
    torch.manual_seed(seed)
    module = Classifier(LOSSES[name](), name == GRADUATED, (data.test_images, data.test_labels))
    loader = DataLoader(TensorDataset(data.images, data.given), batch_size=64, shuffle=True)
    options: dict[str, Any] = dict.fromkeys(
        ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False
    )
    Trainer(max_epochs=epochs, accelerator="cpu", **options).fit(module, loader)
    return module


@torch.no_grad()
def doubted(module: Classifier, data: Digits) -> tuple[float, float]:
    """Return the shares of wrong and right training labels with a weight below 0.1; NaN without such labels."""
    assert isinstance(module.criterion, GeneralizedCrossEntropyLoss)
    low = (module.criterion.inlier_weight(module.net(data.images), data.given) < 0.1).double()
    wrong = data.given != data.true
    return float(low[wrong].mean()), float(low[~wrong].mean())


def table(seeds: int, epochs: int) -> dict[str, dict[float, Tensor]]:
    """Print a table of the losses. Returns errors (seeds, epochs) by loss and share of wrong labels."""
    print(f"error on right labels after {epochs} epochs, {seeds} seeds, mean ± standard error (%)")
    print(f"{'wrong labels':26}" + "".join(f"{share:>14.0%}" for share in SHARES))
    found: dict[str, dict[float, Tensor]] = {}
    doubts: dict[float, list[tuple[float, float]]] = {share: [] for share in SHARES}
    for name in LOSSES:
        found[name] = {}
        for share in SHARES:
            histories = []
            for seed in range(seeds):
                data = digits(share, seed)
                module = trained(name, data, seed, epochs)
                histories.append(module.history)
                if name == GRADUATED:
                    doubts[share].append(doubted(module, data))
            found[name][share] = torch.tensor(histories)
        row(name, [errors[:, -1] for errors in found[name].values()])
        if name == CROSS_ENTROPY:
            row(BEST_EPOCH, [errors.amin(1) for errors in found[name].values()])
    print("\nweights of the training labels below 0.1 (%), graduated σ")
    for i, kind in enumerate(("of the wrong ones", "of the right ones")):
        shares = [sum(pair[i] for pair in doubts[share]) / seeds for share in SHARES]
        print(f"{kind:26}" + "".join(f"{'-' if math.isnan(v) else f'{100.0 * v:.1f}':>14}" for v in shares))
    return found


def row(name: str, errors: list[Tensor]) -> None:
    """Print one line of the table, the errors of the seeds for each share of wrong labels."""
    cells = []
    for each in errors:
        spread = float(each.std()) / math.sqrt(len(each)) if len(each) > 1 else math.nan
        cells.append(f"{100.0 * float(each.mean()):.1f} ± {100.0 * spread:.1f}")
    print(f"{name:26}" + "".join(f"{cell:>14}" for cell in cells), flush=True)


def picture(path: str, found: dict[str, dict[float, Tensor]]) -> None:
    """Draw the errors over the share of wrong labels, and over the epochs at 40 %."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colours = dict(zip(LOSSES, ("#d62728", "#ff9e4a", "#8c8c8c", "#9467bd", "#6aaed6", "#08519c"), strict=True))
    for name, errors in found.items():
        style: dict[str, Any] = {
            "color": colours[name],
            "label": name,
            "linewidth": 2.2 if name == GRADUATED else 1.3,
            "zorder": 3 if name == GRADUATED else 2,
        }
        left.plot([100.0 * s for s in errors], [100.0 * float(e[:, -1].mean()) for e in errors.values()], "o-", **style)
        course = 100.0 * errors[SHOWN].mean(0)
        right.plot(range(1, len(course) + 1), course.tolist(), **style)
    left.set_xlabel("wrong training labels (%)")
    left.set_ylabel("error on right labels, last epoch (%)")
    left.set_xticks([100.0 * s for s in SHARES])
    left.legend(frameon=False)
    right.set_xlabel("epoch")
    right.set_ylabel("error on right labels (%)")
    right.set_title(f"{SHOWN:.0%} wrong labels", fontsize=10)
    for axes in (left, right):
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    right.set_ylim(0.0, 40.0)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--output", metavar="PICTURE.png")
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_num_threads(1)  # the arrays are small
    found = table(options.seeds, options.epochs)
    if options.output:
        picture(options.output, found)


if __name__ == "__main__":
    main()
