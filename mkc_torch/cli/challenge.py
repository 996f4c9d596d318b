"""``mkc challenge``: the blind proof of this installation's own diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, interrupts_told, progress
from mkc_torch.cli.loading import loading

if TYPE_CHECKING:
    from mkc_torch.challenge.scenario import Scenarios
    from mkc_torch.challenge.subject import Subject


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
            metavar="H",
            min=0,
            help="With --worlds: recordings with something hidden in each; default: what each world asks for.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Hide physics in simulated recordings, have them diagnosed by who was not told, and only then open the key.

    A hash of the key is written before the first diagnosis, so that it can be shown not to have changed.
    """
    _refuse_mixed(worlds, {"--cases": cases, "--empty": empty}, "leave it out with --worlds, which has --per-world")
    own = {"--only": only or None, "--per-world": per_world, "--hidden-per-world": hidden_per_world}
    _refuse_mixed(not worlds, own, "add --worlds")
    if family is Family.dynamics and duration is not None:
        raise typer.BadParameter("--duration is of the magnetometer's recordings; each system has a length of its own.")
    with loading():
        from mkc_torch._parallel.pool import allow_copies
        from mkc_torch._parallel.processes import cores, keep_memory, one_thread
        from mkc_torch.challenge import run
        from mkc_torch.cli.challenge_jobs import JOBS
        from mkc_torch.cli.challenge_summary import show_challenge
    if worlds:
        _in_worlds(family, duration, only or [], per_world, hidden_per_world, seed, output, workers, force)
        return
    subject = _subject(family, duration)
    cases = subject.cases if cases is None else cases
    empty = round(cases * subject.empty / subject.cases) if empty is None else empty
    if cases + empty == 0:
        raise typer.BadParameter("--cases and --empty are both 0; ask for one recording at least.")
    diagnose, correct_one = JOBS[family.value]
    one_thread()
    keep_memory()
    allow_copies(0)  # the workers are as many processes as was asked for
    try:
        with interrupts_told(lambda: f"what was done so far is in {output}."), progress(cases + empty, output) as step:
            score = run.run_challenge(
                diagnose, correct_one, subject=subject, cases=cases, empty=empty, seed=seed, output=output,
                overwrite=force, workers=min(workers or cores(), cases + empty), progress=step.count,
            )  # fmt: skip
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    show_challenge(score, cases, empty, output)


def _subject(family: Family, duration: float | None) -> Subject:
    from mkc_torch.challenge.dynamics.subject import dynamics
    from mkc_torch.challenge.magnetometer.subject import magnetometer

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
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import cores, keep_memory, one_thread
    from mkc_torch.challenge.scenarios import run
    from mkc_torch.cli.challenge_jobs import diagnose_in_world
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
        with interrupts_told(lambda: f"what was done so far is in {output}."), progress(total, output) as step:
            score = run.run_worlds(
                diagnose_in_world, asked, only=only, per_world=per_world, hidden=hidden, seed=seed, output=output,
                overwrite=force, workers=min(workers or cores(), total), progress=step.count,
            )  # fmt: skip
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    show_worlds(score, total, output)


def _worlds(family: Family, duration: float | None) -> Scenarios:
    from mkc_torch.challenge.dynamics.scenarios import dynamics_worlds
    from mkc_torch.challenge.magnetometer.scenarios import magnetometer_worlds

    if family is Family.magnetometer:
        return magnetometer_worlds() if duration is None else magnetometer_worlds(duration)
    return dynamics_worlds()
