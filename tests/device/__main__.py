"""Device checks in a single command: agreement, time, memory, capture, fits.

python -m tests.device [--device cuda] [--only agreement steps ...]
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections.abc import Callable

import torch

from tests.device.agreement import print_agreement
from tests.device.fits import print_fits
from tests.device.other_fits import print_other_fits
from tests.device.other_losses import print_other_losses
from tests.device.rows import print_rows
from tests.device.small_fits import print_small_fits
from tests.device.speed import print_capture, print_steps, print_training, print_variants

SECTIONS = (
    "agreement",
    "steps",
    "training",
    "capture",
    "compiled",
    "variants",
    "other",
    "fits",
    "small_fits",
    "rows",
    "other_fits",
)


def main() -> None:
    """Run the chosen sections; exit with an error if values differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    chosen = parser.parse_args()
    device = torch.device(chosen.device)
    gpu = device.type == "cuda"
    card = torch.cuda.get_device_name(device) if gpu else "CPU"
    print(f"{card}, torch {torch.__version__}", flush=True)
    sizes = (1024, 1 << 22, 1 << 27) if gpu else (1024, 1 << 20)
    sections: dict[str, Callable[[], bool | None]] = {
        "agreement": lambda: print_agreement(device),
        "steps": lambda: print_steps(device, sizes, compiled=False),
        "training": lambda: print_training(device),
        "capture": lambda: print_capture(device),
        "compiled": lambda: print_steps(device, sizes, compiled=True),
        "variants": lambda: print_variants(device, sizes[-1]),
        "other": lambda: print_other_losses(device),
        "fits": lambda: print_fits(device, large=1_000_000 if gpu else 20_000, many=10_000 if gpu else 50),
        "other_fits": lambda: print_other_fits(device),
        "rows": lambda: print_rows(device, (1_000_000, 10_000_000) if gpu else (20_000,)),
        "small_fits": lambda: print_small_fits(
            device,
            many=100_000 if gpu else 20,
            few=2000 if gpu else 4,
            compared=300,
            ellipsoids=1_000_000 if gpu else 3,
        ),
    }
    right = True
    for name in chosen.only:
        start = time.perf_counter()
        print(f"\n{name}", flush=True)
        try:
            right = sections[name]() is not False and right
        except Exception:  # compilers raise their own exception types; the other sections continue
            traceback.print_exc()
            right = False
        print(f"  ({time.perf_counter() - start:.0f} s)", flush=True)
    if not right:
        raise SystemExit("Values on the device differ from the CPU's; see above.")


if __name__ == "__main__":
    main()
