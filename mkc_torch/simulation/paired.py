"""A simulator as a black box: its output columns compared with recorded columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, refuse_text
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.join_recordings import Clock, refuse_no_recording
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.outputs import changed_outputs, output_ports, output_signals
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.ports import Changes, Nearby
from mkc_torch.simulation.protocol import ClosedForm, Jacobian
from mkc_torch.simulation.runs import successive_runs

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

RATE = 5e-5
"""Prior standard deviation of the relative rate of two clocks: 50 ppm, of free-running quartz oscillators."""

_NOT_KEYS = frozenset({"time", "experiment"})
_FREE = 2.0
"""Largest clock offset and rate, in prior standard deviations."""

_SAME = 1e-9
"""Largest difference of two equal columns, over the range of the recorded column."""

_FEWEST = 2
"""Fewest simulated moments in a run."""

_HELD = 1e8
"""Prior precision of a clock parameter that is held at 0, over its usual precision."""


class Paired:
    """The output of a simulator, compared with a recording in all common columns, at the recording's times.

    Between the simulator's moments its columns are interpolated by cubic polynomials. The two clocks may differ by an
    offset in each run, with a standard deviation of half a sampling interval, and by a rate, of 50 ppm. Both are fitted
    up to twice that; larger differences are not errors of clocks and are found as ``delay`` or ``clock_drift``. With a
    delay of all outputs the mean clock offset of the runs is held at 0, with a drift the clock rate, so that the effect
    is complete and valid in another recording. A column that is the same in both tables is an input of the simulator:
    it is not compared, but can drive effects.

    Args:
        simulated: the simulator's output with ``time``; a column ``experiment`` separates runs by the same labels as
            the recording's.
        outputs: columns to compare; None for all common columns.
        offset: standard deviation of the clock offset in s; None for half a sampling interval of the recording.
        rate: standard deviation of the clock rate, as a share.

    Attributes:
        joins_experiments: True: all runs are fitted jointly.

    Raises:
        TypeError: ``simulated`` is not a recording, or ``outputs`` is a string.
        MissingColumnError: there is no ``time``.
        ValueError: a standard deviation that is not positive, or outputs without a column.

    Example:
        >>> time = torch.arange(0.0, 10.0, 0.1, dtype=torch.float64)
        >>> simulator = Recording({"time": time, "angle": torch.sin(time)})
        >>> recording = Recording({"time": time[5:-5] + 0.02, "angle": 1.1 * torch.sin(time[5:-5])})
        >>> prepared = Paired(simulator).prepare(recording)
        >>> prepared.channels, prepared.parameter_names
        (('angle',), ('clock offset', 'clock rate'))
    """

    name = "simulated"
    joins_experiments = True
    measured: frozenset[str] = frozenset()
    joint_clock: Clock = "own"

    def __init__(
        self,
        simulated: Recording,
        *,
        outputs: Sequence[str] | None = None,
        offset: float | None = None,
        rate: float = RATE,
    ) -> None:
        refuse_no_recording("simulated", simulated)
        if outputs is not None:
            refuse_text("outputs", outputs, "a tuple of names of columns")
            if not outputs:
                raise ValueError(
                    "Expected argument `outputs` to name a column but got none; None compares all common columns."
                )
        if offset is not None:
            checked_number("offset", offset, advice="it is in s, and None takes half an interval of the recording")
        checked_number("rate", rate, advice=f"{RATE:g} is that of quartz")
        self.simulated = simulated.finite("time").sorted_by_time()
        self.outputs = None if outputs is None else tuple(outputs)
        self.offset, self.rate = offset, rate

    @property
    def columns(self) -> frozenset[str]:
        # inputs of the simulator may drive effects; they are only known in `prepare`
        return _NOT_KEYS

    def prepare(self, recording: Recording) -> PreparedPaired:
        """The simulator's output together with a recording.

        Raises:
            TypeError: ``recording`` is not a recording.
            MissingColumnError: the recording has no ``time``, or lacks a column of ``outputs``.
            SimulationError: no column, no run or no time in common.
        """
        refuse_no_recording("recording", recording)
        shared = self._shared(recording)
        table = recording.finite("time", *shared).sorted_by_time()
        table, curve = _common_samples(self.simulated.finite(*shared), table, shared)
        return PreparedPaired(self, table, shared, curve)

    def correction(self, state: Mapping[str, Any], recording: Recording) -> PairedCorrection:
        """The simulator's output with corrections for a new recording; see :class:`mkc_torch.simulation.Correction`."""
        return PairedCorrection(self, state, recording)

    def _shared(self, recording: Recording) -> tuple[str, ...]:
        recording["time"]
        if self.outputs is not None:
            for name in self.outputs:
                recording[name], self.simulated[name]
            return self.outputs
        shared = tuple(name for name in recording.names if name in self.simulated and name not in _NOT_KEYS)
        if not shared:
            raise SimulationError(
                f"{_name_of(recording, 'the recording')} and {_name_of(self.simulated, 'the simulated table')} have no "
                f"column in common to compare: {_listed(recording)} there, {_listed(self.simulated)} here. Rename with "
                "`--columns`."
            )
        return shared


