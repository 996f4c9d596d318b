"""``mkc challenge``: the blind proof of this installation's own diagnosis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from mkc_torch._parallel.fork import allow_copies
from mkc_torch._parallel.processes import cores, keep_memory, one_thread
from mkc_torch.cli.apply import correct, read_correction
from mkc_torch.cli.console import FAILURES, Look, complain, interrupts_told, out, progress
from mkc_torch.cli.diagnosis_files import MAGNETOMETER, Request, diagnose_file, named_simulation
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.challenge import Score
    from mkc_torch.challenge.score import Measured
    from mkc_torch.challenge.subject import Subject
    from mkc_torch.challenge.world import Worlds

_QUIET = Look(terminal=False, width=100)


class Family(str, Enum):
    """What a proof is about."""

    magnetometer = "magnetometer"
    dynamics = "dynamics"


def challenge(
    output: Annotated[Path, typer.Option(help="Folder for recordings, key, diagnoses and page.")] = Path(
        "mkc_challenge"
    ),
    family: Annotated[
        Family, typer.Option(help="A magnetometer, or differential equations as a user writes them.")
    ] = Family.magnetometer,
    cases: Annotated[
        int | None,
        typer.Option(metavar="N", min=0, help="Recordings with something hidden; default: 240, of dynamics 100."),
    ] = None,
    empty: Annotated[
        int | None,
        typer.Option(
            metavar="M", min=0, help="Recordings with nothing hidden; default: 5 for 3 others, of dynamics 3 for 2."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="Of all that is drawn.")] = 1,
    duration: Annotated[
        float | None,
        typer.Option(metavar="s", min=10.0, help="Length of a magnetometer's recording in s; default: 90."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="W", min=1, help="Processes; default: as many as cores.")
    ] = None,
    worlds: Annotated[
        bool,
        typer.Option(
            "--worlds",
            help="Worlds of noise, inputs and misfits, each drawn and reported on its own, instead.",
        ),
    ] = False,
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="With --worlds: this world alone; may be repeated.")
    ] = None,
    per_world: Annotated[
        int | None,
        typer.Option(metavar="N", min=0, help="With --worlds: recordings with nothing hidden in each; default: 60."),
    ] = None,
    hidden_per_world: Annotated[
        int | None,
        typer.Option(
            metavar="H", min=0, help="With --worlds: recordings with something hidden in each; default: a third of N."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Hide physics in simulated recordings, have them diagnosed by who was not told, and only then open the key.

    A hash of the key is written before the first diagnosis, so that it can be shown not to have changed.
    """
    from mkc_torch.challenge import run

    _refuse_mixed(worlds, {"--cases": cases, "--empty": empty}, "leave it out with --worlds, which has --per-world")
    own = {"--only": only or None, "--per-world": per_world, "--hidden-per-world": hidden_per_world}
    _refuse_mixed(not worlds, own, "add --worlds")
    if worlds:
        _in_worlds(family, duration, only or [], per_world, hidden_per_world, seed, output, workers, force)
        return
    subject = _subject(family, duration)
    cases = subject.cases if cases is None else cases
    empty = round(cases * subject.empty / subject.cases) if empty is None else empty
    if cases + empty == 0:
        raise typer.BadParameter("--cases and --empty are both 0; ask for one recording at least.")
    diagnose, correct_one = _JOBS[family]
    one_thread()
    keep_memory()
    allow_copies(0)  # the workers are as many processes as was asked for
    try:
        with interrupts_told(lambda: f"what was done so far is in {output}."), progress(cases + empty) as step:
            score = run.run_challenge(
                diagnose, correct_one, subject=subject, cases=cases, empty=empty, seed=seed, output=output,
                overwrite=force, workers=min(workers or cores(), cases + empty), progress=step.count,
            )  # fmt: skip
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    _show(score, cases, empty, output)


def _subject(family: Family, duration: float | None) -> Subject:
    from mkc_torch.challenge.dynamics.subject import dynamics
    from mkc_torch.challenge.magnetometer.subject import magnetometer

    _refuse_length(family, duration)
    if family is Family.magnetometer:
        return magnetometer() if duration is None else magnetometer(duration)
    return dynamics()


