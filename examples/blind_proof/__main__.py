"""The blind proof of `mkc diagnose`: `python -m examples.blind_proof KIND --output DIR`, from the repository's root.

Hides physics in simulated recordings, diagnoses them without the key, then opens the key and scores the diagnoses. A
hash of the key is written before the first diagnosis; it proves that the key did not change afterwards. The kinds:

    magnetometer            recordings of a magnetometer, and a second recording of each sensor
    equations               the same for six systems of differential equations and a servo
    mujoco                  the same for five robots, stepped by MuJoCo with elements that the user's file lacks
    magnetometer_scenarios  scenarios of noise, drift and unusable recordings, each with its own score
    equations_scenarios     scenarios of noise, process noise, inputs and wrong simulations, each with its own score

Without --cases and --empty a run has its full size, which takes hours.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from examples.blind_proof.diagnose import apply, diagnose
from examples.blind_proof.equations.cases import equations
from examples.blind_proof.equations.scenarios import equations_scenarios
from examples.blind_proof.magnetometer.cases import magnetometer
from examples.blind_proof.magnetometer.motion import DURATION
from examples.blind_proof.magnetometer.scenarios import magnetometer_scenarios
from examples.blind_proof.page import NOT_HELD, TOO_FEW, facts, held, measured_text
from examples.blind_proof.proof import Proof
from examples.blind_proof.run import SEED, run_proof
from examples.blind_proof.score import ProofScore
from mkc_torch._parallel.pool import allow_copies
from mkc_torch._parallel.processes import cores, keep_memory, one_thread
from mkc_torch.cli.console import FAILURES, complain, out, progress


def _mujoco(_: float) -> Proof:
    try:
        from examples.blind_proof.mujoco.cases import mujoco_steps
    except ModuleNotFoundError as error:
        raise ValueError(f"{error}; the proof of robots needs MuJoCo: pip install mujoco") from None
    return mujoco_steps()


KINDS: Mapping[str, Callable[[float], Proof]] = {
    "magnetometer": magnetometer,
    "equations": lambda _: equations(),
    "mujoco": _mujoco,
    "magnetometer_scenarios": magnetometer_scenarios,
    "equations_scenarios": lambda _: equations_scenarios(),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a proof. Returns 0, 1 after a failure, 2 for wrong arguments, 130 if interrupted."""
    known = parser()
    options = known.parse_args(arguments)
    if options.duration is not None and not options.kind.startswith("magnetometer"):
        known.error("--duration applies to a magnetometer; each system has a length of its own")
    try:
        proof = KINDS[options.kind](options.duration or DURATION).only(options.only)
    except ValueError as error:
        known.error(str(error))
    total = len(proof.addresses(options.seed, options.cases, options.empty))
    if total == 0:
        known.error("--cases and --empty are both 0; at least one recording is needed")
    one_thread()
    keep_memory()
    allow_copies(0)  # the number of processes is that of the workers
    try:
        with progress(total, options.output) as step:
            score = run_proof(
                proof, diagnose, apply, cases=options.cases, empty=options.empty, seed=options.seed,
                output=options.output, overwrite=options.force, workers=min(options.workers or cores(), total),
                progress=step.count,
            )  # fmt: skip
    except KeyboardInterrupt:
        print(f"interrupted; the results so far are in {options.output}", file=sys.stderr)
        return 130
    except FAILURES as error:
        complain(options.output, error)
        return 1
    show(score, options.output)
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command's arguments."""
    known = argparse.ArgumentParser(
        "python -m examples.blind_proof", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known.add_argument("kind", nargs="?", choices=KINDS, default="magnetometer", help="default: magnetometer")
    known.add_argument("--output", type=Path, required=True, help="folder for recordings, key, diagnoses and page")
    known.add_argument("--cases", type=_count, help="recordings with hidden physics, in each scenario")
    known.add_argument("--empty", type=_count, help="recordings without hidden physics, in each scenario")
    known.add_argument("--only", action="append", default=[], metavar="NAME", help="only this scenario; repeatable")
    known.add_argument("--seed", type=_count, default=SEED, help="seed of all random draws")
    known.add_argument("--duration", type=_duration, help=f"length of a magnetometer recording in s ({DURATION:g})")
    known.add_argument("--workers", type=_count, help="number of processes; default: the number of cores")
    known.add_argument("--force", action="store_true", help="replace existing results")
    return known


def _count(text: str) -> int:
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return number


def _duration(text: str) -> float:
    seconds = float(text)
    if not 10.0 <= seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a length of at least 10 s")
    return seconds


def show(score: ProofScore, output: Path) -> None:
    """Print the score and the aims of each scenario, and the paths of the files."""
    console = out()
    hidden = sum(scenario.hidden for scenario in score.scenarios)
    console.print()
    console.print(Text(f"Blind proof: {len(score.cases):,} recordings, hidden physics in {hidden:,}", style="bold"))
    for row in score.rows:
        console.print()
        about = row.scenario.sentence if row.scenario else "usable simulations, without scenarios counted apart"
        console.print(Text.assemble((row.name, "bold"), f": {about}"))
        values = Table.grid(padding=(0, 3, 0, 0))
        values.add_column(no_wrap=True)
        values.add_column(overflow="fold")
        for label, value in facts(row):
            values.add_row(f"  {label}", value)
        console.print(values)
        aims = Table.grid(padding=(0, 3, 0, 0))
        aims.add_column(overflow="fold")
        aims.add_column(justify="right", no_wrap=True)
        aims.add_column(no_wrap=True)
        for measured in row.measured:
            word = held(measured)
            style = "bold yellow" if word in (NOT_HELD, TOO_FEW) else ""
            aims.add_row(f"  {measured.threshold.sentence}", measured_text(measured), Text(word, style=style))
        console.print(aims)
    console.print()
    if any(held(measured) == TOO_FEW for row in score.rows for measured in row.measured):
        console.print("Too few recordings: these results may be chance. Leave out --cases and --empty for a full run.")
    console.print(Text(f"{'failed':<15}{', '.join(score.failed) or 'none'}"))
    for name in ("proof.html", "score.json", "summary.md", "key_hash.txt"):
        # outside the table, so that a long path is not broken and can be copied
        console.print(Text.assemble(f"{'written':<15}", (str(output / name), "cyan")), soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
