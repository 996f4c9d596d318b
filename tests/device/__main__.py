"""One command for whoever has a device: agreement, time, memory, capture.

python -m tests.device [--device cuda] [--only agreement steps ...]
"""

from __future__ import annotations

import argparse
import time

import torch

from tests.device.agreement import print_agreement
from tests.device.speed import print_capture, print_steps, print_training, print_variants

SECTIONS = ("agreement", "steps", "variants", "training", "capture")


def main() -> None:
    """Run the sections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--not-compiled", action="store_true", help="leave torch.compile out, which takes longest")
    chosen = parser.parse_args()
    device = torch.device(chosen.device)
    gpu = device.type == "cuda"
    card = torch.cuda.get_device_name(device) if gpu else "CPU"
    print(f"{card}, torch {torch.__version__}", flush=True)
    sizes = (1024, 1 << 22, 1 << 27) if gpu else (1024, 1 << 20)
    right = True
    for name in chosen.only:
        start = time.perf_counter()
        print(f"\n{name}", flush=True)
        if name == "agreement":
            right = print_agreement(device)
        elif name == "steps":
            print_steps(device, sizes, compiled=not chosen.not_compiled)
        elif name == "variants":
            print_variants(device, sizes[-1])
        elif name == "training":
            print_training(device)
        else:
            print_capture(device)
        print(f"  ({time.perf_counter() - start:.0f} s)", flush=True)
    if not right:
        raise SystemExit("Values on the device differ from the CPU's; see above.")


if __name__ == "__main__":
    main()
