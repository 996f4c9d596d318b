"""The p-values of empty recordings, for each kind of noise: `python -m tests.gate.null_p_values --output DIR`.

Draws empty recordings of a mass on a spring under six kinds of noise, searches each as `mkc diagnose` does, and takes
the p-value of that search, which is `p_value` of `diagnosis.json`. Writes `p_values.json`, `null_p_values.svg` with a
histogram for each kind, and `summary.md`: the counts of a coarser histogram, Kolmogorov's distance from the uniform
distribution, and the share below the level with the interval of Clopper and Pearson. A run into the same folder
continues an interrupted run.

    python -m tests.gate.null_p_values --per-kind 40 --output null
    python -m tests.gate.null_p_values --per-kind 5 --kinds white "held inputs" --output quick

Above the level a p-value is coarse: the search stops drawing once six draws gain as much as the recording, and tries no
further kind of noise once the recording is likely under the present kind.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from examples.blind_proof.binomial import share, uniformity
from mkc_torch.recording.recording import Recording
from tests.gate.null_recordings import KINDS, Spring, recording

LEVEL = 0.05
BINS = 20

EDGES = (LEVEL, 0.25, 0.5, 0.75, 1.0)
"""Upper ends, included, of the bins whose counts are in the table."""

PValue = Callable[[Recording, int], float]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute and print the table. Always returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for the p-values, picture and summary")
    parser.add_argument("--per-kind", type=int, default=40, help="recordings of each kind of noise")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="kinds of noise")
    parser.add_argument("--surrogates", type=int, default=199, help="draws of noise in each search")
    parser.add_argument("--seed", type=int, default=1, help="seed of all recordings")
    options = parser.parse_args(arguments)
    settings = {"seed": options.seed, "surrogates": options.surrogates}
    found = run(options.output, options.kinds, options.per_kind, settings)
    rows = {kind: {**summary_row(values), "counts": counts(values)} for kind, values in found.items()}
    (options.output / "summary.md").write_text("\n".join(table(rows)) + "\n", encoding="utf-8")
    (options.output / "null_p_values.svg").write_text(picture(found), encoding="utf-8")
    print("\n".join(table(rows)))
    return 0


def run(
    output: Path, kinds: Sequence[str], per_kind: int, settings: Mapping[str, Any], p_value: PValue | None = None
) -> dict[str, list[float]]:
    """Compute the p-values of each kind, and write each to ``p_values.json``. Stored p-values of other kinds are kept.

    Args:
        output: folder; its p-values of the same settings are not computed again.
        kinds: names in :data:`KINDS`.
        per_kind: recordings of each kind.
        settings: ``seed`` and ``surrogates``.
        p_value: returns the p-value of a recording with a number of surrogates; default :func:`searched`.
    """
    output.mkdir(parents=True, exist_ok=True)
    file = output / "p_values.json"
    stored = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    found: dict[str, list[float]] = stored["p_values"] if stored.get("settings") == dict(settings) else {}
    started, search = time.process_time(), p_value or searched
    for index in range(per_kind):
        for kind in kinds:  # kinds in turn: an interrupted run has as many of each
            values = found.setdefault(kind, [])
            if len(values) > index:
                continue
            values.append(search(recording(kind, 1000 * settings["seed"] + index), settings["surrogates"]))
            file.write_text(json.dumps({"settings": dict(settings), "p_values": found}, indent=1), encoding="utf-8")
            print(f"{index + 1}/{per_kind} {kind}: {values[-1]:.3g}", file=sys.stderr)
    print(f"{time.process_time() - started:.0f} CPU seconds", file=sys.stderr)
    return {kind: found[kind] for kind in KINDS if kind in found}


def searched(empty: Recording, surrogates: int) -> float:
    """The p-value of the first search. No finding is kept; the p-value does not depend on it."""
    from mkc_torch import diagnose

    return diagnose(Spring(), empty, surrogates=surrogates, level=LEVEL, max_findings=0).p_value


def summary_row(p_values: Sequence[float]) -> dict[str, float]:
    """The numbers of a row of the table.

    Example:
        >>> summary_row([0.01, 0.2, 0.5, 0.9])["below"]
        0.25
    """
    distance, p = uniformity(p_values)
    below = share(sum(value <= LEVEL for value in p_values), len(p_values))
    return {
        "recordings": len(p_values),
        "distance": distance,
        "uniform_p": p,
        "below": below.value,
        "low": below.low,
        "high": below.high,
    }


def counts(p_values: Sequence[float]) -> list[int]:
    """The number of p-values in each bin of the table.

    Example:
        >>> counts([0.01, 0.05, 0.2, 1.0])
        [2, 1, 0, 0, 1]
    """
    return [sum(low < p <= high for p in p_values) for low, high in zip((-math.inf, *EDGES), EDGES, strict=False)]


def table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The table in Markdown."""
    lines = [
        f"| kind of noise | recordings | p ≤ {LEVEL:g} | 95 % interval | Kolmogorov's distance | p if uniform "
        f"| {' | '.join(f'to {edge:g}' for edge in EDGES)} |",
        f"|---|---:|---:|---|---:|---:|{'---:|' * len(EDGES)}",
    ]
    return lines + [
        f"| {kind} | {row['recordings']:.0f} | {100.0 * row['below']:.1f} % "
        f"| {100.0 * row['low']:.1f} to {100.0 * row['high']:.1f} % "
        f"| {row['distance']:.2f} | {row['uniform_p']:.2g} | {' | '.join(map(str, row['counts']))} |"
        for kind, row in rows.items()
    ]


def picture(found: Mapping[str, Sequence[float]]) -> str:
    """A histogram for each kind, with the height of a uniform distribution, as SVG."""
    import matplotlib
    from matplotlib.figure import Figure

    from mkc_torch.report.drawing import svg

    across = min(3, len(found))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "mkc", "font.size": 9.0}):
        figure = Figure(figsize=(3.2 * across, 2.2 * math.ceil(len(found) / across)), layout="constrained")
        axes = np.atleast_1d(
            figure.subplots(math.ceil(len(found) / across), across, sharex=True, squeeze=False)
        ).ravel()
        for ax, (kind, values) in zip(axes, found.items(), strict=False):
            counts, edges = np.histogram(values, np.linspace(0.0, 1.0, BINS + 1))
            ax.stairs(counts, edges, fill=True, color="#7fb8da")
            ax.axhline(len(values) / BINS, color="#D55E00", lw=1.2)
            ax.set_title(f"{kind} ({len(values)})", fontsize=9, loc="left")
            ax.spines[["top", "right"]].set_visible(False)
            ax.margins(x=0)
        for ax in axes[len(found) :]:
            ax.set_visible(False)
        figure.supxlabel("p-value of an empty recording", fontsize=9)
        return svg(figure, "null", "Histograms of the p-values of empty recordings, one for each kind of noise")


if __name__ == "__main__":
    sys.exit(main())
