"""Clean targets whose noise depends on the input: losses, a head, and what the loss reports of the noise.

No target is wrong. Nine shapes of the noise's spread over five inputs, and equal noise; the error is measured against
the noise-free function on new inputs.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from mkc_torch import HeteroscedasticMKCLoss, MKCHead, MKCLoss

ROWS, NEW_ROWS, INPUTS, WIDTH, STEPS, BATCH = 600, 4000, 5, 32, 1000, 64
BOUND, D_MIN = 20.0, 0.01

Shape = Callable[[Tensor, Tensor], Tensor]

SHAPES: dict[str, tuple[int, Shape]] = {
    "equal": (0, lambda _, y: torch.full_like(y, 0.3)),
    "linear in an input": (0, lambda x, _: 0.05 + x[:, :1]),
    "grows with the target": (0, lambda _, y: 0.05 + 0.5 * (y - y.min()) / (y.max() - y.min())),
    "two levels": (0, lambda x, _: torch.where(x[:, 1:2] < 0.7, 0.1, 1.0)),
    "exponential, unrelated input": (0, lambda x, _: 0.05 * torch.exp(3.0 * x[:, 3:4])),
    "V": (1, lambda x, _: 0.05 + 1.2 * (x[:, :1] - 0.5).abs()),
    "power of the target": (1, lambda _, y: 0.02 + 0.3 * y.abs() ** 1.5),
    "wave": (1, lambda x, _: 0.3 * (1.1 + torch.sin(7.0 * x[:, 2:3]))),
    "ridge, unrelated input": (1, lambda x, _: 0.05 + 0.8 * torch.exp(-20.0 * (x[:, 3:4] - 0.5) ** 2)),
    "square of an input": (1, lambda x, _: 0.05 + x[:, 1:2] ** 2),
}
"""The function and the standard deviation of the noise."""

FUNCTIONS: tuple[Callable[[Tensor], Tensor], ...] = (
    lambda x: torch.sin(4.0 * x[:, :1]) + x[:, 1:2] * x[:, 2:3],
    lambda x: 0.5 * torch.cos(3.0 * x[:, :1] * x[:, 1:2]) + (x[:, 2:3] - 0.3).abs() + 0.5 * x[:, 1:2] ** 2,
)


def drawn(shape: str, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return inputs and targets of the training, and new inputs with the noise-free function there."""
    number, spread = SHAPES[shape]
    generator = torch.Generator().manual_seed(seed + 1000 * number)
    x = torch.rand(ROWS, INPUTS, generator=generator)
    y = FUNCTIONS[number](x)
    target = y + spread(x, y) * torch.randn(ROWS, 1, generator=generator)
    new = torch.rand(NEW_ROWS, INPUTS, generator=generator)
    return standardised(x), target, standardised(new), FUNCTIONS[number](new)


def standardised(x: Tensor) -> Tensor:
    return (x - 0.5) * 12.0**0.5


def trained(make: Callable[[], nn.Module], x: Tensor, y: Tensor, seed: int) -> tuple[nn.Module, nn.Module]:
    """Return a trained perceptron and its loss; with the heteroscedastic loss the last layer is an MKCHead."""
    torch.manual_seed(seed)
    loss = make()
    has_head = isinstance(loss, HeteroscedasticMKCLoss)
    last = MKCHead(WIDTH, 1, bound=BOUND, d_min=D_MIN) if has_head else nn.Linear(WIDTH, 1)
    model = nn.Sequential(nn.Linear(INPUTS, WIDTH), nn.SiLU(), last)
    groups = [{"params": list(model.parameters()), "weight_decay": 1e-2}]
    optimiser = torch.optim.AdamW([*groups, {"params": list(loss.parameters()), "weight_decay": 0.0}], lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(x), (BATCH,))
        optimiser.zero_grad()
        output = model(x[rows])
        value = loss(output[0], y[rows], *output[1:]) if has_head else loss(output, y[rows])
        value.backward()
        optimiser.step()
        schedule.step()
    return model, loss


LOSSES: dict[str, Callable[[], nn.Module]] = {
    "MSE": nn.MSELoss,
    "L1": nn.L1Loss,
    "MKC, as it comes": lambda: MKCLoss(1),
    "MKCHead": lambda: HeteroscedasticMKCLoss(bound=BOUND),
}


def outcome(shape: str, seed: int) -> tuple[list[float], bool]:
    """Return the error of each loss, and whether the loss reports that the noise depends on the input."""
    x, y, new, truth = drawn(shape, seed)
    errors, reported = [], False
    for make in LOSSES.values():
        model, loss = trained(make, x, y, seed)
        with torch.no_grad():
            output = model(new)
            prediction = output if isinstance(output, Tensor) else output[0]
            errors.append(float((prediction - truth).square().mean().sqrt()))
            if isinstance(loss, MKCLoss):
                reported = loss.tails(model(x), y, features=x).spread[0] is not None
    return errors, reported


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each shape of the noise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--shapes", nargs="+", default=list(SHAPES), choices=list(SHAPES))
    chosen = parser.parse_args(arguments)
    names = list(LOSSES)
    print("| spread of the noise | " + " | ".join(names) + " | reported |")
    print("|---|" + "---:|" * (len(names) + 1))
    ratios = []
    for shape in chosen.shapes:
        runs = [outcome(shape, seed) for seed in range(chosen.seeds)]
        means = [statistics.fmean(errors[k] for errors, _ in runs) for k in range(len(names))]
        ratios.append([mean / means[0] for mean in means])
        cells = " | ".join([f"{means[0]:.4f}", *(f"{ratio:.2f}" for ratio in ratios[-1][1:])])
        print(f"| {shape} | {cells} | {sum(found for _, found in runs)} of {len(runs)} |", flush=True)
    mean = " | ".join(f"{statistics.geometric_mean(column):.2f}" for column in list(zip(*ratios, strict=True))[1:])
    print(f"| geometric mean | | {mean} | |")


if __name__ == "__main__":
    main()
