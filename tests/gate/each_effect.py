"""How often each effect is named where it is the only hidden effect and is clearly detectable.

``python -m tests.gate.each_effect --effects input_lag input_square --per-effect 6 --output DIR`` draws recordings of
the proof of differential equations until ``--per-effect`` recordings of each effect have z and z_sep of at least ten.
Diagnoses them and prints the names found. Recordings that a folder has a diagnosis of are not diagnosed again.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from torch import Generator

from examples.blind_proof import draws
from examples.blind_proof.aims import STRONG_Z
from examples.blind_proof.diagnose import diagnose
from examples.blind_proof.equations.cases import case_of
from examples.blind_proof.equations.hidden import System
from examples.blind_proof.equations.integrate import SystemScene, simulate
from examples.blind_proof.equations.oracle import can_be_named, names
from examples.blind_proof.equations.systems import SYSTEMS
from examples.blind_proof.key import Key
from examples.blind_proof.proof import Case
from examples.blind_proof.run import SIMULATIONS, content_of, write_case
from examples.blind_proof.statements import named_right, stated_diagnosis

SEED = 11


def strong_cases(effect: str, seed: int, most: int) -> Iterator[Case]:
    """Draw recordings in which the effect is hidden, each with z and z_sep of at least ten.

    Args:
        effect: id of the effect.
        seed: seed of all draws.
        most: number of settings to try.
    """
    for index in range(most):

        def stream(what: str, index: int = index) -> Generator:
            return draws.generator(seed, "each effect", effect, index, what)

        name = draws.choose(stream("system"), tuple(SYSTEMS))
        alone = _hiding(effect, SYSTEMS[name], stream)
        if alone is None:
            continue
        case = case_of(stream, f"{name}_{index:05d}", alone, outside_share=0.0)
        (truth,) = case.key.effects
        if min(truth.z, truth.z_sep) >= STRONG_Z:
            yield case


def _hiding(effect: str, system: System, stream: Callable[[str], Generator]) -> System | None:
    """Return the system with ``effect`` alone to hide; None if it cannot have or cannot identify the effect."""
    setting = system.draw(stream("setting"))
    scene = SystemScene(setting.plant, setting.trial, simulate(setting.plant, setting.trial))
    having = [draw for draw in system.inside if draw(stream("effect"), scene).effect == effect]
    if having:
        known = names(scene)
        having = [draw for draw in having if can_be_named(draw(stream("effect"), scene), known)]
    if not having:
        return None
    return replace(system, inside=(draws.choose(stream("which"), having),))


def score_case(key: Key, folder: Path) -> tuple[bool, str]:
    """Return whether the first claim is right, and a text: the verdict, and the claims with alternatives."""
    (truth,) = key.effects
    stated = stated_diagnosis(content_of(folder / key.name / "diagnosis.json"))
    claims = [
        " or ".join([finding.named.effect, *(other.effect for other in finding.others)])
        + f" at {', '.join(finding.named.at)}"
        for finding in stated.claims
    ]
    nearest = [f"nearest {finding.named.effect}" for finding in stated.nearest]
    right = bool(stated.claims) and named_right(stated.claims[0].named, truth)
    return right, f"{stated.verdict}: {'; '.join([*claims, *nearest]) or 'no name'}"


def measure(effects: Sequence[str], per_effect: int, seed: int, output: Path, most: int) -> None:
    """Draw, diagnose, and print a line for each recording and each effect."""
    totals: dict[str, Counter[bool]] = {}
    for effect in effects:
        place = output / effect
        recordings, diagnoses = place / "recordings", place / "diagnoses"
        for folder in (recordings, diagnoses, place / "second", place / SIMULATIONS):
            folder.mkdir(parents=True, exist_ok=True)
        totals[effect] = Counter()
        for _, case in zip(range(per_effect), strong_cases(effect, seed, most), strict=False):
            path = recordings / f"{case.key.name}.csv"
            if not (diagnoses / case.key.name / "diagnosis.json").is_file():
                write_case(place, case)
                (diagnoses / case.key.name).mkdir(exist_ok=True)
                diagnose([path], diagnoses)
            right, text = score_case(case.key, diagnoses)
            totals[effect][right] += 1
            (truth,) = case.key.effects
            strength = f"z {truth.z:.0f}, z_sep {truth.z_sep:.0f}, size {truth.size:.3g}"
            mark = "right" if right else "WRONG"
            print(f"{effect} | {case.key.name} | {truth.form} | {strength} | {mark} | {text}", flush=True)
    print("\n| effect | named right |\n|---|---:|")
    for effect, found in totals.items():
        print(f"| {effect} | {found[True]} of {sum(found.values())} |")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--effects", nargs="+", required=True, metavar="ID", help="ids of the effects")
    parser.add_argument("--per-effect", type=int, default=30, help="recordings of each effect (default: 30)")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--most", type=int, default=2000, help="settings to try for each effect (default: 2000)")
    parser.add_argument("--output", type=Path, required=True, help="folder for recordings and diagnoses")
    options = parser.parse_args(arguments)
    measure(options.effects, options.per_effect, options.seed, options.output, options.most)
    return 0


if __name__ == "__main__":
    sys.exit(main())
