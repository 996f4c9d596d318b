"""``mkc challenge``: the blind proof of this installation's diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, interrupts_reported, progress
from mkc_torch.cli.loading import loading

if TYPE_CHECKING:
    from mkc_torch.challenge.scenario import Scenarios
    from mkc_torch.challenge.subject import Subject


class Family(str, Enum):
    """Family of the simulated recordings."""

    magnetometer = "magnetometer"
    dynamics = "dynamics"


def challenge(
    output: Annotated[Path, typer.Option(help="Folder for recordings, key, diagnoses and page.")] = Path(
        "mkc_challenge"
    ),
    family: Annotated[
        Family, typer.Option(help="Recordings of a magnetometer, or of systems of differential equations.")
    ] = Family.magnetometer,
    cases: Annotated[
        int | None,
        typer.Option(metavar="N", min=0, help="Recordings with hidden physics; default: 240, for dynamics 100."),
    ] = None,
    empty: Annotated[
        int | None,
        typer.Option(
            metavar="M", min=0, help="Recordings without; default: 5 for every 3 with, for dynamics 3 for every 2."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="Seed of all random draws.")] = 1,
    duration: Annotated[
        float | None,
        typer.Option(metavar="s", min=10.0, help="Length of a magnetometer recording in s; default: 90."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="W", min=1, help="Number of processes; default: the number of cores.")
    ] = None,
    scenarios: Annotated[
        bool,
        typer.Option(
            "--scenarios",
            help="Run scenarios of noise, inputs and wrong simulations, each with its own score.",
        ),
    ] = False,
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="With --scenarios: run only this scenario; repeatable.")
    ] = None,
    per_scenario: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, help="With --scenarios: recordings in each without hidden physics; default: 60."
        ),
    ] = None,
    hidden_per_scenario: Annotated[
        int | None,
        typer.Option(
            metavar="H",
            min=0,
            help="With --scenarios: recordings with hidden physics in each; default: set by the scenario.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Hide physics in simulated recordings, diagnose them without the key, then open the key and score.

    A hash of the key is written before the first diagnosis. It proves that the key did not change afterwards.
    """
    plain = {"--cases": cases, "--empty": empty}
    _refuse_mixed(scenarios, plain, "does not apply to --scenarios; use --per-scenario")
    own = {"--only": only or None, "--per-scenario": per_scenario, "--hidden-per-scenario": hidden_per_scenario}
    _refuse_mixed(not scenarios, own, "needs --scenarios; add --scenarios")
    if family is Family.dynamics and duration is not None:
        raise typer.BadParameter("--duration applies to the magnetometer; each system has a length of its own.")
    with loading():
        from mkc_torch._parallel.pool import allow_copies
        from mkc_torch._parallel.processes import cores, keep_memory, one_thread
        from mkc_torch.challenge import run
        from mkc_torch.cli.challenge_jobs import JOBS
        from mkc_torch.cli.challenge_summary import show_challenge
    if scenarios:
        _run_scenarios(family, duration, only or [], per_scenario, hidden_per_scenario, seed, output, workers, force)
        return
    subject = _subject(family, duration)
    cases = subject.cases if cases is None else cases
    empty = round(cases * subject.empty / subject.cases) if empty is None else empty
    if cases + empty == 0:
        raise typer.BadParameter("--cases and --empty are both 0; at least one recording is needed.")
    diagnose, correct_one = JOBS[family.value]
    one_thread()
    keep_memory()
    allow_copies(0)  # the number of processes is that of the workers
    results = f"the results so far are in {output}."
    try:
        with (
            interrupts_reported(lambda: results),
            progress(cases + empty, output) as step,
        ):
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
            raise typer.BadParameter(f"{name} {advice}.")


def _run_scenarios(
    family: Family,
    duration: float | None,
    only: list[str],
    per_scenario: int | None,
    hidden: int | None,
    seed: int,
    output: Path,
    workers: int | None,
    force: bool,
) -> None:
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import cores, keep_memory, one_thread
    from mkc_torch.challenge.scenarios import run
    from mkc_torch.cli.challenge_jobs import diagnose_in_scenario
    from mkc_torch.cli.scenarios_summary import show_scenarios

    family_scenarios = _scenarios(family, duration)
    per_scenario = run.PER_SCENARIO if per_scenario is None else per_scenario
    try:
        total = run.count(family_scenarios, only, per_scenario, hidden)
    except ValueError as error:
        raise typer.BadParameter(f"--only: {error}") from None
    if total == 0:
        raise typer.BadParameter("--per-scenario and --hidden-per-scenario are both 0; a recording is needed.")
    one_thread()
    keep_memory()
    allow_copies(0)  # the number of processes is that of the workers
    results = f"the results so far are in {output}."
    try:
        with interrupts_reported(lambda: results), progress(total, output) as step:
            score = run.run_scenarios(
                diagnose_in_scenario, family_scenarios, only=only, per_scenario=per_scenario, hidden=hidden, seed=seed,
                output=output, overwrite=force, workers=min(workers or cores(), total), progress=step.count,
            )  # fmt: skip
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    show_scenarios(score, total, output)


def _scenarios(family: Family, duration: float | None) -> Scenarios:
    from mkc_torch.challenge.dynamics.scenarios import dynamics_scenarios
    from mkc_torch.challenge.magnetometer.scenarios import magnetometer_scenarios

    if family is Family.magnetometer:
        return magnetometer_scenarios() if duration is None else magnetometer_scenarios(duration)
    return dynamics_scenarios()
