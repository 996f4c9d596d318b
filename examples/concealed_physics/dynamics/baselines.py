"""PySINDy and a small neural ODE compared with the simulations: same training runs, unseen runs and error measure.

Both are tuned inside the training runs: fitted on the first part of each, judged by a free run over the rest, and then
refitted on all of it. PySINDy's library has the terms of the simulation and those of the catalogue that can be
written as a sum of known functions of states and inputs; delays, lags and saturations cannot. The neural ODE adds a
perceptron to the rates that the simulation knows, whose parameters are trained with it; it names nothing.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from held_out import DATA, finding_text, prove
from library import PHYSICS, Physics
from neural import neural_ode
from problem import Outcome, plain, problem_of, shortened
from sparse_regression import sindy
from systems import Case, balls, heaters, servo, silverbox

METHODS = ("PySINDy", "neural ODE")
SYSTEMS: dict[str, Callable[[Path], list[Case]]] = {
    "balls": balls,
    "heaters": lambda data: [heaters(data)],
    "silverbox": lambda data: [silverbox(data)],
    "servo": lambda data: [servo(data)],
}

T = TypeVar("T")


def ours(case: Case) -> Outcome:
    """Return the result of `diagnose`, as in the example of the system."""
    findings = 3 if case.name == "heaters" else 1
    proofs = prove(case.system, case.train, list(case.tests.values()), max_findings=findings)
    scored = [proof.time - proof.time[0] > case.scored_from for proof in proofs]
    absolute = PHYSICS[case.system.name].absolute
    errors = [
        (proof.mean_absolute(rows) if absolute else proof.root_mean_square(rows))[1]
        for proof, rows in zip(proofs, scored, strict=True)
    ]
    return Outcome(errors, finding_text(proofs[0].diagnosis), "as in the example")


@dataclass(frozen=True)
class Row:
    """A case with the outcome of each method."""

    case: Case
    plain: Outcome
    outcomes: Mapping[str, Outcome]


def compared(case: Case, methods: Sequence[str], seed: int) -> Row:
    """Run a case with the simulation and each method, and print the results as they arrive."""
    physics = PHYSICS[case.system.name]

    def result_text(outcome: Outcome) -> str:
        return " and ".join(in_unit([value], physics) for value in outcome.errors)

    (fitted, errors), seconds = timed(lambda: plain(case))
    simulated = Outcome(errors, "-", "no effects", seconds)
    print(f"{case.name}: simulation {result_text(simulated)}", flush=True)
    outcomes = {}
    if "PySINDy" in methods or "neural ODE" in methods:
        start, for_both = timed(lambda: plain(shortened(case))[0] if len(fitted) else fitted)
        problem, early = problem_of(case, fitted), problem_of(case, start)
    for method in methods:
        if method == "ours":
            outcome, seconds = timed(lambda: ours(case))
        elif method == "PySINDy":
            outcome, seconds = timed(lambda: sindy(problem, early))
        else:
            outcome, seconds = timed(lambda: neural_ode(problem, early, seed))
        if method != "ours":
            seconds += for_both + (simulated.seconds if len(fitted) else 0.0)
        outcomes[method] = replace(outcome, seconds=seconds)
        print(f"  {method}: {result_text(outcome)}; {outcome.name}; {outcome.settings}; {seconds:.0f} s", flush=True)
    return Row(case, simulated, outcomes)


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Return the result of a call and its processor time in s."""
    started = time.process_time()
    found = call()
    return found, time.process_time() - started


def mean_of(errors: Sequence[float]) -> tuple[float, int]:
    """Return the mean of the finite errors, and the number of the others.

    Example:
        >>> mean_of([1.0, math.inf, 3.0])
        (2.0, 1)
    """
    finite = [value for value in errors if math.isfinite(value)]
    return (sum(finite) / len(finite) if finite else math.inf), len(errors) - len(finite)


def in_unit(errors: Sequence[float], physics: Physics) -> str:
    """Return the mean error in the unit of the system, and the number of diverged runs."""
    mean, diverged = mean_of(errors)
    if len(errors) == diverged:
        return "diverged"
    return f"{mean * physics.factor:.3f} {physics.unit}" + (
        f" ({diverged} of {len(errors)} diverged)" if diverged else ""
    )


def table(rows: Sequence[Row]) -> str:
    """Return a table with a line for each unseen run and method; several balls share a line with their mean."""
    lines = ["| unseen | method | error | found | processor |", "|---|---|---:|---|---:|"]
    balls_ = [row for row in rows if row.case.system.name == "Ball"]
    groups = ([balls_] if balls_ else []) + [[row] for row in rows if row not in balls_]
    for group in groups:
        case, physics = group[0].case, PHYSICS[group[0].case.system.name]
        what = f"balls, mean of {len(group)}" if case.system.name == "Ball" else case.name
        for method in ("simulation", *group[0].outcomes):
            outcomes = [row.plain if method == "simulation" else row.outcomes[method] for row in group]
            name = outcomes[0].name if len(group) == 1 else counted([outcome.name for outcome in outcomes])
            seconds = f"{sum(outcome.seconds for outcome in outcomes):.0f} s"
            for index, test in enumerate(case.tests):
                error_ = in_unit([outcome.errors[index] for outcome in outcomes], physics)
                lines.append(f"| {what}, {test} | {method} | {error_} | {name} | {seconds} |")
    return "\n".join(lines)


def counted(names: Sequence[str]) -> str:
    """Format the names with their counts, the most frequent first.

    Example:
        >>> counted(["drag", "nothing", "drag"])
        'drag (2), nothing (1)'
    """
    if set(names) == {"-"}:
        return "-"
    return ", ".join(f"{name} ({count})" for name, count in Counter(names).most_common())


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with the recordings of the four systems")
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS), help="systems to run")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="baselines to run")
    parser.add_argument(
        "--ours", action="store_true", help="also run our diagnosis, minutes each, except for the servo"
    )
    parser.add_argument(
        "--servo-too", action="store_true", help="with --ours: run it for the servo too, which may not end"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the neural ODE's initial weights")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    if "PySINDy" in options.methods and importlib.util.find_spec("pysindy") is None:
        raise SystemExit('PySINDy is not installed; `pip install "mkc-torch[examples]"`, or --methods "neural ODE".')
    rows = []
    for system in options.systems:
        try:
            cases = SYSTEMS[system](options.data)
        except FileNotFoundError as error:
            raise SystemExit(str(error)) from None
        own = ["ours"] if options.ours and (system != "servo" or options.servo_too) else []
        rows += [compared(case, options.methods + own, options.seed) for case in cases]
    print(table(rows))


if __name__ == "__main__":
    main()
