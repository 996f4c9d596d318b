"""Shared by the examples: diagnose on some runs, and simulate others with and without the findings."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from PIL import Image

from mkc_torch import Diagnosis, Recording, diagnose
from mkc_torch.simulation import Dynamics

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "dynamics"
"""Default folder of the recordings, next to the project's folder."""


@dataclass(frozen=True)
class Proof:
    """A diagnosis, and the outputs (N, m) of runs that it has not seen: measured, simulated without and with it."""

    diagnosis: Diagnosis
    time: torch.Tensor
    measured: torch.Tensor
    before: torch.Tensor
    after: torch.Tensor

    def root_mean_square(self, scored: torch.Tensor | slice = slice(None)) -> tuple[float, float]:
        """Error before and after."""
        before, after = (self.measured - self.before)[scored], (self.measured - self.after)[scored]
        return float(before.square().mean().sqrt()), float(after.square().mean().sqrt())

    def mean_absolute(self, scored: torch.Tensor | slice = slice(None)) -> tuple[float, float]:
        """Error before and after."""
        before, after = (self.measured - self.before)[scored], (self.measured - self.after)[scored]
        return float(before.abs().mean()), float(after.abs().mean())


def prove(system: Dynamics, train: Recording, tests: Sequence[Recording], *, max_findings: int = 3) -> list[Proof]:
    """Diagnose the simulation on some runs, and simulate others with the findings."""
    found = diagnose(system, train, max_findings=max_findings)
    nominal = diagnose(system, train, effects=(), max_findings=0)
    assert found.model is not None
    assert nominal.model is not None
    proofs = []
    for test in tests:
        columns, plain = found.model(test), nominal.model(test)
        names = [name for name in columns if name not in ("time", "experiment")]
        before, after = (torch.stack([run[name] for name in names], -1) for run in (plain, columns))
        proofs.append(Proof(found, columns["time"], test.stack(*names), before, after))
    return proofs


def finding_text(diagnosis: Diagnosis) -> str:
    """The findings in a line."""
    if not diagnosis.findings:
        return f"nothing found (p = {diagnosis.p_value:.2f})"
    parts = []
    for finding in diagnosis.findings:
        rivals = [a.effect for a in finding.alternatives if not a.separable]
        undecided = f", not distinguished from {', '.join(rivals)}" if rivals else ""
        parts.append(f"{finding.effect} (p = {finding.p_value:.2f}{undecided})")
    return "; then ".join(parts)


def picture(proof: Proof, path: Path, title: str, quantity: str, unit: str, rows: slice = slice(None)) -> None:
    """Unseen runs as measured and as simulated, and the errors of both simulations, over time if it is one run."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    time = proof.time[rows]
    one_run = bool((time.diff() > 0).all())
    x = time if one_run else torch.arange(len(time))
    measured, before, after = (series[rows, 0] for series in (proof.measured, proof.before, proof.after))
    above.plot(x, measured, color="black", linewidth=2.0, label="measured, not used in the fit")
    above.plot(x, before, color="#D55E00", label="simulation")
    above.plot(x, after, color="#0072B2", label="simulation with the findings")
    above.set_ylabel(f"{quantity} ({unit})")
    above.set_title(title)
    above.legend(loc="best")
    below.axhline(0.0, color="black", linewidth=0.6)
    below.plot(x, measured - before, color="#D55E00")
    below.plot(x, measured - after, color="#0072B2")
    below.set_ylabel(f"error ({unit})")
    below.set_xlabel("time (s)" if one_run else "sample of the joined runs")
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    plt.close(figure)
    # few colours halve the file
    Image.open(buffer).convert("P", palette=Image.Palette.ADAPTIVE, colors=48).save(path, optimize=True)


def arguments(description: str) -> argparse.Namespace:
    """Command line of an example."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with the recordings of the four systems")
    parser.add_argument("--output", type=Path, help="PNG file to write")
    return parser.parse_args()
