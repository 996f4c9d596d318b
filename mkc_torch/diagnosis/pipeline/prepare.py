"""Check the arguments of a diagnosis and join its recordings to one table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from mkc_torch._support.arguments import checked_number, checked_whole, format_value, refuse_other_type
from mkc_torch._support.arrays import is_frame
from mkc_torch.diagnosis.declared import checked_input_hold, checked_noise
from mkc_torch.diagnosis.model.suspect import refuse_unknown
from mkc_torch.diagnosis.pipeline.stretch import in_stretches
from mkc_torch.diagnosis.settings import Settings, quick_settings
from mkc_torch.effects.base import Effect
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.join_recordings import join_recordings, recording_names, refuse_no_recording
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics import Dynamics
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

_FREE_SAMPLES = 6
"""Samples of a fit in addition to one for each parameter, at least, so that a residual has a size. Judgement."""


@dataclass(frozen=True)
class SearchOptions:
    """The options of :func:`diagnose`.

    ``judged`` is True if held-out blocks test the candidates; ``suspect`` holds the suspected sets of effects as texts;
    ``too_few`` is True if the samples are too few for any test, so that candidates are only ranked.
    """

    level: float
    surrogates: int
    max_findings: int
    seed: int
    settings: Settings
    declared: Mapping[str, float] = field(default_factory=dict)
    fixed: Mapping[str, str] = field(default_factory=dict)
    quick: bool = False
    judged: bool = True
    suspect: tuple[str, ...] = ()
    too_few: bool = False


@dataclass(frozen=True)
class Problem:
    """The checked input of a diagnosis.

    Attributes:
        simulation: as given by the user.
        prepared: the simulation together with the recording.
        effects: the catalogue.
        options: of the search.
        recordings: names of the recordings that are diagnosed together; empty for a single recording.
        run_counts: number of runs in each of these recordings.
        progress: called with the name of each stage.
        whole: all that was given, if the diagnosis uses stretches of it.
    """

    simulation: Simulation
    prepared: PreparedSimulation
    effects: tuple[Effect, ...]
    options: SearchOptions
    recordings: tuple[str, ...]
    run_counts: tuple[int, ...]
    progress: Callable[[str], object]
    whole: Recording | None = None

    @property
    def where(self) -> str:
        """Name of the recording, as the beginning of an error message."""
        return subject_of(self.prepared.recording)


def prepare(
    simulation: Simulation,
    recording: Recording | Sequence[Recording],
    effects: Sequence[Effect],
    options: SearchOptions,
    time_limit: float | None,
    progress: Callable[[str], object],
) -> Problem:
    """Check the arguments of :func:`mkc_torch.diagnose`, and prepare the simulation with the recording.

    Raises:
        TypeError, ValueError, MissingColumnError: see :func:`mkc_torch.diagnose`.
    """
    refuse_no_simulation(simulation)
    several = () if isinstance(recording, Recording) else tuple(recording)
    recording, names = joined(simulation, recording)
    effects = checked_effects(effects)
    check_numbers(options.level, options.surrogates, options.max_findings, options.seed)
    check_limits(options.quick, time_limit)
    refuse_no_settings(options.settings)
    _refuse_no_progress(progress)
    progress("reading the recording")
    whole = recording
    if isinstance(simulation, Dynamics) and "time" in recording:
        shorter = in_stretches(several or (recording,), stepped=simulation.steps is not None, quick=options.quick)
        several = shorter if several else ()
        recording = joined(simulation, shorter if several else shorter[0])[0]
    prepared = simulation.prepare(recording)
    _refuse_few(prepared)
    if len(prepared.time) < options.settings.search.fewest_samples:
        options = replace(options, quick=True, max_findings=0, suspect=(), too_few=True)
    settings = quick_settings(options.settings) if options.quick else options.settings
    _refuse_constant(prepared)
    prepared = with_own_offsets(prepared, several)
    options = replace(
        options,
        settings=settings,
        declared=checked_noise(options.declared, prepared.channels),
        fixed=checked_input_hold(options.fixed, tuple(prepared.input_hold)),
        # a quick look at differential equations tests nothing on held-out blocks
        max_findings=min(options.max_findings, 1) if _unjudged(options, prepared) else options.max_findings,
        judged=not _unjudged(options, prepared),
    )
    prepared = prepared.with_input_hold(options.fixed)
    refuse_unknown(options.suspect, simulation, prepared, effects, settings.drivers)
    counts = run_counts(several) if names else ()
    parts = whole if len(whole) > len(recording) else None
    return Problem(simulation, prepared, effects, options, names, counts, progress, parts)


def _unjudged(options: SearchOptions, prepared: PreparedSimulation) -> bool:
    return options.too_few or (options.quick and prepared.dynamics is not None)


def subject_of(recording: Recording) -> str:
    """Return the name of a recording as the beginning of an error message; empty for a recording without a name."""
    return f"{recording.name}: " if recording.name else ""


def _refuse_few(prepared: PreparedSimulation) -> None:
    """Raise for fewer samples than a fit of the simulation and an estimate of its noise need."""
    count, fewest = len(prepared.time), len(prepared.parameter_names) + _FREE_SAMPLES
    if count < fewest:
        raise ValueError(
            f"{subject_of(prepared.recording)}{count} usable samples are too few for a fit of "
            f"{len(prepared.parameter_names)} parameters and initial states; it needs {fewest} at least. Record "
            "longer, or fix parameters."
        )


def refuse_no_simulation(simulation: object) -> None:
    if not isinstance(simulation, type) and all(hasattr(simulation, name) for name in ("columns", "prepare")):
        return
    remedy = "pass a simulation, such as Magnetometer()"
    if isinstance(simulation, type):
        remedy = f"create an instance, {simulation.__name__}()"
    elif isinstance(simulation, Recording):
        remedy = "pass the simulation first, diagnose(simulation, recording)"
    elif isinstance(simulation, str):
        remedy += f", or use the command line, mkc diagnose REC.csv --simulation {simulation} --output DIR"
    raise TypeError(f"Expected argument `simulation` to be a Simulation but got {format_value(simulation)}; {remedy}.")


def checked_effects(effects: object) -> tuple[Effect, ...]:
    if isinstance(effects, str) or not isinstance(effects, Iterable):
        raise TypeError(
            f"Expected argument `effects` to be a sequence of Effects but got {format_value(effects)}; pass a tuple "
            "such as mkc_torch.effects.CATALOGUE, or () for no effects."
        )
    # an iterator would be empty the second time
    checked = tuple(effects)
    for effect in checked:
        _refuse_no_effect(effect)
    return checked


def _refuse_no_effect(effect: object) -> None:
    roles: object = effect.roles if isinstance(effect, Effect) else ()
    if isinstance(effect, type):
        remedy = f"create an instance, {effect.__name__}()"
    elif isinstance(effect, str):
        remedy = f"select it from mkc_torch.effects.CATALOGUE, [e for e in CATALOGUE if e.id == {effect!r}]"
    elif not isinstance(effect, Effect):
        remedy = "derive it from mkc_torch.effects.Effect"
    elif not effect.id:
        remedy = "give it an `id`, its name in diagnosis.json"
    elif isinstance(roles, str):
        remedy = f"its roles are names, ({roles!r},)"
    else:
        return
    raise TypeError(f"Expected argument `effects` to hold Effects but got {format_value(effect)}; {remedy}.")


def _refuse_constant(prepared: PreparedSimulation) -> None:
    """Raise for an output of differential equations that never changes: no noise can be estimated from it."""
    if prepared.dynamics is None:
        return
    for name, values in zip(prepared.channels, prepared.dynamics.measured.unbind(-1), strict=True):
        if bool((values == values[0]).all()):
            raise ValueError(
                f"{subject_of(prepared.recording)}the output `{name}` is {float(values[0]):g} in all samples. A "
                "diagnosis needs an output that changes: check the column, or remove the output from the simulation."
            )


def _refuse_no_progress(progress: object) -> None:
    if not callable(progress):
        raise TypeError(
            f"Expected argument `progress` to be a function of one text but got {format_value(progress)}; pass print, "
            "for example."
        )


def refuse_no_settings(settings: object) -> None:
    advice = "pass Settings(), or dataclasses.replace(Settings(), naming=NamingSettings(separable=8.0))"
    refuse_other_type("settings", settings, Settings, "Settings", advice)


def check_numbers(level: float, surrogates: int, max_findings: int, seed: int) -> None:
    checked_number("level", level, 0.0, 1.0, advice="0.05 is usual")
    checked_whole("surrogates", surrogates, 0, "99 is usual")
    checked_whole("max_findings", max_findings, 0, "3 is usual")
    checked_whole("seed", seed)
    if surrogates < math.ceil(1.0 / level - 1.0 - 1e-9):
        raise ValueError(
            f"Expected argument `surrogates` to be at least {math.ceil(1.0 / level - 1.0 - 1e-9)} at level {level}, "
            f"because no p-value can be smaller than 1 / (surrogates + 1), but got {surrogates}."
        )


def check_limits(quick: object, time_limit: object) -> None:
    """Raise for a ``quick`` that is not a bool, or a time limit that is not a positive number."""
    refuse_other_type("quick", quick, bool, "bool", "True for a quick look without p-values")
    if time_limit is not None:
        checked_number("time_limit", time_limit, 0.0, advice="pass seconds, such as 60, or None for no limit")


def joined(simulation: Simulation, recording: Recording | Sequence[Recording]) -> tuple[Recording, tuple[str, ...]]:
    """Return one recording of all that were given, and their names; no names for a single recording.

    Raises:
        TypeError: neither a recording nor a list or tuple of recordings.
        RecordingError: no recording, or columns, units or labels that differ.
    """
    if isinstance(recording, Recording) or is_frame(recording) or not isinstance(recording, (list, tuple)):
        refuse_no_recording("recording", recording)
        assert isinstance(recording, Recording)
        return recording, ()
    for number, item in enumerate(recording):
        refuse_no_recording(f"recording[{number}]", item)
    whole = join_recordings(recording, simulation.joint_clock)
    return whole, recording_names(recording) if len(recording) > 1 else ()


def run_counts(recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Return the number of runs in each recording."""
    return tuple(len(recording.experiments()) for recording in recordings)


def with_own_offsets(prepared: PreparedSimulation, recordings: Sequence[Recording]) -> PreparedSimulation:
    """Return the simulation with separate offsets of its outputs for each recording.

    A simulation without such offsets, such as the magnetometer's, is returned unchanged.
    """
    whole = prepared.recording
    if len(recordings) < 2 or EXPERIMENT not in whole:
        return prepared
    counts = torch.tensor(run_counts(recordings))
    of_experiment = torch.arange(len(recordings)).repeat_interleave(counts)
    recording, names = of_experiment[whole[EXPERIMENT].long()], recording_names(recordings)
    return prepared.with_own_offsets(recording, names)