class PreparedPaired(ClosedForm):
    """The output of a simulator together with a recording."""

    jacobian: Jacobian = "reverse twice"
    """Effects of outputs across samples are many small operations."""

    def __init__(self, system: Paired, recording: Recording, shared: tuple[str, ...], curve: _Curve) -> None:
        self.system, self.name = system, system.name
        self.time = recording["time"]
        self.curve = curve
        measured, same = recording.stack(*shared), []
        simulated = curve.at(self.time)
        for k, name in enumerate(shared):
            reach = float(measured[:, k].amax() - measured[:, k].amin())
            if float((measured[:, k] - simulated[:, k]).abs().max()) <= _SAME * reach:
                same.append(name)
        if len(same) == len(shared):
            raise SimulationError(
                f"All columns in common ({', '.join(shared)}) are the same in the recording and the simulated table; "
                "there is nothing to diagnose. Give the simulator's own output."
            )
        kept = [k for k, name in enumerate(shared) if name not in same]
        self.channels = tuple(shared[k] for k in kept)
        self.measured, self.curve = measured[:, kept], curve.columns(kept)
        # without the compared columns, so that they do not drive effects on themselves
        others = {name: values for name, values in recording.columns.items() if name not in self.channels}
        self.recording = _with_columns(recording, others)
        self._units = {name: recording.units[name] for name in self.channels}
        units = set(self._units.values())
        self.unit = units.pop() if len(units) == 1 else ""
        self.independent = (True,) * len(self.channels)
        interval = _interval(self.time, curve.run)
        width = interval / 2.0 if system.offset is None else system.offset
        spread = [width] * len(curve.runs) + [system.rate]
        self._since = _since_begin(self.time, curve)
        offsets = [f"clock offset of {label}" if label else "clock offset" for label in curve.runs]
        self.parameter_names = (*offsets, "clock rate")
        self._spread = sizes = self.time.new_tensor(spread)
        self.prior: GaussianPrior | None = GaussianPrior(torch.zeros_like(sizes), sizes.square().reciprocal())
        self._clock_limits = _FREE * sizes
        self.state: Mapping[str, object] = {"channels": list(self.channels), "clocks": self._clock_limits.tolist()}
        self.bounds = torch.full_like(sizes, -torch.inf), torch.full_like(sizes, torch.inf)
        run = successive_runs(curve.run, self.time)
        self.ports = output_ports(
            self.channels, self._units, self.unit, self.measured, self.channels, self.channels, run
        )
        self.warnings: tuple[str, ...] = tuple(
            f"Column `{name}` is the same in both tables: it counts as an input of the simulator and is not compared."
            for name in same
        )

    def prior_given(self, settled: Collection[str]) -> GaussianPrior:
        """The prior of the clocks, given effects that replace their mean ``"offset"`` or their ``"rate"``."""
        runs = len(self.curve.runs)
        known = self._spread.square().reciprocal()
        precision = torch.diag(known)
        if "offset" in settled:
            precision[:runs, :runs] += _HELD * known[0] / runs
        if "rate" in settled:
            precision[runs, runs] *= _HELD
        return GaussianPrior(torch.zeros_like(known), precision)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        return self.time.new_zeros(len(self.parameter_names))

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        return self.measured - changed_outputs(self._outputs(theta), self.channels, changes)

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "N k"]]:
        return output_signals(self._outputs(theta), self.channels, changes)

    def _outputs(self, theta: Tensor) -> Float[Tensor, "N m"]:
        clock = _clocks(theta, self._clock_limits)
        return self.curve.at(self.time + clock[:-1][self.curve.run] + clock[-1] * self._since)


