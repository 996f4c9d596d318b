"""All benchmarks, one after the other: `python -m tests.benchmarks`; one alone: `python -m tests.benchmarks.start`."""

from __future__ import annotations

import subprocess
import sys

NAMES = ("start", "small_fits", "large_fits", "streaming", "diagnosis")


def main() -> None:
    """Run them in processes of their own."""
    for name in NAMES:
        print(f"\n{name}\n", flush=True)
        subprocess.run([sys.executable, "-m", f"tests.benchmarks.{name}"], check=True)


if __name__ == "__main__":
    main()
