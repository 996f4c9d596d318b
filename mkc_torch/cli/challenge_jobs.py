"""Diagnose and correct the recordings of a blind proof as ``mkc diagnose`` and ``mkc apply`` do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mkc_torch.cli.console import ConsoleStyle
from mkc_torch.cli.correction import correct, read_correction
from mkc_torch.cli.diagnosis_files import diagnose_file, named_simulation
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["JOBS", "correct_dynamics", "correct_unseen", "diagnose_dynamics", "diagnose_in_scenario", "diagnose_unseen"]

_QUIET = ConsoleStyle(terminal=False, width=100)


def diagnose_unseen(paths: list[Path], folder: Path) -> None:
    """Diagnose magnetometer recordings as ``mkc diagnose`` does, without reports."""
    for path in paths:
        _diagnose(path, folder, Request(force=True, report=False))


def diagnose_dynamics(paths: list[Path], folder: Path) -> None:
    """Diagnose recordings with the simulations in the proof's folder, without reports."""
    for path in paths:
        _diagnose(path, folder, Request(simulation=_simulation(path), force=True, report=False))


def diagnose_in_scenario(paths: list[Path], folder: Path) -> None:
    """Diagnose recordings of a scenario, each with the simulation file written for it, if there is one."""
    from mkc_torch.challenge.dynamics.subject import simulation_class
    from mkc_torch.challenge.scenarios.run import SIMULATIONS

    for path in paths:
        file = folder.parent / SIMULATIONS / f"{path.stem}.py"
        name = "sensor" if path.stem.startswith("case_") else simulation_class(path)
        simulation = f"{file}:{name}" if file.is_file() else MAGNETOMETER
        _diagnose(path, folder, Request(simulation=simulation, force=True, report=False))


def _diagnose(path: Path, folder: Path, request: Request) -> None:
    place = folder / path.stem
    for old in ("diagnosis.json", "model.json"):  # an old result would be scored if the diagnosis failed
        (place / old).unlink(missing_ok=True)
    for outcome in diagnose_file(path, place, request, _QUIET):
        if outcome.failed:
            (folder / f"{path.stem}.error.txt").write_text(f"{outcome.text}\n", encoding="utf-8")


def correct_unseen(model: Path, recording: Path) -> Mapping[str, Tensor]:
    """Correct a recording as ``mkc apply`` does."""
    return correct(read_correction(model), Recording.read(recording)).columns


def correct_dynamics(model: Path, recording: Path) -> Mapping[str, Tensor]:
    """Correct a recording of a dynamic system as ``mkc apply --simulation`` does."""
    simulation = named_simulation(_simulation(recording))
    return correct(read_correction(model, simulation), Recording.read(recording)).columns


def _simulation(recording: Path) -> str:
    """Return ``FILE.py:CLASS`` for a recording in a proof's folder."""
    from mkc_torch.challenge.dynamics.subject import simulation_class
    from mkc_torch.challenge.run import SIMULATIONS

    return f"{recording.parent.parent / SIMULATIONS}:{simulation_class(recording)}"


JOBS = {
    "magnetometer": (diagnose_unseen, correct_unseen),
    "dynamics": (diagnose_dynamics, correct_dynamics),
}
"""The functions that diagnose and correct the recordings of each family."""