class PairedCorrection:
    """A simulator's output for a new recording, with effects and with the fitted clocks.

    Args:
        system: the simulator's output for the new recording.
        state: state of the fitted simulation: ``channels``, the compared columns, and ``clocks``, the largest error of
            each clock parameter; without it, as in older files, the clocks have no error.
        recording: the times and drivers; the compared columns are not required.

    Raises:
        MissingColumnError: no ``time``, or a column that was not simulated.
        SimulationError: no run in common, or times that were not simulated.
    """

    def __init__(self, system: Paired, state: Mapping[str, Any], recording: Recording) -> None:
        self.channels, self.recording = tuple(state["channels"]), recording
        self._clock_limits = torch.tensor(state.get("clocks", ()), dtype=torch.float64)
        self.time = recording["time"]
        inside, self._curve = _match_runs(system.simulated.finite(*self.channels), recording, self.channels)
        if not bool(inside.all()):
            raise SimulationError(
                f"{int((~inside).sum())} of {len(inside)} samples lie outside the times that were simulated; simulate "
                "all of the recording, or cut it."
            )
        units = {name: system.simulated.units[name] for name in self.channels}
        run = successive_runs(self._curve.run, self.time)
        self.ports = output_ports(
            self.channels, units, "", self._curve.at(self.time), self.channels, self.channels, run
        )

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The simulated columns with the effects; the clock offset is the mean over the fitted runs."""
        at = self.time
        if len(self._clock_limits):
            clock = _clocks(theta, self._clock_limits)
            at = at + clock[:-1].mean() + clock[-1] * _since_begin(self.time, self._curve)
        outputs = changed_outputs(self._curve.at(at), self.channels, changes)
        return {"time": self.time} | dict(zip(self.channels, outputs.unbind(-1), strict=True))


@dataclass(frozen=True)
class _Curve:
    """The simulator's output as piecewise cubic polynomials, for the samples of a recording.

    Attributes:
        time, values, slopes: (S,), (S, m), (S, m), at the S simulated moments, run after run.
        number: (S,), number of each moment's run.
        run: (N,), number of each sample's run.
        low, high: (N,), first and last moment of that run.
        runs: labels of the runs.
    """

    time: Float[Tensor, " S"]
    values: Float[Tensor, "S m"]
    slopes: Float[Tensor, "S m"]
    number: Int[Tensor, " S"]
    run: Int[Tensor, " N"]
    low: Int[Tensor, " N"]
    high: Int[Tensor, " N"]
    runs: tuple[str, ...]

    def at(self, time: Float[Tensor, " N"]) -> Float[Tensor, "N m"]:
        """Values at one moment for each sample."""
        # on a common axis where runs follow one another
        origin = self.time.min()
        span = self.time.max() - origin + 1.0
        within = (time.detach() - origin).clamp(0.0, float(span) - 0.5)
        after = torch.searchsorted(self.number * span + self.time - origin, self.run * span + within, right=True)
        left = torch.minimum(torch.maximum(after - 1, self.low), self.high - 1)
        step = (self.time[left + 1] - self.time[left]).unsqueeze(-1)
        x = (time - self.time[left]).unsqueeze(-1) / step
        # Hermite's cubic: https://en.wikipedia.org/wiki/Cubic_Hermite_spline
        rise = self.values[left + 1] - self.values[left]
        begin, end = step * self.slopes[left], step * self.slopes[left + 1]
        return self.values[left] + x * (begin + x * (3.0 * rise - 2.0 * begin - end + x * (begin + end - 2.0 * rise)))

    def kept(self, rows: Bool[Tensor, " N"]) -> _Curve:
        """The curve for some of the samples."""
        return replace(self, run=self.run[rows], low=self.low[rows], high=self.high[rows])

    def columns(self, kept: Sequence[int]) -> _Curve:
        """The curve of some of the columns."""
        return replace(self, values=self.values[:, kept], slopes=self.slopes[:, kept])


def _clocks(theta: Float[Tensor, " p"], most: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
    """Clock offsets and rate, limited smoothly: at a hard bound a fit of an equivalent effect would get stuck."""
    return most * torch.tanh(theta / most)


def _since_begin(time: Float[Tensor, " N"], curve: _Curve) -> Float[Tensor, " N"]:
    """Time since the first sample of each sample's run."""
    first = time.new_full((len(curve.runs),), torch.inf).scatter_reduce(0, curve.run, time, "amin")
    return time - first[curve.run]


def _common_samples(simulated: Recording, recording: Recording, names: tuple[str, ...]) -> tuple[Recording, _Curve]:
    """The samples at simulated times, and the curve."""
    inside, curve = _match_runs(simulated, recording, names)
    if bool(inside.all()):
        return recording, curve
    warning = (
        f"{int((~inside).sum())} of {len(recording)} samples lie outside the times that were simulated, "
        f"{_range(simulated)}, and are left out."
    )
    columns = {name: values[inside] for name, values in recording.columns.items()}
    return _with_columns(recording, columns, warning), curve.kept(inside)


