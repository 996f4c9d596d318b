"""Effects of recorded columns, hidden and not: `python -m tests.gate.recorded_causes --output DIR`.

Simulates a heated body in fine steps. In each recording a column acts on the body in a way that its simulation lacks,
or no column acts; other columns are recorded that do nothing. Sensor noise is white or slow, or process noise acts on
the temperature. Writes `rows.json`, and `summary.md` with a row for each effect and for empty recordings. A run into
the same folder continues an interrupted run.

    python -m tests.gate.recorded_causes --per-effect 10 --output recorded_causes
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor

from examples.blind_proof.binomial import share
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP, FINE, SAMPLES = 0.5, 10, 400

EFFECTS = ("driver_force", "driver_exchange", "driver_rate_constant", "driver_input_gain")
"""The effects that are hidden."""

EMPTY = "nothing"
"""The label of recordings in which no column acts."""

COLUMN_OF = {"driver_exchange": "temperature_cellar", "driver_input_gain": "supply"}
"""The column that acts; for the other effects it is the sun or the wind."""

NOISES = ("white", "slow", "disturbed")
"""Kinds of noise, in turn: white sensor noise alone, a slow sensor error, or process noise."""

_UNITS = {"temp": "°C", "ambient": "°C", "temperature_cellar": "°C"}


class Body(Dynamics):
    """A heated body; its simulation uses the heat and the ambient temperature only."""

    states, inputs = ("temp",), ("heat", "ambient")
    parameters = {"gain": Parameter(0.4, lower=0.0), "loss": Parameter(0.05, lower=0.0)}
    units = {"temp": "°C", "ambient": "°C"}

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> dict[str, Tensor]:
        return {"temp": p.gain * u.heat - p.loss * (x.temp - u.ambient)}


@dataclass(frozen=True)
class HiddenCause:
    """A column that acts on the body.

    Attributes:
        effect: the effect's id, or :data:`EMPTY`.
        column: the column.
        size: γ.
    """

    effect: str
    column: str = ""
    size: float = 0.0

    def rate(self, temp: float, now: Mapping[str, float], means: Mapping[str, float]) -> float:
        """The rate of the temperature in °C/s."""
        gain, loss = 0.5, 0.03
        away = temp - now["ambient"]
        plain = gain * now["heat"] - loss * away
        if self.effect == "driver_force":
            return plain + self.size * now[self.column]
        if self.effect == "driver_exchange":
            return plain + self.size * (now[self.column] - temp)
        if self.effect == "driver_rate_constant":
            return plain - self.size * (now[self.column] - means[self.column]) * away
        if self.effect == "driver_input_gain":
            return plain + self.size * (now[self.column] - means[self.column]) * gain * now["heat"]
        return plain


def hidden_cause(effect: str, generator: Generator) -> HiddenCause:
    """Draw a cause of this effect, some ten times larger than the sensor's noise.

    Example:
        >>> hidden_cause("nothing", Generator())
        HiddenCause(effect='nothing', column='', size=0.0)
    """
    if effect == EMPTY:
        return HiddenCause(EMPTY)
    size = {"driver_force": 0.1, "driver_exchange": 0.015, "driver_rate_constant": 0.006, "driver_input_gain": 0.06}
    either = ("sun", "wind")[int(torch.randint(2, (), generator=generator))]
    stretch = 0.7 + 1.3 * float(torch.rand((), generator=generator))
    return HiddenCause(effect, COLUMN_OF.get(effect, either), size[effect] * stretch)


def smooth(generator: Generator, correlation: float) -> Tensor:
    """Samples of a stationary random course with standard deviation 1; its correlation time is in samples."""
    keep = math.exp(-1.0 / correlation)
    course = torch.randn(SAMPLES, generator=generator, dtype=torch.float64)
    for k in range(1, SAMPLES):
        course[k] = keep * course[k - 1] + math.sqrt(1.0 - keep * keep) * course[k]
    return course


def recording(cause: HiddenCause, noise: str, seed: int) -> Recording:
    """Simulate a recording of 400 samples.

    Args:
        cause: the column that acts.
        noise: one of :data:`NOISES`.
        seed: of inputs, columns and noise.
    """
    g = torch.Generator().manual_seed(seed)
    levels = 2.0 * torch.rand(SAMPLES // 20, generator=g, dtype=torch.float64)
    columns = {
        "time": STEP * torch.arange(SAMPLES, dtype=torch.float64),
        "heat": levels.repeat_interleave(20),
        "ambient": 8.0 + 3.0 * smooth(g, 200.0),
        "temperature_cellar": 15.0 + 2.0 * smooth(g, 100.0),
        "sun": (1.0 + smooth(g, 60.0)).clamp(min=0.0),
        "wind": (3.0 + 2.0 * smooth(g, 40.0)).abs(),
        "supply": 24.0 + smooth(g, 80.0),
    }
    means = {name: float(values.mean()) for name, values in columns.items()}
    disturbance = 0.04 * smooth(g, 15.0) if noise == "disturbed" else torch.zeros(SAMPLES, dtype=torch.float64)
    table = {name: values.tolist() for name, values in (columns | {"disturbance": disturbance}).items()}
    temp = [14.0]
    for k in range(SAMPLES - 1):
        value = temp[-1]
        for part in range(FINE):
            at = (part + 0.5) / FINE
            now = {name: values[k] + at * (values[k + 1] - values[k]) for name, values in table.items()}
            now["heat"] = table["heat"][k]
            value += STEP / FINE * (cause.rate(value, now, means) + now["disturbance"])
        temp.append(value)
    error = 0.05 * torch.randn(SAMPLES, generator=g, dtype=torch.float64)
    if noise == "slow":
        error = error + 0.1 * smooth(g, 10.0)
    return Recording({**columns, "temp": torch.tensor(temp, dtype=torch.float64) + error}, units=_UNITS)


def diagnosed(effect: str, index: int, seed: int) -> dict[str, Any]:
    """Draw, diagnose and judge a recording: what was hidden, what was claimed, and how far the size is off."""
    from mkc_torch import diagnose

    generator = torch.Generator().manual_seed(1000 * seed + index)
    cause, noise = hidden_cause(effect, generator), NOISES[index % len(NOISES)]
    found = diagnose(Body(), recording(cause, noise, 1000 * seed + index))
    claimed = [f for f in found.findings if f.grade in ("left_out", "small")]
    right = [f for f in claimed if (f.effect, f.drivers) == (effect, (cause.column,))]
    of_columns = [f for f in claimed if f.effect in EFFECTS]
    row: dict[str, Any] = {"effect": effect, "noise": noise, "named": bool(right), "verdict": found.verdict}
    row |= {"wrong": bool(of_columns) and not right, "claimed": [[f.effect, *f.drivers] for f in claimed]}
    if right:
        size = right[0].parameters[0]
        row |= {"true": cause.size, "size": size.value, "standard_error": size.standard_error}
    return row


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The table in Markdown: for each effect how often it is named, and how often another column's effect is."""
    lines = [
        "| hidden | recordings | named | 95 % interval | another effect of a column claimed |",
        "|---|---:|---:|---|---:|",
    ]
    for effect in dict.fromkeys(row["effect"] for row in rows):
        own = [row for row in rows if row["effect"] == effect]
        named, wrong = sum(row["named"] for row in own), sum(row["wrong"] for row in own)
        rate = share(named, len(own))
        text = "" if effect == EMPTY else f"{100.0 * rate.low:.0f} to {100.0 * rate.high:.0f} %"
        lines.append(f"| `{effect}` | {len(own)} | {'' if effect == EMPTY else named} | {text} | {wrong} |")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute and print the table. Always returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for rows and summary")
    parser.add_argument("--per-effect", type=int, default=30, help="recordings with each effect, and empty ones")
    parser.add_argument("--effects", nargs="+", choices=[*EFFECTS, EMPTY], default=[*EFFECTS, EMPTY])
    parser.add_argument("--seed", type=int, default=1, help="seed of all recordings")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / "rows.json"
    stored = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    known: dict[str, Any] = stored.get("rows", {}) if stored.get("seed") == options.seed else {}
    for index in range(options.per_effect):
        for number, effect in enumerate(options.effects):
            name = f"{effect} {index}"
            if name in known:
                continue
            known[name] = diagnosed(effect, index + 100 * number, options.seed)
            file.write_text(json.dumps({"seed": options.seed, "rows": known}, indent=1), encoding="utf-8")
            print(f"{name}: {known[name]['claimed']}", file=sys.stderr)
    lines = table(list(known.values()))
    (options.output / "summary.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
