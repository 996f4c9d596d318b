"""Check a corrected model on a recording that no fit has used."""

from __future__ import annotations

from collections.abc import Mapping

from mkc_torch._support.arguments import format_value
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.result import CorrectingModel
from mkc_torch.diagnosis.validation.fingerprint import of_runs
from mkc_torch.diagnosis.validation.judge import claims, clearly_grown, judged, unless_lost
from mkc_torch.diagnosis.validation.result import CheckTraces, OutputCheck, RecordingCheck
from mkc_torch.diagnosis.validation.training import compared, predict_both
from mkc_torch.recording.recording import Recording

_COARSE = 1e-3
"""Error of integration, as a share of an output's range, that is worth a warning."""


def check(
    model: CorrectingModel,
    recording: Recording,
    *,
    start_seconds: float | None = None,
    input_hold: Mapping[str, str] | None = None,
) -> RecordingCheck:
    """Check a model on a recording that no fit has used: are its residuals smaller with the findings than without?

    Both simulations, without and with the findings, keep the parameters of their fits to the diagnosed recording. Their
    initial states are estimated from the first part of each trajectory, and the rest is predicted in open loop; a model
    with ``restart_after`` is predicted in the segments that it was fitted with. A magnetometer's model is checked by
    the spread of the corrected field's length about its median.

    The model holds if every output that the findings make clearly better in the diagnosed recording is clearly better
    with them in this one, no other output is clearly worse, and the simulation follows the recording at all. Clearly
    means that the root mean square changes by 5 % or more, and that the 95 % interval of the ratio, with over without
    findings, does not contain 1. A model without such an output holds if no residual is clearly larger than in the
    diagnosed recording: more than 1.5 times, with the interval above 1.

    Args:
        model: such as ``Diagnosis.model``, or :meth:`mkc_torch.diagnosis.DiagnosedModel.from_json` with its simulation.
        recording: of the same system or sensor.
        start_seconds: s from the start of each trajectory that the initial states are estimated from; None for the
            simulation's ``initial_window``, or if it has none, the shortest part that is enough for the initial states,
            at least a tenth of the shortest trajectory.
        input_hold: holds of inputs in this recording, "held", "linear" or "smooth", by input; the others are those of
            the model.

    Returns:
        The check, with the verdict and the RMSE of each output.

    Raises:
        TypeError: ``model`` is not a model, or ``recording`` is not a recording.
        MissingColumnError: a column of the simulation, or an effect's driver, is missing.
        ValueError: an argument out of range, trajectories that are too short, or a model of an earlier version.
        SimulationError: no trajectory is found.

    Example:
        >>> import torch
        >>> from mkc_torch import Recording, diagnose
        >>> from mkc_torch.simulation import Static
        >>> def bench(seed):
        ...     g, time = torch.Generator().manual_seed(seed), torch.arange(200) / 10.0
        ...     heat, load = torch.sin(time), torch.cos(2.3 * time)
        ...     voltage = 2.0 * heat + 0.5 * load + 0.01 * torch.randn(200, generator=g)
        ...     return Recording({"time": time, "heat": heat, "load": load, "voltage": voltage})
        >>> line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
        >>> model = diagnose(line, bench(0), surrogates=19).model
        >>> check(model, bench(1)).verdict, check(model, bench(0)).verdict
        ('holds', 'used in the fit')
    """
    if not isinstance(model, DiagnosedModel):
        raise TypeError(
            f"Expected argument `model` to be a DiagnosedModel but got {format_value(model)}; pass `Diagnosis.model`, "
            "or DiagnosedModel.from_json(text, simulation=...)."
        )
    if not isinstance(recording, Recording):
        raise TypeError(
            f"Expected argument `recording` to be a Recording but got {format_value(recording)}; read a file with "
            "Recording.read(path)."
        )
    known, alone = model.reference, model.baseline
    assert known is not None
    if input_hold:
        model, alone = model.with_input_hold(input_hold), alone.with_input_hold(input_hold)
    baseline, corrected = predict_both(alone, model, recording, start_seconds)
    new = compared(baseline, corrected)
    any_claim = any(claims(each) for name, each in known.outputs.items() if name in new)
    outputs = tuple(
        judged(name, unit, new[name], known.outputs.get(name), share, findings=bool(model.terms), any_claim=any_claim)
        for name, unit, share in zip(corrected.outputs, corrected.units, corrected.explained, strict=True)
    )
    accuracy = max(baseline.accuracy, corrected.accuracy)
    return RecordingCheck(
        recording=recording.name,
        simulation=model.simulation,
        samples=len(corrected.time),
        predicted=int(corrected.predicted.sum()),
        start_seconds=corrected.start_seconds,
        segment_seconds=model.state.get("restart_after"),
        findings=tuple(term.effect.id for term in model.terms),
        outputs=unless_lost(outputs),
        used_in_fit=bool(set(of_runs(corrected.recording, corrected.columns)) & set(known.fingerprints)),
        accuracy=accuracy,
        initial=corrected.initial,
        warnings=(
            *recording.warnings,
            *corrected.notes,
            *_accuracy_warnings(accuracy),
            *(_growth_warning(each) for each in outputs if clearly_grown(each.growth) and not each.failure),
            *_claim_warnings(model, any_claim=any_claim),
        ),
        traces=CheckTraces(
            corrected.time,
            corrected.run,
            corrected.predicted,
            corrected.measured,
            baseline.simulated.detach(),
            corrected.simulated.detach(),
        ),
    )


def _growth_warning(each: OutputCheck) -> str:
    return (
        f"{each.output}: the residual is {each.growth.value:.2f} times that in the diagnosed recording (95 % interval "
        f"{each.growth.low:.2f} to {each.growth.high:.2f})."
    )


def _accuracy_warnings(accuracy: float) -> list[str]:
    if accuracy <= _COARSE:
        return []
    return [
        f"The integration is accurate to {accuracy:.1%} of an output's range; give the simulation a smaller `step`."
    ]


def _claim_warnings(model: DiagnosedModel, *, any_claim: bool) -> list[str]:
    if any_claim or not model.terms:
        return []
    return ["The findings make no output's residual clearly smaller in the diagnosed recording."]