def _match_runs(
    simulated: Recording, recording: Recording, names: tuple[str, ...]
) -> tuple[Bool[Tensor, " N"], _Curve]:
    """The mask of the samples within the simulated times of their run, and the curve.

    Raises:
        SimulationError: a run was not simulated, or no sample of a run is within the simulated times.
    """
    time = recording["time"]
    number, labels = _runs(simulated)
    own, own_labels = _runs(recording)
    missing = [label for label in own_labels if label not in labels]
    if missing and (labels != [""] or own_labels != [""]):
        raise SimulationError(
            f"{_name_of(simulated, 'The simulated table')} has no run {_experiments(missing)}; its column `experiment` "
            f"has {_experiments(labels)}. Runs of both tables are matched by that column."
        )
    count = torch.bincount(number, minlength=len(labels))
    if int(count.min()) < _FEWEST:
        raise SimulationError(f"{_name_of(simulated, 'The simulated table')} has a run of one sample; it needs two.")
    last = count.cumsum(0) - 1
    run = torch.tensor([labels.index(label) for label in own_labels])[own]
    low, high = (last - count + 1)[run], last[run]
    inside = (time >= simulated["time"][low]) & (time <= simulated["time"][high])
    for k, label in enumerate(own_labels):
        if not bool(inside[own == k].any()):
            where = f" of run {label}" if label else ""
            raise SimulationError(
                f"{_name_of(recording, 'The recording')} and {_name_of(simulated, 'the simulated table')} do not "
                f"overlap in time{where}: {_range(recording, own == k)} was recorded, "
                f"{_range(simulated, number == labels.index(label))} simulated. Count both times from the same moment."
            )
    values = simulated.stack(*names)
    slopes = _slopes(simulated["time"], values, number)
    curve = _Curve(simulated["time"], values, slopes, number, run, low, high, tuple(labels))
    return inside, curve


def _slopes(time: Float[Tensor, " S"], values: Float[Tensor, "S m"], number: Int[Tensor, " S"]) -> Float[Tensor, "S m"]:
    """Slopes of the parabola through each moment and its neighbours; at the ends of a run, of the straight line."""
    step = time.diff().unsqueeze(-1)
    same = (number.diff() == 0).unsqueeze(-1)
    slope = torch.where(same, values.diff(dim=0) / torch.where(same, step, 1.0), 0.0)
    weight = torch.where(same, 1.0 / torch.where(same, step, 1.0), 0.0)
    nothing = torch.zeros_like(slope[:1])
    before, after = torch.cat([nothing, slope]), torch.cat([slope, nothing])
    left, right = torch.cat([nothing[:, :1], weight]), torch.cat([weight, nothing[:, :1]])
    return (left * before + right * after) / (left + right)


def _runs(recording: Recording) -> tuple[Int[Tensor, " N"], list[str]]:
    """Number of each sample's run, in order of appearance, and the labels of the runs."""
    if "experiment" not in recording:
        return torch.zeros(len(recording), dtype=torch.long), [""]
    names = recording.labels.get("experiment", ())
    values = recording["experiment"].tolist()
    order = {value: number for number, value in enumerate(dict.fromkeys(values))}
    labels = [names[int(value)] if names else f"{value:g}" for value in order]
    return torch.tensor([order[value] for value in values]), labels


def _interval(time: Float[Tensor, " N"], run: Int[Tensor, " N"]) -> float:
    inside = time.diff()[run.diff() == 0]
    return float(inside.median()) if len(inside) else 1.0


def _with_columns(recording: Recording, columns: Mapping[str, Tensor], *warnings: str) -> Recording:
    return Recording(
        columns,
        name=recording.name,
        units={name: recording.units[name] for name in columns},
        warnings=(*recording.warnings, *warnings),
        notes=recording.notes,
        labels={name: values for name, values in recording.labels.items() if name in columns},
    )


def _name_of(recording: Recording, otherwise: str) -> str:
    return recording.name or otherwise


def _listed(recording: Recording) -> str:
    return ", ".join(name for name in recording.names if name not in _NOT_KEYS) or "none"


def _experiments(labels: Sequence[str]) -> str:
    return ", ".join(label or "(no such column)" for label in labels)


def _range(recording: Recording, rows: Bool[Tensor, " N"] | None = None) -> str:
    time = recording["time"] if rows is None else recording["time"][rows]
    return f"{float(time.min()):g} to {float(time.max()):g} s"
