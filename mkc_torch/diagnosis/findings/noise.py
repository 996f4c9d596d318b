"""Summary of the final noise model."""

from __future__ import annotations

from mkc_torch.density.tails import time_series_tails
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate
from mkc_torch.diagnosis.result import NoiseSummary, Number
from mkc_torch.diagnosis.settings import NoiseSettings

__all__ = ["noise_summary"]


def noise_summary(final: FinalEstimate, settings: NoiseSettings) -> NoiseSummary:
    """Return the noise model (white, autoregressive or random walk) with its parameters."""
    fit, drift = final.fit, final.noise
    prepared = fit.model.prepared
    orders = final.spectrum.coefficients
    coloured = any(float(phi.square().sum()) > settings.reported_autocorrelation for phi in orders)
    parameters: dict[str, Number] = {}
    units: dict[str, str] = {}
    clear = drift.size > 0 and drift.gain > settings.reported_drift
    if clear:
        parameters["drift"] = final.drift_spread
        units["drift"] = next(port.unit for port in prepared.ports.values() if port.allows_drift)
        if drift.family > 0:
            length = float(prepared.time[-1] - prepared.time[0])
            parameters["drift_period"] = 2.0 * length / settings.plateaus[drift.family - 1][0]
            units["drift_period"] = "s"
    if coloured:
        parameters["autoregression"] = tuple(tuple(phi.tolist()) for phi in orders)
    if clear and drift.family == 0:
        model = "random_walk"
        size = f"{parameters['drift']:.2g} {units['drift']}"
        text = f"noise around an offset with a random walk of standard deviation {size}"
    elif clear or coloured:
        model, text = "ar", "coloured noise" + (", with drift of the offset" if clear else "")
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
