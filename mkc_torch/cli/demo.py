"""``mkc demo``: calibrate, diagnose and correct simulated sensors whose true parameters are known."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch._support.files import claim_folder
from mkc_torch.cli.console import FAILURES, complain, folder_written, interrupts_reported, out, progress
from mkc_torch.cli.loading import loading


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the recordings, results and reports.")] = Path("mkc_demo"),
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Calibrate, diagnose and correct SIMULATED sensors, and compare with the truth. No file is needed."""
    with loading():
        from mkc_torch._parallel.processes import keep_memory, one_thread
        from mkc_torch.cli.demonstration import (
            CONCEALED,
            FILES,
            calibrate_simulated,
            correct_second,
            diagnose_simulated,
            show_calibration,
            show_diagnosis,
        )
        from mkc_torch.cli.diagnosis_files import WRITTEN
    one_thread()
    keep_memory()
    console = out()
    try:
        claim_folder(output, overwrite=force, files=FILES)
        place = claim_folder(output / CONCEALED, overwrite=force, files=WRITTEN)
        with (
            interrupts_reported(lambda: _written(output)),
            folder_written(output),
            folder_written(place),
            progress(1) as step,
        ):
            step("calibrating a simulated sensor")
            calibration, rows, files = calibrate_simulated(output, force=force)
            with step.aside():
                show_calibration(console, calibration, rows, files)
            step("diagnosing a simulated sensor next to a cable")
            diagnosis, found = diagnose_simulated(output, force=force)
            step("correcting a second recording")
            second = correct_second(output, diagnosis, force=force)
            with step.aside():
                show_diagnosis(console, diagnosis, found, second)
    except FAILURES as error:
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            raise  # an error of the terminal, not of a file
        complain(output, error)
        raise typer.Exit(1) from None
    console.print(f"\nNext: open {files[-1]} and {output / CONCEALED / 'report.html'}, or", soft_wrap=True)
    for model, table in (("calibration.json", "recording.csv"), (f"{CONCEALED}/model.json", "second.csv")):
        command = shlex.join(["mkc", "apply", str(output / model), str(output / table), "--output", "corrected.csv"])
        console.print(f"  {command}", soft_wrap=True)


def _written(output: Path) -> str:
    """Return a sentence on what an interrupt left in the folder."""
    return f"{output} may be incomplete." if output.is_dir() else f"nothing was written to {output}."
