"""What a blind proof has done with its recordings: they are diagnosed and corrected as the commands of that do it."""

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

__all__ = ["JOBS", "correct_dynamics", "correct_unseen", "diagnose_dynamics", "diagnose_in_world", "diagnose_unseen"]

_QUIET = ConsoleStyle(terminal=False, width=100)


def diagnose_unseen(paths: list[Path], folder: Path) -> None:
    """Diagnose recordings as ``mkc diagnose`` does, but for the reports, which nobody reads in this number."""
    for path in paths:
        _diagnose(path, folder, Request(force=True, report=False))


def diagnose_dynamics(paths: list[Path], folder: Path) -> None:
    """The same with ``--simulation``, of the proof's own file."""
    for path in paths:
        _diagnose(path, folder, Request(simulation=_simulation(path), force=True, report=False))


def diagnose_in_world(paths: list[Path], folder: Path) -> None:
    """The same with ``--simulation``, of the file that lies ready for a recording, if there is one."""
    from mkc_torch.challenge.dynamics.subject import simulation_class
    from mkc_torch.challenge.scenarios.run import SIMULATIONS

    for path in paths:
        file = folder.parent / SIMULATIONS / f"{path.stem}.py"
        name = "sensor" if path.stem.startswith("case_") else simulation_class(path)
        simulation = f"{file}:{name}" if file.is_file() else MAGNETOMETER
        _diagnose(path, folder, Request(simulation=simulation, force=True, report=False))


def _diagnose(path: Path, folder: Path, request: Request) -> None:
    place = folder / path.stem
    for old in ("diagnosis.json", "model.json"):  # of an earlier run, which would be scored in place of a failure
        (place / old).unlink(missing_ok=True)
    for outcome in diagnose_file(path, place, request, _QUIET):
        if outcome.failed:
            (folder / f"{path.stem}.error.txt").write_text(f"{outcome.text}\n", encoding="utf-8")


def correct_unseen(model: Path, recording: Path) -> Mapping[str, Tensor]:
    """A recording corrected as ``mkc apply`` does."""
    return correct(read_correction(model), Recording.read(recording)).columns


def correct_dynamics(model: Path, recording: Path) -> Mapping[str, Tensor]:
    """The same with ``--simulation``."""
    simulation = named_simulation(_simulation(recording))
    return correct(read_correction(model, simulation), Recording.read(recording)).columns


def _simulation(recording: Path) -> str:
    """``FILE.py:CLASS`` of a recording in a proof's folder."""
    from mkc_torch.challenge.dynamics.subject import simulation_class
    from mkc_torch.challenge.run import SIMULATIONS

    return f"{recording.parent.parent / SIMULATIONS}:{simulation_class(recording)}"


JOBS = {
    "magnetometer": (diagnose_unseen, correct_unseen),
    "dynamics": (diagnose_dynamics, correct_dynamics),
}
"""How a recording of each family is diagnosed, and how it is corrected."""
