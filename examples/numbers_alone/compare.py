"""Compare a fit of numbers alone with a diagnosis: ``python -m examples.numbers_alone.compare --output DIR``.

For each recording, `mujoco.sysid` fits the damping of both joints, and `mkc diagnose` fits the same numbers and looks
for missing physics. Both models then predict a second recording with other commands, from its first sample.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from examples.numbers_alone.recordings import ARM, HIDDEN, JOINTS, NUMBERS, Hidden, recorded
from mkc_torch.diagnosis import diagnose
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.parts import Finding
from mkc_torch.diagnosis.validation.predict import predict
from mkc_torch.recording import Recording
from mkc_torch.simulation import load_mjcf

SAMPLES = 400

LINES = (
    ("the model's file", "tab:gray"),
    ("numbers fitted by mujoco.sysid", "tab:orange"),
    ("physics named by mkc diagnose", "tab:blue"),
)
"""Label and colour of each model's error in the picture."""


def compared(
    hidden: Hidden, fitted: dict[str, float], samples: int = SAMPLES, seed: int = 1, picture: Path | None = None
) -> dict[str, Any]:
    """Return what both fits found, and the error of each model on a second recording.

    Args:
        hidden: what the recordings have more.
        fitted: the numbers by `mujoco.sysid`.
        samples: of each recording.
        seed: of the first recording.
        picture: file of a picture of the second recording; None for none.
    """
    first, second = (as_recording(recorded(hidden, samples, number)) for number in (seed, seed + 1))
    with TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(ARM, encoding="utf-8")
        arm = load_mjcf(Path(folder) / "arm.xml")
        diagnosis = diagnose(arm, first, quick=True)
        model = diagnosis.model
        assert isinstance(model, DiagnosedModel)
        ours = dict(zip(arm.parameters, model.theta.tolist(), strict=False))
        findings = [_in_words(finding) for finding in diagnosis.findings]
        models = {"file": without_findings(arm, NUMBERS), "sysid": without_findings(arm, fitted), "mkc": model}
        residuals = {name: predict(known, second).residual.detach() for name, known in models.items()}
    if picture is not None:
        draw(picture, hidden, second, residuals)
    return {
        "hidden": hidden.name,
        "numbers": {"sysid": fitted, "mkc": ours},
        "findings": findings,
        "error": {name: float(residual.square().mean().sqrt()) for name, residual in residuals.items()},
    }


def as_recording(columns: dict[str, Any]) -> Recording:
    return Recording({name: torch.from_numpy(np.asarray(values)) for name, values in columns.items()})


def without_findings(arm: Any, numbers: Mapping[str, float]) -> DiagnosedModel:
    """The model with these numbers and no findings."""
    values = torch.tensor([numbers[name] for name in arm.parameters], dtype=torch.float64)
    return DiagnosedModel(arm.name, {"input_hold": {}}, values, (), (), arm)


def _in_words(finding: Finding) -> str:
    first = finding.parameters[0]
    value = float(torch.as_tensor(first.value).flatten()[0])
    return f"{finding.effect} at {', '.join(finding.channels)}: {first.name} {value:.3g} {first.unit}".strip()


def draw(file: Path, hidden: Hidden, second: Recording, residuals: Mapping[str, torch.Tensor]) -> None:
    """Draw the last joint of the second recording, and the error of each model's free run."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (above, below) = plt.subplots(2, sharex=True, figsize=(8.0, 4.5), layout="constrained")
    time = second["time"]
    above.plot(time, second[JOINTS[-1]], color="black", linewidth=1.0)
    above.set(ylabel=f"{JOINTS[-1]}, rad", title=f"A second recording of an arm: {hidden.name}")
    for residual, (label, color) in zip(residuals.values(), LINES, strict=True):
        rmse = float(residual.square().mean().sqrt())
        below.plot(time, residual[:, -1], label=f"{label}\n(both joints: {rmse:.4f} rad)", color=color, linewidth=1.2)
    below.set(xlabel="time, s", ylabel="recorded - simulated, rad")
    figure.legend(loc="outside lower center", ncols=len(LINES), frameon=False, fontsize="small")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The comparison as a table in Markdown; errors in rad."""
    lines = [
        "| hidden | damping by sysid | damping by mkc | found | error of the file | after sysid | after mkc |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        numbers = [", ".join(f"{value:.3f}" for value in row["numbers"][by].values()) for by in ("sysid", "mkc")]
        errors = [f"{row['error'][by]:.4f}" for by in ("file", "sysid", "mkc")]
        lines.append(
            f"| {row['hidden']} | {' | '.join(numbers)} | {'; '.join(row['findings'])} | {' | '.join(errors)} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder for rows.json, table.md and pictures")
    parser.add_argument("--only", type=int, choices=range(len(HIDDEN)), help="number of a single comparison")
    given = parser.parse_args(arguments)
    from examples.numbers_alone.least_squares import fitted_numbers

    given.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for number, hidden in enumerate(HIDDEN):
        if given.only not in (None, number):
            continue
        numbers = fitted_numbers(recorded(hidden, SAMPLES, 1))
        rows.append(compared(hidden, numbers, picture=given.output / f"second_{number}.png"))
        print(f"{hidden.name}: {rows[-1]['error']}", flush=True)
        (given.output / "rows.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    (given.output / "table.md").write_text(table(rows) + "\n", encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
