"""The numbers that decide a verdict on a model of differential equations, each with its unit and its source.

A number decides if half or twice of it changes a verdict: ``python -m tests.thresholds.deciding --gate DIR`` counts
that on the trails of recordings. Shares and ratios have no unit; gains and differences of log-likelihood are in nats.
"By judgement" means on the project's own generated recordings, which no published figure is measured on. Numerical
tolerances are next to their code. Fields of :class:`~mkc_torch.diagnosis.settings.Settings` have these numbers as
defaults.
"""

from __future__ import annotations

LEVEL = 0.05
"""Rate of false alarms; the argument ``level`` of a diagnosis. The usual one (Fisher, "Statistical Methods for Research
Workers", 1925)."""

NULL_WITHIN = 6.0
"""Nats within which noise models are alike, and each is drawn from: :data:`DISTURBANCE`."""

SEPARABLE = 4.5
"""Nats by which a rival has to be less likely to be distinguishable: three standard errors, because the squared number
of standard errors is twice the nats."""

DISTURBANCE = 6.0
"""Nats that a disturbance of a state, or a slow error of an output, has to gain to enter the noise. By
judgement; the rate of false alarms is measured with it (`python -m tests.gate.null_p_values`)."""

NAMELESS = 10.0
"""Price of a curve without a name in nats: it can follow any named effect slightly better. By judgement."""

GENERALISATION = 5.0
"""Price in nats of a form that includes named forms as special cases, as a power law includes drags. By judgement."""

IMPLAUSIBLE = 10.0
"""Multiple of a rate's largest value in the recording that no effect changes it by unless the inputs do, and of an
effect's largest plausible size above which a finding is unconfirmed. By judgement: an order of magnitude."""

WIDTH = 6
"""Models of the beam. By judgement: more cost time."""

LEAST_WIDTH = 3
"""Models of the beam that are expanded whatever their distance to the best: one losing step is allowed."""

MOST_TERMS = 5
"""Largest number of effects of a model."""

MOST_MODELS = 66
"""Largest number of models of a recording. By judgement: more cost time."""

IMPROVING = 1.0 / 3.0
"""Share of them that is kept for improving the best models of the beam, the last six for effects along the noise. By
judgement, on an arm with a propeller."""

PAYS = 0.5
"""Share of its price that an addition to a model with effects has to gain in the linearised model. By judgement, on an
arm with a propeller."""

SMALL = 0.05
"""Share of the residual on held-out blocks that a finding worth correcting reduces it by. By judgement: less shows in
means of many samples only."""

LARGER = 1.0 + SMALL
"""Ratio of residuals with and without an effect above which the effect enlarges the residual."""

NAMED = 1.15
"""Ratio of typical open-loop residuals up to which named effects are preferred to a curve without a name. By judgement,
on a rocket's flight; a pendulum whose hidden force is in no catalogue is above it."""

KEPT = 0.5
"""Share of the gain over the simulation alone that a fit under process noise may lose to the open-loop fit. By
judgement."""

HOLD = 1.0
"""Nats that another hold of an input than the simulation's own has to gain: where the two fit alike, rounding would
choose. More would keep a wrong hold, whose error resembles physics. By judgement."""

FAR_LESS = 0.3
"""Ratio of open-loop residuals with and without an effect below which the effect is mentioned though no finding.

Set on 38 recordings of a ship, a circuit, a basin and a sled (`python -m tests.thresholds.open_loop`, seeds 0 to 3):
where nothing is hidden and a disturbance acts, no candidate is below it in 10 of 10 (smallest 0.33); the hidden
effect is in 18 of 28.
"""

VISIBLE = 0.1
"""Share of the change of a sensor's vector that its compared length has to show: a small offset in random directions
shows 1 / √3. By reasoning."""

SHAPE_LEVEL = 0.001
"""p-value of a free curve's gain below which a name is only the nearest in the catalogue. By judgement."""

SHAPE_NATS = 6.0
"""Nats that the curve has to gain beyond Schwarz's price of its numbers: :data:`DISTURBANCE`."""

USEFUL = 0.35
"""Mean explained share of the outputs' variation that the best model has to reach in open loop for a verdict other than
unfit. By judgement."""

LOST = -1.0
"""Smallest explained share of an output in that mean: how far a lost output is off does not matter."""

FOLLOWED = 0.5
"""Share of an output's variation that the simulation has to explain in open loop for a good fit. By judgement."""

CORRECTION = 1.0
"""Ratio of what the findings explain in addition to what the simulation explains, above which signs and units are
doubted: the correction is then larger than the simulation."""

ABOVE_FLOOR = 1.5
"""Ratio to a declared noise floor above which a residual is more than the sensor's noise. By judgement."""

FAR_ABOVE_FLOOR = 10.0
"""Ratio to the white noise of the recorded samples, or to their resolution, above which a residual is not explained. By
judgement: at most a hundredth of its square is then noise."""

MUCH_REJECTED = 1.0 / 3.0
"""Share of rejected samples from which a diagnosis is doubtful. By judgement."""

RESTARTED = 0.8
"""Share of a polynomial's squared residual that a simulation with restarts has to explain, for each output.

By judgement: a chaotic oscillator and a quadrotor in closed loop reach 0.86 to 0.99, an oscillator with forces of the
wrong sign 0.75, a vehicle with a wrong sign or unrelated outputs less than 0."""
