"""CPU seconds of starting and of a calibration, and those of Python and torch: `python -m tests.benchmarks.start`.

User and system time of a whole process in one thread, the least of several runs after one that fills the caches.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest.mock import patch

from mkc_torch.recording import demonstration
from mkc_torch.recording.recording import write_table

RUNS = 5
ROWS = 20_000
MKC = ("-m", "mkc_torch.cli")


def seconds(*arguments: str, runs: int = RUNS, code: int = 0) -> float:
    """The least CPU seconds of a Python process with these arguments, which ends with this exit code."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    taken = []
    for _ in range(runs + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [sys.executable, *arguments], capture_output=True, text=True, check=False, env=environment
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == code, done.stderr
        taken.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(taken[1:])


def show(name: str, value: float) -> None:
    print(f"{name:<44}{value:6.2f} s", flush=True)


def main() -> None:
    """Print the table."""
    show("python -c pass", seconds("-c", "pass"))
    torch_alone = seconds("-c", "import torch")
    show("import torch", torch_alone)
    with_losses = seconds("-c", "import torch, mkc_torch; mkc_torch.MKCLoss")
    show("import torch, mkc_torch; mkc_torch.MKCLoss", with_losses)
    show("  more than torch", with_losses - torch_alone)
    for arguments, code in (
        (("--help",), 0),
        (("--version",), 0),
        (("calibrate", "--help"), 0),
        (("nonsense",), 2),
        (("calibrate", "--nonsense"), 2),
    ):
        show(f"mkc {' '.join(arguments)}", seconds(*MKC, *arguments, code=code))
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "recording.csv"
        with patch.object(demonstration, "SECONDS", ROWS / demonstration.RATE):
            recording, _ = demonstration.simulated_recording()
        write_table(table, recording.columns)
        rest = ("--output", folder, "--force")
        start = seconds(*MKC, "calibrate", str(table.with_name("absent.csv")), *rest, runs=3, code=1)
        whole = seconds(*MKC, "calibrate", str(table), *rest, runs=3)
    show("mkc calibrate, a file that is absent", start)
    show(f"mkc calibrate, {ROWS:,} rows", whole)
    show("  after the start", whole - start)


if __name__ == "__main__":
    main()
