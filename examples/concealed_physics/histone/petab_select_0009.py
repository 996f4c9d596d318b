"""Model selection with published failures: PEtab Select's test case 0009, which of 32 rates are motif-specific.

Of 2^32 models of histone H4 acetylation the published best has an AICc of -1708.11. Forward selection ends at -1704.70
and backward elimination at -1707.51; of FAMoS's searches from random models less than 5 % end at the best one (its
test case). Here the search continues from every model within 2 of the best so far, with swaps, from ten starts: no own
rate, all 32, and random halves.

It needs the package petab-select (extra `examples`). The data are in this folder, with source and licence.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import yaml
from acetylation import EFFECTS, REACTIONS, HistoneAcetylation, measured, recording
from calibration import Calibration, Fit, Selection
from selection import CLOSE, EFFECT_COUNT, Found, Search
from torch import Tensor

from mkc_torch import diagnose

DATA = Path(__file__).resolve().parent / "data"
STARTS = 10


def published() -> tuple[Selection, float]:
    """The test case's expected model and its AICc."""
    expected = yaml.safe_load((DATA / "expected.yaml").read_text(encoding="utf-8"))
    names = (name for name in expected["estimated_parameters"] if name in REACTIONS)
    return frozenset(map(REACTIONS.index, names)), float(expected["criteria"]["AICc"])


def starts(count: int, seed: int) -> list[Selection]:
    """Return the starts: no rate, all rates, and random halves."""
    generator = torch.Generator().manual_seed(seed)
    halves = [torch.rand(EFFECT_COUNT, generator=generator) < 0.5 for _ in range(max(count - 2, 0))]
    drawn = [frozenset(half.nonzero().flatten().tolist()) for half in halves]
    return [frozenset(), frozenset(range(EFFECT_COUNT)), *drawn][:count]


def pooled(found: Sequence[Found]) -> dict[Selection, Fit]:
    """The models of all searches within 2 of the best of all, best first."""
    every: dict[Selection, Fit] = {}
    for entry in found:
        for selection, fit in entry.good.items():
            every[selection] = min(every.get(selection, fit), fit, key=lambda fit: fit.aicc)
    least = min(fit.aicc for fit in every.values())
    close = {selection: fit for selection, fit in every.items() if fit.aicc < least + CLOSE}
    return dict(sorted(close.items(), key=lambda item: item[1].aicc))


def shares(good: Mapping[Selection, Fit]) -> list[tuple[str, float]]:
    """The reactions by the share of good models in which their rate is their own, largest first."""
    counts = Counter(number for selection in good for number in selection)
    return [(REACTIONS[number], count / len(good)) for number, count in counts.most_common()]


def claimed(logs: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the factors that `diagnose` claims, by reaction; it tests the evidence instead of AICc."""
    diagnosis = diagnose(HistoneAcetylation(), recording(logs), effects=EFFECTS)
    return {finding.effect: float(torch.as_tensor(finding.parameters[0].value).exp()) for finding in diagnosis.findings}


def named(selection: Selection) -> str:
    return ", ".join(REACTIONS[number] for number in sorted(selection))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=STARTS, help="number of searches, each from another start")
    parser.add_argument("--seed", type=int, default=0, help="of the random starts")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    begin = time.process_time()
    logs = measured(DATA / "measurements.tsv")
    calibration = Calibration(logs)
    best, criterion = published()
    direct, effects = calibration.fitted([best])[best].aicc, calibration.by_effects(best).aicc
    print(f"published model: AICc {criterion:.4f}, fitted here {direct:.4f}, with effects {effects:.4f}")
    for words, start, forward in (
        ("forward", frozenset[int](), True),
        ("backward", frozenset(range(EFFECT_COUNT)), False),
    ):
        search = Search(calibration, start)
        end = search.fits[search.step(forward=forward, backward=not forward)]
        print(f"{words} alone: {end.aicc:.2f}")
    factors = ", ".join(f"{reaction}, factor {factor:.1f}" for reaction, factor in claimed(logs).items())
    print(f"claimed by diagnose: {factors or 'nothing'}")
    print("\n| rates at the start | forward and backward | best | above the published | fits | CPU s |")
    print("|---:|---:|---:|---:|---:|---:|")
    found = []
    for start in starts(options.starts, options.seed):
        clock = time.process_time()
        entry = Search(calibration, start).best_first()
        found.append(entry)
        least = entry.good[entry.best].aicc
        seconds = time.process_time() - clock
        above = round(least - criterion, 2) + 0.0  # not -0.00
        print(
            f"| {len(start)} | {entry.stepwise.aicc:.2f} | {least:.2f} | {above:.2f} | {entry.fits} | {seconds:.0f} |"
        )
    good = pooled(found)
    (first, fit), *_ = good.items()
    words = "the published model" if first == best else "not the published model"
    print(f"\nbest of all: {fit.aicc:.4f}, {words}: {named(first)}")
    print(f"{len(good)} models within {CLOSE:g} of it; of these have a rate of its own:")
    print("\n".join(f"  {share:4.0%} {reaction}" for reaction, share in shares(good)))
    print(f"{time.process_time() - begin:.0f} CPU seconds")


if __name__ == "__main__":
    main()
