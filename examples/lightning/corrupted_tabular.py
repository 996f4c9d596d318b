"""Two tables with 20 % of the training targets two to ten times too large: the error on clean held-out rows.

    python examples/lightning/corrupted_tabular.py [--seeds 10] [--share 0.2] [--output PICTURE.png]

Diabetes progression (442 patients, ships with scikit-learn) and Friedman's first function (1000 rows, noise 1). Prints
the RMS error of each loss, and its ratio to that of the mean squared error without the wrong rows, as mean ± standard
error over seeds; each seed has its own split, wrong rows and network. Then the cost of a loss without wrong targets,
and the targets that MKC flags.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from peers import MKC_AUTO, MKC_EM, MKC_JOINT, Regression, losses, mean_and_error, perceptron, quiet, train
from sklearn.datasets import load_diabetes, make_friedman1
from sklearn.linear_model import HuberRegressor
from torch import Tensor, nn

from mkc_torch import MKCLoss, inlier_weight, outliers

ORACLE, LINEAR = "MSE, wrong rows left out", "HuberRegressor, linear"
NAMES = (*losses(1, 2.0), LINEAR, ORACLE)


@dataclass(frozen=True)
class Table:
    """Training rows with recorded targets, and held-out rows with true targets.

    ``wrong`` is the mask of wrong targets, for the oracle and the score only.
    """

    x: Tensor
    y: Tensor
    wrong: Tensor
    held_out_x: Tensor
    held_out_y: Tensor


def corrupted(x: Tensor, y: Tensor, new_x: Tensor, new_y: Tensor, share: float, seed: int) -> Table:
    """Multiply a share of the training targets by 2 to 10, and standardise the columns."""
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.rand(len(y), generator=generator) < share
    recorded = torch.where(wrong, (2.0 + 8.0 * torch.rand(len(y), generator=generator)) * y, y)
    mean, spread = x.mean(0), x.std(0)
    return Table((x - mean) / spread, recorded, wrong, (new_x - mean) / spread, new_y)


def diabetes(share: float, seed: int) -> Table:
    """A score of the disease's progression against ten measurements; a quarter of the patients is held out."""
    x, y = (torch.tensor(a).float() for a in load_diabetes(return_X_y=True))
    order = torch.randperm(len(y), generator=torch.Generator().manual_seed(seed))
    held_out, kept = order[: len(y) // 4], order[len(y) // 4 :]
    return corrupted(x[kept], y[kept], x[held_out], y[held_out], share, seed)


def friedman(share: float, seed: int) -> Table:
    """Friedman's first function of ten columns, five of them idle; held out are 2000 rows without noise."""
    x, y = (torch.tensor(a).float() for a in make_friedman1(1000, noise=1.0, random_state=seed))
    new_x, new_y = (torch.tensor(a).float() for a in make_friedman1(2000, noise=0.0, random_state=10_000 + seed))
    return corrupted(x, y, new_x, new_y, share, seed)


@dataclass(frozen=True)
class Task:
    """A table with the width, weight decay and epochs that are best for the mean squared error on clean targets."""

    draw: Callable[[float, int], Table]
    width: int
    weight_decay: float
    epochs: int


TASKS = {
    "diabetes": Task(diabetes, width=16, weight_decay=1.0, epochs=30),
    "Friedman 1": Task(friedman, width=64, weight_decay=0.3, epochs=60),
}


@dataclass
class Outcome:
    """Result of a run: the held-out error; for MKC also its loss and the weight of each training row."""

    error: float
    criterion: nn.Module | None = None
    fitted: Tensor = field(default_factory=lambda: torch.empty(0))
    weight: Tensor = field(default_factory=lambda: torch.empty(0))
    found: float = float("nan")
    mistaken: float = float("nan")


def outcome(task: Task, name: str, share: float, seed: int) -> Outcome:
    """Train with a loss; the targets are in units of their median absolute deviation."""
    table = task.draw(share, seed)
    centre = table.y.median()
    scale = 1.4826 * (table.y - centre).abs().median()
    y = (table.y - centre) / scale

    def error_of(prediction: Tensor) -> float:
        return float((scale * prediction + centre - table.held_out_y).square().mean().sqrt())

    if name == LINEAR:
        linear = HuberRegressor(max_iter=1000).fit(table.x.numpy(), y.numpy())
        return Outcome(error_of(torch.tensor(linear.predict(table.held_out_x.numpy()))))
    torch.manual_seed(seed)
    net = perceptron(table.x.shape[1], task.width, task.width, 1)
    # the largest error of a prediction within the range of the targets
    makers = losses(1, bound=float(y.max() - y.min()))
    module = Regression(net, makers["MSE" if name == ORACLE else name](), weight_decay=task.weight_decay, annealed=True)
    used = ~table.wrong if name == ORACLE else torch.ones_like(table.wrong)
    train(module, table.x[used], y[used].unsqueeze(-1), epochs=task.epochs)
    with torch.no_grad():
        out = Outcome(error_of(net(table.held_out_x)[:, 0]), module.criterion)
        if isinstance(module.criterion, MKCLoss):
            fitted, recorded = net(table.x), y.unsqueeze(-1)
            out.fitted = scale * fitted[:, 0] + centre
            out.weight = inlier_weight(module.criterion, fitted, recorded)[:, 0]
            flagged = outliers(module.criterion, fitted, recorded)[:, 0]
            out.found, out.mistaken = (float(flagged[rows].double().mean()) for rows in (table.wrong, ~table.wrong))
    return out


Outcomes = dict[str, list[Outcome]]


def ratio(outcomes: Outcomes, name: str, reference: str) -> tuple[float, float]:
    """Return mean and standard error over seeds of the ratio of two losses' errors on the same rows."""
    return mean_and_error([a.error / b.error for a, b in zip(outcomes[name], outcomes[reference], strict=True)])


def report(title: str, bad: Outcomes, good: Outcomes, share: float) -> None:
    """Print a table of the losses."""
    print(f"\n{title}, {len(good['MSE'])} seeds")
    print(f"{'':26}{f'{share:.0%} wrong targets':^36}{'no wrong target':^18}")
    print(f"{'':26}{'error':>18}{'over oracle':>18}{'over MSE':>18}")
    for name in NAMES:
        columns = [mean_and_error([o.error for o in bad[name]]), ratio(bad, name, ORACLE), ratio(good, name, "MSE")]
        digits = (2, 3, 3)
        print(f"{name:26}" + "".join(f"{m:10.{k}f} ± {e:.{k}f}" for k, (m, e) in zip(digits, columns, strict=True)))
    for name in (MKC_EM, MKC_JOINT, MKC_AUTO):
        own = [o.criterion for o in bad[name] if isinstance(o.criterion, MKCLoss)]
        sigma, d = (torch.stack([getattr(c, key).detach() for c in own]).median() for key in ("sigma", "d"))
        found, mistaken = (mean_and_error([getattr(o, key) for o in bad[name]])[0] for key in ("found", "mistaken"))
        print(
            f"{name}: sigma {sigma:.3g}, d {d:.3g}; flags {found:.1%} of the wrong targets, {mistaken:.1%} of the right"
        )


def picture(path: str, bad: dict[str, Outcomes], good: dict[str, Outcomes], share: float) -> None:
    """Draw the errors of each loss, and the weights of MKC-EM for the targets of the first seed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    for row, title in enumerate(TASKS):
        errors, weights = figure.add_subplot(2, 2, 2 * row + 1), figure.add_subplot(2, 2, 2 * row + 2)
        names = [n for n in reversed(NAMES) if n != ORACLE]
        for outcomes, reference, (color, face), label in (
            (good, "MSE", ("0.5", "white"), "no wrong target, over MSE"),
            (bad, ORACLE, ("C3", "C3"), f"{share:.0%} wrong targets, over MSE without them"),
        ):
            means, spreads = zip(*(ratio(outcomes[title], name, reference) for name in names), strict=True)
            errors.errorbar(means, names, xerr=spreads, fmt="o", color=color, mfc=face, label=label)
        errors.axvline(1.0, color="0.85", zorder=0)
        errors.set_xscale("log")
        low, high = errors.get_xlim()
        ticks = [t for t in (1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0) if low < t < high]
        errors.set_xticks(ticks, [f"{t:g}" for t in ticks])
        errors.minorticks_off()
        errors.set_title(title, loc="left")
        errors.set_xlabel("root mean square error on held-out rows, relative")
        table, first = TASKS[title].draw(share, 0), bad[title][MKC_EM][0]
        for rows, marker, label in ((~table.wrong, "o", "right"), (table.wrong, "^", "too large")):
            dots = weights.scatter(
                first.fitted[rows],
                table.y[rows],
                c=first.weight[rows],
                s=14.0,
                cmap="coolwarm_r",
                vmin=0.0,
                vmax=1.0,
                marker=marker,
                edgecolors="0.3",
                linewidths=0.3,
            )
            weights.plot([], [], marker, color="0.5", label=label)
        weights.set_yscale("log")
        weights.set_title("weight of each training target in MKC-EM", loc="left")
        weights.set_ylim(top=4.0 * float(table.y.max()))  # room for the legend
        weights.set_xlabel("predicted target")
        weights.set_ylabel("recorded target")
        weights.legend(frameon=False, loc="upper left", ncols=2)
        figure.colorbar(dots, ax=weights, label="inlier weight")
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--share", type=float, default=0.2)
    parser.add_argument("--output", metavar="PICTURE.png")
    options = parser.parse_args()
    quiet()
    bad: dict[str, Outcomes] = {}
    good: dict[str, Outcomes] = {}
    for title, task in TASKS.items():
        for share, into in ((options.share, bad), (0.0, good)):
            into[title] = {n: [outcome(task, n, share, s) for s in range(options.seeds)] for n in NAMES}
        report(title, bad[title], good[title], options.share)
    if options.output:
        picture(options.output, bad, good, options.share)


if __name__ == "__main__":
    main()
