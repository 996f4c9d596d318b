"""Add to a model what a check compares new recordings with: the diagnosed recording, predicted in the same way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.io.training import OutputTraining, Training
from mkc_torch.diagnosis.validation.blocks import block_numbers, block_squares
from mkc_torch.diagnosis.validation.fingerprint import of_runs
from mkc_torch.diagnosis.validation.predict import Prediction, predict
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float


def with_training(
    model: DiagnosedModel,
    parameters: Float[Tensor, " p"],
    state: Mapping[str, Any],
    recording: Recording,
    columns: Sequence[str],
) -> DiagnosedModel:
    """Return the model with the fingerprints of its recording, and the residuals of the predictions with and without
    the findings; without residuals where the recording cannot be predicted, such as one of short runs.

    Args:
        model: the simulation with the findings.
        parameters: (p,), of the simulation alone.
        state: constants of that fit.
        recording: the diagnosed recording.
        columns: its measured columns.
    """
    alone = with_baseline(model, parameters, state)
    known = alone.reference
    assert known is not None
    known = replace(known, fingerprints=of_runs(recording, columns))
    try:
        outputs = compared(*predict_both(alone.baseline, model, recording))
    except ValueError:
        return _with(model, known)
    return _with(model, replace(known, outputs=outputs))


def with_baseline(model: DiagnosedModel, parameters: Float[Tensor, " p"], state: Mapping[str, Any]) -> DiagnosedModel:
    """Return the model with the simulation without findings alone."""
    return _with(model, Training(tuple(parameters.tolist()), dict(state)))


def predict_both(
    baseline: DiagnosedModel, corrected: DiagnosedModel, recording: Recording, start_seconds: float | None = None
) -> tuple[Prediction, Prediction]:
    """Return the predictions without and with the findings, of the same samples; see :func:`.predict.predict`."""
    found = predict(corrected, recording, start_seconds)
    return predict(baseline, recording, found.start_seconds), found


def compared(baseline: Prediction, corrected: Prediction) -> dict[str, OutputTraining]:
    """Return the mean squares of both residuals by output, on the same blocks."""
    block = block_numbers(corrected.run, corrected.predicted)
    each = zip(corrected.outputs, baseline.residual.unbind(-1), corrected.residual.unbind(-1), strict=True)
    return {
        name: OutputTraining(block_squares(before, block), block_squares(after, block)) for name, before, after in each
    }


def _with(model: DiagnosedModel, training: Training) -> DiagnosedModel:
    gammas = list(model.gammas)
    return DiagnosedModel(model.simulation, model.state, model.theta, model.terms, gammas, model.source, training)
