"""``diagnosis.plot``: the figures of the report on axes of matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mkc_torch._support.drawing import BLUE, GREY, ORANGE, array, axes_or_new
from mkc_torch._support.typesetting import capital, plain
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.parts import CandidateScore, Finding, Separability, Traces
from mkc_torch.diagnosis.plot.drawings import (
    MOMENTS,
    MOST_LETTERS,
    acting_channels,
    draw_course,
    draw_curve,
    draw_floor,
    draw_map,
    draw_residual,
    mark_findings,
    named,
    of_channel,
    of_time,
    short,
    unit_of_channel,
    units_of_outputs,
)
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.effects import words_of

_MOST_SHOWN = 12
"""Default number of candidates."""


class DiagnosisPlot:
    """Figures of a diagnosis. Each method draws on ``ax``, or on a new figure of pyplot, and returns the axes.

    Needs matplotlib, which the extra ``cli`` installs. Raises ValueError if there is nothing to draw, and TypeError if
    ``ax`` is not an Axes.

    Example:
        >>> import torch
        >>> from matplotlib import pyplot
        >>> from mkc_torch import Recording, diagnose
        >>> from mkc_torch.simulation import Static
        >>> time = torch.arange(100) / 10.0
        >>> noise = 0.01 * torch.randn(100, generator=torch.Generator().manual_seed(0))
        >>> recording = Recording({"time": time, "heat": torch.sin(time), "voltage": 2.0 * torch.sin(time) + noise})
        >>> line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
        >>> axes = diagnose(line, recording, effects=(), surrogates=19).plot.residual()
        >>> axes.get_xlabel(), axes.get_title()
        ('time (s)', 'Residual, voltage')
        >>> pyplot.close(axes.figure)
    """

    def __init__(
        self,
        traces: Traces,
        findings: tuple[Finding, ...],
        candidates: tuple[CandidateScore, ...],
        separability: Separability,
        environment: NoiseEnvironment,
    ) -> None:
        self._traces, self._findings, self._candidates = traces, findings, candidates
        self._separability, self._environment = separability, environment

    def residual(self, channel: int | str = 0, *, corrected: bool | None = None, ax: Any = None) -> Any:
        """Draw the residual over time, in the unit of the output, with onsets and intervals of the findings.

        Samples in use are blue, rejected samples orange. The black line is the mean of the samples in use, the lines on
        both sides their RMS; dashed: RMS without findings; dotted: noise floor.

        Args:
            channel: number or name of an output.
            corrected: with the findings that count; default if there are any.
            ax: axes of matplotlib.

        Raises:
            ValueError: the channel does not exist, or ``corrected`` is True and no finding counts.
        """
        t, which = self._traces, self._channel(channel)
        some = any(counts(finding) for finding in self._findings)
        after = some if corrected is None else corrected
        if after and not some:
            raise ValueError("Expected argument `corrected` to be False: the diagnosis has no finding that counts.")
        ax = axes_or_new(ax)
        mark_findings(ax, self._findings)
        draw_residual(ax, t, array(t.time), which, unit_of_channel(t, self._environment, which), after=after)
        floor = [fit.noise_floor for fit in self._environment.goodness_of_fit if fit.output == t.channels[which]]
        draw_floor(ax, floor[0] if floor else None)
        ax.set_title(of_channel(MOMENTS[after] if some else "residual", t.channels[which]))
        ax.set_xlabel(of_time(t.has_time))
        return ax

    def over_driver(
        self,
        finding: int = 0,
        *,
        driver: str | None = None,
        channel: int | str | None = None,
        corrected: bool = True,
        ax: Any = None,
    ) -> Any:
        """Draw the residual over a finding's driver; colours as in :meth:`residual`.

        Args:
            finding: its number, from 0.
            driver: a recorded column; default the finding's first.
            channel: number or name of an output; default the channel with the largest change.
            corrected: with the findings that count, and with this one.
            ax: axes of matplotlib.

        Raises:
            ValueError: the finding, channel or column does not exist, or the finding has no recorded driver.
        """
        t, found = self._traces, self._finding(finding)
        known = [name for name in found.drivers if name in t.drivers]
        name = driver if driver is not None else (known[0] if known else None)
        if name is None:
            raise ValueError(f"Finding {finding}, {words_of(found.effect)}, has no recorded driver.")
        if name not in t.drivers:
            there = ", ".join(t.drivers) or "none"
            raise ValueError(
                f"Expected argument `driver` to be a recorded column but got {name!r}; there are: {there}."
            )
        which = acting_channels(t, found)[0] if channel is None else self._channel(channel)
        ax = axes_or_new(ax)
        unit = unit_of_channel(t, self._environment, which)
        draw_residual(ax, t, array(t.drivers[name]), which, unit, after=corrected, finding=found)
        ax.set_title(of_channel(MOMENTS[corrected], t.channels[which]))
        ax.set_xlabel(named(name, t.driver_units.get(name, "")))
        return ax

    def effect(self, finding: int = 0, ax: Any = None) -> Any:
        """Draw the curve of a finding over its driver, one colour per channel, with its 95 % band.

        Raises:
            ValueError: the finding does not exist, or has no curve.
        """
        found = self._finding(finding)
        if found.curve is None:
            raise ValueError(f"Finding {finding}, {words_of(found.effect)}, has no curve.")
        ax = axes_or_new(ax)
        draw_curve(ax, found.curve, self._traces.has_time, most=2 * MOST_LETTERS)
        ax.set_title(f"{capital(words_of(found.effect))}, 95 % band")
        if len(found.curve.channels) > 1:
            ax.legend(frameon=False)
        return ax

    def gain_map(self, finding: int = 0, ax: Any = None) -> Any:
        """Draw the gain of a finding over two states, in nats per cell.

        Raises:
            ValueError: the finding does not exist, or has no map: the simulation has fewer than two states.
        """
        found = self._finding(finding)
        if found.map is None:
            raise ValueError(f"Finding {finding}, {words_of(found.effect)}, has no map over two states.")
        ax = axes_or_new(ax)
        draw_map(ax, found.map, units_of_outputs(self._environment))
        return ax

    def held_out(self, ax: Any = None) -> Any:
        """Draw the gain of each finding on held-out blocks, in nats per sample, with its 95 % interval.

        Raises:
            ValueError: no finding has a gain on held-out blocks.
        """
        known = [(f, f.held_out) for f in self._findings if f.held_out is not None]
        if not known:
            raise ValueError("No finding has a gain on held-out blocks.")
        ax = axes_or_new(ax)
        ax.axvline(0.0, color=GREY, lw=0.7, zorder=1)
        for row, (_, held) in enumerate(known):
            ax.plot(held.confidence_interval, (row, row), color=BLUE, lw=2.2, solid_capstyle="butt")
            ax.plot(held.log_likelihood_gain, row, "o", color=BLUE, ms=6)
        _rows(ax, [_with_drivers(f.effect, f.drivers) for f, _ in known])
        ax.set_xlabel("gain (nats per sample)")
        ax.set_title("Gains on held-out blocks, 95 % interval")
        return ax

    def candidates(self, most: int = _MOST_SHOWN, ax: Any = None) -> Any:
        """Draw the gains of the leading candidates, in nats, in the order of the search; findings are orange.

        Args:
            most: maximum number of candidates.
            ax: axes of matplotlib.

        Raises:
            ValueError: there are no candidates, or ``most`` is less than 1.
        """
        if isinstance(most, bool) or most < 1:
            raise ValueError(f"Expected argument `most` to be at least 1 but got {most}; the report shows 12.")
        if not self._candidates:
            raise ValueError("There are no candidates to draw.")
        shown = self._candidates[:most]
        found = {(finding.effect, finding.drivers) for finding in self._findings}
        ax = axes_or_new(ax)
        for row, candidate in enumerate(shown):
            color = ORANGE if (candidate.effect, candidate.drivers) in found else BLUE
            ax.barh(row, max(candidate.log_likelihood_gain, 0.0), color=color, height=0.66)
        _rows(ax, [_with_drivers(candidate.effect, candidate.drivers) for candidate in shown])
        ax.set_xlabel("gain, nats")
        ax.set_title("Candidates, best first")
        return ax

    def separability(self, most: int = _MOST_SHOWN, ax: Any = None) -> Any:
        """Draw the share of each row's candidate that remains after a refit of the column's candidate: 0 is
        inseparable.

        Args:
            most: of how many candidates at the most.
            ax: axes of matplotlib.

        Raises:
            ValueError: there are no candidates to compare, or ``most`` is less than 1.
        """
        if isinstance(most, bool) or most < 1:
            raise ValueError(f"Expected argument `most` to be at least 1 but got {most}; the report shows 12.")
        labels = [_label(label) for label in self._separability.labels[:most]]
        if not labels:
            raise ValueError("There are no candidates to compare.")
        share = array(self._separability.share)[: len(labels), : len(labels)].copy()
        ax = axes_or_new(ax)
        drawn = ax.imshow(share, cmap="cividis", vmin=0.0, vmax=1.0)
        ax.set_xticks(range(len(labels)), labels, rotation=45, ha="right", rotation_mode="anchor")
        ax.set_yticks(range(len(labels)), labels)
        ax.figure.colorbar(drawn, ax=ax).ax.set_ylabel("remaining share")
        ax.set_title("Separability of the candidates")
        return ax

    def forcing(self, index: int = 0, ax: Any = None) -> Any:
        """Draw the estimated disturbance of a rate or drift of an output, with its 95 % band.

        Raises:
            ValueError: the disturbance does not exist.
        """
        known = self._environment.disturbance
        _check_number("index", index, len(known), "disturbance was found")
        ax = axes_or_new(ax)
        draw_course(ax, known[index], self._traces.has_time)
        ax.set_ylabel(named("disturbance", tidy(known[index].unit)))
        return ax

    def _finding(self, number: int) -> Finding:
        _check_number("finding", number, len(self._findings), "finding was made")
        return self._findings[number]

    def _channel(self, channel: int | str) -> int:
        names = self._traces.channels
        if isinstance(channel, str):
            if channel not in names:
                raise ValueError(f"Expected argument `channel` to be one of {', '.join(names)} but got {channel!r}.")
            return names.index(channel)
        _check_number("channel", channel, len(names), "channel exists")
        return channel


def _check_number(argument: str, number: int, count: int, what: str) -> None:
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < count:
        there = f"no {what}" if count == 0 else f"1 {what}: 0" if count == 1 else f"valid: 0 to {count - 1}"
        raise ValueError(f"Expected argument `{argument}` to be a valid number but got {number!r}; {there}.")


def _with_drivers(effect: str, drivers: Sequence[str]) -> str:
    return words_of(effect) + (f" ({', '.join(short(name) for name in drivers)})" if drivers else "")


def _label(label: str) -> str:
    effect, space, rest = label.partition(" ")
    return words_of(plain(effect)) + space + plain(rest)


def _rows(ax: Any, names: Sequence[str]) -> None:
    """Label the rows, the first at the top."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, -0.6)
