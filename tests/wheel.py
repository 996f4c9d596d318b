"""The built package, tested on a version of torch: `python -m tests.wheel --torch 2.6.0 tests/losses tests/linear`.

Builds wheel and sdist, makes an environment of its own, installs the wheel there, and runs the sdist's tests against
it; without paths all of them, which takes an hour on two cores.
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


def run(*command: object, **options: object) -> int:
    return subprocess.run([str(part) for part in command], check=False, **options).returncode  # type: ignore[call-overload,no-any-return]


def main() -> None:
    """Exit with the status of the tests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", default="2.6.0", help="version of torch")
    parser.add_argument("tests", nargs="*", default=["tests"], help="paths of the sdist")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        venv.create(place / "env", with_pip=True)
        python = place / "env" / "bin" / "python"
        if run(python, "-m", "pip", "install", "-q", "build", "hatchling", f"torch=={options.torch}"):
            sys.exit(1)
        if run(python, "-m", "build", "--no-isolation", "--outdir", place / "dist", ROOT):
            sys.exit(1)
        (wheel,), (sdist,) = (list((place / "dist").glob(end)) for end in ("*.whl", "*.tar.gz"))
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
