"""The noise that is left, in words and numbers."""

from __future__ import annotations

from mkc_torch.density.tails import time_series_tails
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate
from mkc_torch.diagnosis.result import NoiseSummary, Number
from mkc_torch.diagnosis.settings import NoiseSettings

__all__ = ["noise_summary"]


def noise_summary(final: FinalEstimate, settings: NoiseSettings) -> NoiseSummary:
    """White, autoregressive, or wandering like a random walk, with its numbers."""
    fit, drift = final.fit, final.noise
    prepared = fit.model.prepared
    orders = final.spectrum.coefficients
    coloured = any(float(phi.square().sum()) > settings.reported_autocorrelation for phi in orders)
    parameters: dict[str, Number] = {}
    units: dict[str, str] = {}
    clear = drift.size > 0 and drift.gain > settings.reported_drift
    if clear:
        parameters["wander"] = final.drift_spread
        units["wander"] = next(port.unit for port in prepared.ports.values() if port.allows_drift)
        if drift.family > 0:
            length = float(prepared.time[-1] - prepared.time[0])
            parameters["wander_period"] = 2.0 * length / settings.plateaus[drift.family - 1][0]
            units["wander_period"] = "s"
    if coloured:
        parameters["autoregression"] = tuple(tuple(phi.tolist()) for phi in orders)
    if clear and drift.family == 0:
        model = "random_walk"
        size = f"{parameters['wander']:.2g} {units['wander']}"
        text = f"noise around an offset that wanders like a random walk, by {size} in all"
    elif clear or coloured:
        model, text = "ar", "coloured noise" + (", with a slow part that enters with the offset" if clear else "")
    else:
        model, text = "white", "white noise"
    tails = time_series_tails(fit.residual)
    tail = "Gaussian" if all(channel.is_gaussian for channel in tails) else "heavy-tailed"
    return NoiseSummary(
        model,  # type: ignore[arg-type]
        parameters,
        tuple(fit.sigma.tolist()),
        tuple(fit.d.tolist()),
        tuple(fit.bound.tolist()),
        f"{tail} {text}",
        units,
        prepared.unit,
        tails,
    )
