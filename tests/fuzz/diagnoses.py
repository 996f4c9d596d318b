"""Fuzz the diagnosis of long recordings: `python -m tests.fuzz.diagnoses --minutes N`.

Each recording has 4,000 samples, one input and one output, missing values and outliers. Its system has physics that
the simulation lacks. A crash is any exception, or a step that ended in an internal error. The seeds of crashes are
printed; `--seed` starts from one of them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import traceback
from collections.abc import Callable

import torch
from torch import Tensor

from mkc_torch import Recording, diagnose
from mkc_torch._parallel.pool import allow_copies
from mkc_torch._parallel.processes import one_thread
from mkc_torch.simulation import Dynamics, Parameter

SAMPLES = 4000
STEP = 0.5
"""Sampling interval in s."""

FINE = 4
"""Steps of integration between two samples."""

LIMIT_S = 300.0
"""Time limit of a diagnosis in seconds; a diagnosis that ends before its first fit is no crash."""


class HeatExchanger(Dynamics):
    """The outlet of a heat exchanger, heated by a flow of water."""

    states, inputs = ("temperature",), ("flow",)
    units = {"temperature": "°C", "flow": "l/min"}
    parameters = {
        "loss": Parameter(0.05, lower=0.0, unit="1/s"),
        "gain": Parameter(0.3, lower=0.0),
        "room": Parameter(20.0, unit="°C"),
    }

    def derivative(self, time, x, u, p):  # type: ignore[no-untyped-def]
        return {"temperature": -p.loss * (x.temperature - p.room) + p.gain * u.flow}


Rates = Callable[[float, float, float], tuple[float, float]]
"""From temperature, hidden state and flow to the rates of temperature and hidden state."""

HIDDEN: dict[str, Rates] = {
    "nothing": lambda x, z, u: (-0.05 * (x - 20.0) + 0.3 * u, 0.0),
    "lag of the valve": lambda x, z, u: (-0.05 * (x - 20.0) + 0.3 * z, (u - z) / 3.0),
    "square of the flow": lambda x, z, u: (-0.05 * (x - 20.0) + 0.3 * u + 0.02 * u * u, 0.0),
    "saturated valve": lambda x, z, u: (-0.05 * (x - 20.0) + 0.3 * min(u, 6.0), 0.0),
    "second store": lambda x, z, u: (-0.05 * (x - 20.0) + 0.3 * u + 0.1 * (z - x + 20.0), (x - 20.0 - z) / 20.0),
}
"""The systems, by the physics that the simulation lacks."""


def recording_of(seed: int, samples: int = SAMPLES) -> tuple[str, Recording]:
    """Draw a recording; returns the name of the hidden physics too."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=g))

    def normal(size: float = 1.0) -> Tensor:
        return size * torch.randn(samples, generator=g, dtype=torch.float64)

    hidden = list(HIDDEN)[seed % len(HIDDEN)]
    hold = math.ceil(10.0 ** uniform(0.0, 2.0))
    levels = 10.0 * torch.rand(samples // hold + 1, generator=g, dtype=torch.float64)
    flow = levels.repeat_interleave(hold)[:samples]
    disturbances = normal(10.0 ** uniform(-3.0, -0.5)).tolist()
    x, z, course = 20.0, 0.0, []
    for disturbance, u in zip(disturbances, flow.tolist(), strict=True):
        course.append(x)
        for _ in range(FINE):
            rate, hidden_rate = HIDDEN[hidden](x, z, u)
            x, z = x + STEP / FINE * (rate + disturbance), z + STEP / FINE * hidden_rate
    noise = normal(10.0 ** uniform(-2.0, 0.0))
    outliers = torch.rand(samples, generator=g) < uniform(0.0, 0.1)
    measured = torch.tensor(course, dtype=torch.float64) + noise * torch.where(outliers, 30.0, 1.0)
    measured[torch.rand(samples, generator=g) < uniform(0.0, 0.1)] = torch.nan
    gap = int(uniform(0.0, 0.9) * samples)
    measured[gap : gap + int(uniform(0.0, 0.05) * samples)] = torch.nan
    columns = {"time": STEP * torch.arange(samples, dtype=torch.float64), "flow": flow, "temperature": measured}
    return hidden, Recording(columns, name=f"seed {seed}")


def crash_of(seed: int, samples: int = SAMPLES, limit: float = LIMIT_S) -> tuple[str, str]:
    """Diagnose a recording; returns the hidden physics, and the error of a crash, empty for none."""
    hidden, recording = recording_of(seed, samples)
    try:
        result = diagnose(HeatExchanger(), recording, surrogates=19, time_limit=limit)
    except TimeoutError:
        return hidden, ""
    except Exception:  # a crash: reported, and the search goes on
        return hidden, traceback.format_exc()
    return hidden, "\n".join(sentence for sentence in result.warnings if "internal error" in sentence)


def main() -> None:
    """Diagnose recordings until the time is over, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    options = parser.parse_args()
    one_thread()
    allow_copies()
    end, seed, crashes = time.monotonic() + 60.0 * options.minutes, options.seed, 0
    while (left := end - time.monotonic()) > 0.0:
        begin = time.monotonic()
        hidden, error = crash_of(seed, options.samples, min(LIMIT_S, left))
        crashes += bool(error)
        print(f"{seed:>6}  {hidden:<20}{time.monotonic() - begin:>6.0f} s  {'CRASH' if error else ''}", flush=True)
        print(error, end="\n" if error else "", flush=True)
        seed += 1
    print(f"{seed - options.seed} recordings, {crashes} crashes")
    sys.exit(1 if crashes else 0)


if __name__ == "__main__":
    main()
