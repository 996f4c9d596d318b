"""Every table and figure of both papers with one command: tables as text, figures as pictures, and a page of links.

    python examples/paper/all.py --output FOLDER
    python examples/paper/all.py --output FOLDER --small
    python examples/paper/all.py --output FOLDER --disturbed broad_28_stationary_magnet.csv \\
        --undisturbed broad_02_undisturbed.csv

Each script runs on its own and what it prints is kept in FOLDER/NAME.txt. ``--small`` takes few draws: tens of minutes
become a few. The scripts on a magnetometer need the two recordings (BROAD data set, trials 28 and 02, as
tables); without them they are left out, with a line. The exit code is 1 if a script fails.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Script:
    """A script of this folder, its arguments, and those of its small run; OUT and the recordings are filled in."""

    name: str
    shows: str
    full: str = ""
    small: str = ""

    def arguments(self, small: bool, values: dict[str, str]) -> list[str]:
        words = (self.small if small else self.full).split()
        return [word.format_map(values) for word in words]

    @property
    def needs_recordings(self) -> bool:
        return "{disturbed}" in self.full


SCRIPTS = (
    Script("density", "the density against independent values: (17), Theorem 1, Corollary 1"),
    Script(
        "figures_2_3", "the density and its likelihood: Figures 2 and 3", "--output {out}", "--output {out} --draws 5"
    ),
    Script(
        "error_bound",
        "Theorem 3, Propositions 1 and 2, Corollary 2",
        "--output {out}/error_bound.png",
        "--output {out}/error_bound.png --draws 20 --grid 500",
    ),
    Script("figures_4_to_6", "examples 1 and 2: Figures 4 to 6", "--output {out}", "--output {out} --draws 20"),
    Script("table_1", "example 2: Table I", "", "--draws 100 --timed 3"),
    Script("example_2", "example 2 against the oracle", "", "--draws 30 --scipy 1"),
    Script(
        "figure_7",
        "a magnetometer next to a magnet: Figure 7",
        "{disturbed} {undisturbed} --output {out}/figure_7.png",
        "{disturbed} {undisturbed} --output {out}/figure_7.png",
    ),
    Script(
        "table_2",
        "a magnetometer next to a magnet: Table II",
        "{disturbed} {undisturbed}",
        "{disturbed} {undisturbed}",
    ),
    Script(
        "comparison",
        "every linear estimator side by side",
        "--output {out}",
        "--output {out} --draws 8 --curve-draws 2",
    ),
    Script("lel_tables_1_to_4", "least entropy-like: Tables 1 to 4", "", "--draws 5 --samples 2000 --timed 1"),
    Script(
        "lel_table_5",
        "least entropy-like: Table 5, Figure 9",
        "--output {out}/lel_table_5.png",
        "--output {out}/lel_table_5.png --starts 30",
    ),
    Script(
        "lel_figures",
        "least entropy-like: Figures 1 to 8",
        "--output {out}",
        "--output {out} --draws 20 --samples 1000",
    ),
    Script(
        "lel_range_image",
        "least entropy-like: a wall in a range image, Figure 10",
        "--output {out}/lel_range_image.png",
        "--output {out}/lel_range_image.png",
    ),
)


def run(script: Script, small: bool, values: dict[str, str]) -> tuple[int, str]:
    """Exit code of a script, and what it printed."""
    command = [sys.executable, str(FOLDER / f"{script.name}.py"), *script.arguments(small, values)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.returncode, done.stdout


def page(folder: Path, shown: list[tuple[Script, list[Path]]], small: bool) -> str:
    """A Markdown page that links what each script left in ``folder``."""
    lines = ["# Tables and figures of both papers", ""]
    if small:
        lines += ["Small runs, with few draws.", ""]
    for script, pictures in shown:
        lines += [f"## {script.shows}", "", f"[what `{script.name}.py` prints]({script.name}.txt)", ""]
        lines += [f"![{p.stem}]({p.relative_to(folder).as_posix()})\n" for p in pictures]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", metavar="FOLDER", type=Path, required=True)
    parser.add_argument("--small", action="store_true", help="few draws")
    parser.add_argument("--disturbed", metavar="RECORDING.csv", help="for figure_7 and table_2")
    parser.add_argument("--undisturbed", metavar="RECORDING.csv", help="the same sensor, not disturbed")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[s.name for s in SCRIPTS], help="some scripts")
    options = parser.parse_args()
    if (options.disturbed is None) != (options.undisturbed is None):
        parser.error("expected both --disturbed and --undisturbed, or neither")
    console = Console(width=120)
    options.output.mkdir(parents=True, exist_ok=True)
    values = {"out": str(options.output), "disturbed": options.disturbed, "undisturbed": options.undisturbed}
    shown: list[tuple[Script, list[Path]]] = []
    failed = []
    for script in SCRIPTS:
        if options.only and script.name not in options.only:
            continue
        if script.needs_recordings and options.disturbed is None:
            console.print(f"{script.name}: left out, it needs --disturbed and --undisturbed")
            continue
        begun, start = time.time(), time.perf_counter()
        code, printed = run(script, options.small, values)
        (options.output / f"{script.name}.txt").write_text(printed, encoding="utf-8")
        # a second's slack for file systems with coarse times
        pictures = sorted(p for p in options.output.rglob("*.png") if p.stat().st_mtime >= begun - 1)
        known = {p for _, before in shown for p in before}
        shown.append((script, [p for p in pictures if p not in known]))
        console.print(
            f"{script.name}: {'done' if code == 0 else f'FAILED ({code})'}, {time.perf_counter() - start:.0f} s"
        )
        if code:
            failed.append(script.name)
            console.print(printed[-2000:], markup=False)
    (options.output / "index.md").write_text(page(options.output, shown, options.small), encoding="utf-8")
    console.print(f"{options.output / 'index.md'} links {len(shown)} results; {len(failed)} failed.")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
