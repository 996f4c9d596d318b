"""Run all benchmarks in turn: `python -m tests.benchmarks`; a single benchmark: `python -m tests.benchmarks.start`."""

from __future__ import annotations

import subprocess
import sys

NAMES = ("start", "small_fits", "large_fits", "streaming", "diagnosis")


def main() -> None:
    """Run each benchmark in its own process."""
    for name in NAMES:
        print(f"\n{name}\n", flush=True)
        subprocess.run([sys.executable, "-m", f"tests.benchmarks.{name}"], check=True)


if __name__ == "__main__":
    main()
