"""The built package, tested on a version of torch: `python -m tests.wheel --torch 2.6.0 tests/losses tests/linear`.

Builds wheel and sdist, checks their metadata, makes an environment of its own, installs the wheel there, and runs the
sdist's tests against it; without paths all of them, which takes an hour on two cores. With `--bare` the wheel is
installed without extras and used by a short script instead, which takes a minute after the downloads.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

USE = """
import torch, mkc_torch
from mkc_torch import MKCLoss, Recording, diagnose, inlier_weight, linear
from mkc_torch.calibration import calibrate
from mkc_torch.recording import simulated_recording
from mkc_torch.simulation import Static

draw = torch.Generator().manual_seed(0)
x = torch.randn(200, 2, generator=draw)
y = x.sum(-1, keepdim=True) + 0.1 * torch.randn(200, 1, generator=draw)
y[::5] += 30.0
fit = linear.MKCRegression().fit(x, y.squeeze(-1))
assert (fit.coef_.flatten() - 1.0).abs().max() < 0.05, fit.coef_
loss = MKCLoss(1, d=0.1, bound=50.0)
predicted = fit.predict(x).unsqueeze(-1)
loss(predicted, y).backward()
assert (inlier_weight(loss, predicted, y)[::5] < 0.1).all()
offset = torch.tensor(calibrate(simulated_recording()[0]).center)
assert (offset - torch.tensor([12.0, -7.5, 21.0])).abs().max() < 0.1, offset
time = torch.arange(200) / 10.0
line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
columns = {"time": time, "heat": time.sin(), "voltage": 2.0 * time.sin() + 0.01 * torch.randn(200, generator=draw)}
diagnose(line, Recording(columns), effects=(), surrogates=19)
print("used", mkc_torch.__version__, "from", mkc_torch.__file__, "with torch", torch.__version__)
"""
"""A script that needs the wheel and its required packages only."""


def run(*command: object, **options: object) -> int:
    return subprocess.run([str(part) for part in command], check=False, **options).returncode  # type: ignore[call-overload,no-any-return]


def use(place: Path, wheel: Path, wanted: str) -> int:
    """Install the wheel in an empty environment, run the script there, and return its status."""
    venv.create(place, with_pip=True)
    python = place / "bin" / "python"
    installed = run(python, "-m", "pip", "install", "-q", wanted, wheel)
    return installed or run(python, "-W", "error", "-c", USE, cwd=place)


def main() -> None:
    """Exit with the status of the tests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", default="2.6.0", help="version of torch, or newest")
    parser.add_argument("--bare", action="store_true", help="install no extras; run a short script instead of tests")
    parser.add_argument("tests", nargs="*", default=["tests"], help="paths of the sdist")
    options = parser.parse_args()
    wanted = "torch" if options.torch == "newest" else f"torch=={options.torch}"
    tools = ["build", "twine", "hatchling>=1.24", *([] if options.bare else [wanted])]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        venv.create(place / "env", with_pip=True)
        python = place / "env" / "bin" / "python"
        if run(python, "-m", "pip", "install", "-q", *tools):
            sys.exit(1)
        if run(python, "-m", "build", "--no-isolation", "--outdir", place / "dist", ROOT):
            sys.exit(1)
        if run(python, "-m", "twine", "check", "--strict", *(place / "dist").iterdir()):
            sys.exit(1)
        (wheel,), (sdist,) = (list((place / "dist").glob(end)) for end in ("*.whl", "*.tar.gz"))
        if options.bare:
            sys.exit(use(place / "bare", wheel, wanted))
        if run(python, "-m", "pip", "install", "-q", f"{wheel}[test]", "onnx", "onnxscript", "onnxruntime"):
            sys.exit(1)
        with tarfile.open(sdist) as file:
            file.extractall(place, filter="data")
        (tree,) = place.glob("mkc_torch-*")
        shutil.rmtree(tree / "mkc_torch")  # the wheel is what is tested
        pytest = ("-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider")
        sys.exit(run(python, *pytest, *options.tests, cwd=tree))


if __name__ == "__main__":
    main()
