"""The kernels that the interpreter runs also compile for a GPU."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e


def test_kernels_compile_for_a_gpu_with_vector_loads_of_four_numbers():
    triton = pytest.importorskip("triton")
    if not (Path(triton.__file__).parent / "backends/nvidia/bin/ptxas").exists():
        pytest.skip("this Triton has no ptxas")
    # the interpreter is chosen where a kernel is defined
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, "-W", "ignore", "-m", "tests.losses.kernels.compilation"]
    root = Path(__file__).parents[3]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    lines = done.stdout.splitlines()
    assert len(lines) >= 22
    assert sum(line.startswith(("rows, ", "starts, ", "fits, ")) for line in lines) == 8
    for start in ("channels, float32", "samples, float32", "labels, float32"):
        assert any(line.startswith(start) and "ld.global.v4" in line for line in lines)
    loops = [line for line in lines if line.startswith(("starts, ", "alternations, "))]
    assert len(loops) >= 7
    assert all(line.endswith("lanes agree") for line in loops)