def _refuse_mixed(refused: bool, given: Mapping[str, object], advice: str) -> None:
    for name, value in given.items():
        if refused and value is not None:
            raise typer.BadParameter(f"{name} is not of this kind of proof; {advice}.")


def _in_worlds(
    family: Family,
    duration: float | None,
    only: list[str],
    per_world: int | None,
    hidden: int | None,
    seed: int,
    output: Path,
    workers: int | None,
    force: bool,
) -> None:
    from mkc_torch.challenge.worlds import run
    from mkc_torch.cli.worlds_summary import show_worlds

    asked = _worlds(family, duration)
    per_world = run.PER_WORLD if per_world is None else per_world
    try:
        total = run.count(asked, only, per_world, hidden)
    except ValueError as error:
        raise typer.BadParameter(f"--only: {error}") from None
    if total == 0:
        raise typer.BadParameter("--per-world and --hidden-per-world are both 0; ask for one recording at least.")
    one_thread()
    keep_memory()
    allow_copies(0)  # the workers are as many processes as was asked for
    try:
        with interrupts_told(lambda: f"what was done so far is in {output}."), progress(total) as step:
            score = run.run_worlds(
                diagnose_in_world, asked, only=only, per_world=per_world, hidden=hidden, seed=seed, output=output,
                overwrite=force, workers=min(workers or cores(), total), progress=step.count,
            )  # fmt: skip
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    show_worlds(score, total, output)


def _worlds(family: Family, duration: float | None) -> Worlds:
    from mkc_torch.challenge.dynamics.worlds import dynamics_worlds
    from mkc_torch.challenge.magnetometer.worlds import magnetometer_worlds

    _refuse_length(family, duration)
    if family is Family.magnetometer:
        return magnetometer_worlds() if duration is None else magnetometer_worlds(duration)
    return dynamics_worlds()


def _refuse_length(family: Family, duration: float | None) -> None:
    if family is Family.dynamics and duration is not None:
        raise typer.BadParameter("--duration is of the magnetometer's recordings; each system has a length of its own.")


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
    from mkc_torch.challenge.worlds.run import SIMULATIONS

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


_JOBS = {
    Family.magnetometer: (diagnose_unseen, correct_unseen),
    Family.dynamics: (diagnose_dynamics, correct_dynamics),
}


def _counts(measured: Measured) -> bool:
    """Whether it is a number of recordings."""
    return math.isinf(measured.threshold.high)


def _not(measured: Measured) -> str:
    return "too few" if _counts(measured) else "no"


def _show(score: Score, cases: int, empty: int, output: Path) -> None:
    from mkc_torch.challenge.page import measured_text, share_text

    console = out()
    console.print()
    console.print(Text(f"Blind proof: {cases + empty:,} recordings, something hidden in {cases:,}", style="bold"))
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("asked", overflow="fold")
    table.add_column("measured", justify="right")
    table.add_column("holds")
    for m in score.measured:
        table.add_row(
            Text(m.threshold.sentence),
            measured_text(m),
            Text("—") if math.isnan(m.value) else Text("yes") if m.holds else Text(_not(m), style="bold yellow"),
        )
    console.print(table)
    if few := [m for m in score.measured if _counts(m) and not m.holds]:
        found = " and ".join(f"{m.value:.0f} of at least {m.threshold.low:.0f}" for m in few)
        console.print(
            f"Too few recordings to tell ({found}): what holds here, and what does not, may be chance. Leave out "
            "--cases and --empty for a run of full size."
        )
    facts = Table.grid(padding=(0, 3, 0, 0))
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    facts.add_row("said of empty", ", ".join(f"{verdict} {count}" for verdict, count in score.verdicts.items()))
    facts.add_row("false alarms", share_text(score.false_alarms))
    facts.add_row("named right", share_text(score.named))
    if score.driver.total:
        facts.add_row("driver right", share_text(score.driver))
    if score.located.total:
        facts.add_row("located right", share_text(score.located))
    facts.add_row("failed", ", ".join(score.failed) or "none")
    console.print(facts)
    for name in ("challenge.html", "summary.md", "key_hash.txt"):
        # outside the table, where a long path would be broken and could not be copied
        console.print(Text.assemble(f"{'written':<15}", (str(output / name), "cyan")), soft_wrap=True)
