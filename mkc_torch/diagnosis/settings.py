"""Thresholds of a diagnosis by stage, each with its meaning and source.

Numerical accuracy (grids, orders, iterations, tolerances) is set next to the code. Gains and differences of
log-likelihood are in nats, times in seconds, shares between 0 and 1. A number without a source was set by judgement, on
the project's own generated recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_other_type
from mkc_torch.diagnosis import thresholds


class _Stage:
    """Check the numbers of a stage: integers from 1, other numbers finite and not negative."""

    def __post_init__(self) -> None:
        for known in fields(self):  # type: ignore[arg-type]
            value, usual = getattr(self, known.name), f"{known.default} is usual"
            if isinstance(known.default, int):
                checked_whole(known.name, value, 1, usual)
            elif isinstance(known.default, float):
                checked_number(known.name, value, ends="[)", advice=usual)


@dataclass(frozen=True)
class DriverSettings(_Stage):
    """Which columns can drive an effect, and when a value counts as missing. All by judgement.

    Attributes:
        fewest_finite: share of finite values below which a column is left out, with a warning.
        repeats: absolute correlation above which a column repeats a measured column and is left out.
        wild: distance of a value from the others, in ranges of all other values, above which it counts as missing.
        wild_share: largest share of wild samples; with more, none counts as missing.
        wild_in_a_row: largest number of consecutive wild samples, unless all wild values are equal, as a code for
            "no value" is.
    """

    fewest_finite: float = 0.5
    repeats: float = 0.995
    wild: float = 50.0
    wild_share: float = 5e-3
    wild_in_a_row: int = 3


@dataclass(frozen=True)
class NoiseSettings(_Stage):
    """Which samples count, and the noise models for the tests of effects. By judgement, unless a reason is given.

    Attributes:
        domain: half-width of the density's domain, relative to that of a rough fit of the simulation without effects;
            all models share it, so it has to hold with any effect.
        rejected_below: MKC weight below which a residual is rejected.
        far: robust standard deviations from the drift beyond which a residual is rejected. With many outliers at five
            of them, the most likely density is so wide that most outliers would count, and bursts of one sign look
            like a drift: seen on generated recordings.
        neighbours: samples to either side that form a neighbourhood.
        crowded: share of outliers in its neighbourhood above which a sample is rejected too.
        one_sided: robust standard deviations of neighbourhoods' means beyond which a whole neighbourhood is rejected,
            as in a burst of mild outliers of one sign.
        in_common: share of a channel's outliers that are outliers in other channels too, above which outliers are
            rejected in all channels.
        bursts: largest share of the residuals that bursts can make up; a larger share is missing physics.
        slow_courses: number of cosines of time that a drift consists of, in each channel; on 90 s they reach 0.67 Hz.
        plateaus: drift families in addition to the random walk. Each is a pair: the number of the cosine beyond which
            the family falls off, as a drift about a mean does; and the number up to which an added random walk is
            larger, 0 without a walk.
        walk_first: nats by which another family has to be more likely than a random walk: a free spectrum can imitate a
            walk, and then underestimates its slowest components.
        doubted_family: nats by which a family may be less likely and still widen standard errors.
        drawn_drift: nats that a drift has to gain to be part of the surrogates: half of all white noise fits a small
            drift, and p-values of white noise were too large with it.
        plausible: nats by which a spectrum may be less likely than the best and still be drawn from: as many as a
            spectrum with more numbers gains by chance.
        reported_drift: nats that a drift has to gain to be reported.
        reported_autocorrelation: sum of squared autoregression coefficients above which noise is reported as coloured.
        disturbance_gain: nats that a disturbance of a state, or slow noise of an output, has to gain to enter the noise
            model.
        max_disturbances: largest number of such disturbances.
        last_step: standard errors beyond which the final step of least squares is not taken, because the noise model
            does not fit.
    """

    domain: float = 3.0
    rejected_below: float = 0.1
    far: float = 2.6
    neighbours: int = 10
    crowded: float = 0.4
    one_sided: float = 5.0
    in_common: float = 1.0 / 3.0
    bursts: float = 1.0 / 3.0
    slow_courses: int = 120
    plateaus: tuple[tuple[float, float], ...] = ((25.0, 0.0), (25.0, 5.0))
    walk_first: float = 5.0
    doubted_family: float = 12.0
    drawn_drift: float = 2.0
    plausible: float = 6.0
    reported_drift: float = 3.0
    reported_autocorrelation: float = 0.05
    disturbance_gain: float = thresholds.DISTURBANCE
    max_disturbances: int = 2
    last_step: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for pair in self.plateaus:
            for number, least in zip(pair, ("(", "["), strict=True):
                checked_number("plateaus", number, ends=f"{least})", advice="((25.0, 0.0), (25.0, 5.0)) is usual")


@dataclass(frozen=True)
class SearchSettings(_Stage):
    """How far the search goes, and when its results are checked again. All by judgement, on generated recordings.

    Attributes:
        fewest_samples: smallest number of samples for a diagnosis.
        refitted: number of effects that are fitted jointly, the most promising at the fit without an effect.
        refitted_elsewhere: number at each other starting point, such as a fit with clipped residuals.
        parts: pieces of the recording that are fitted separately, in case a fit to all of it diverges.
        part_better: scale of the residuals of a piece, relative to the smallest scale of the fits to the whole
            recording, below which candidates are searched at the fit to that piece.
        ran_away: factor by which a parameter has grown or shrunk, from which candidates are also searched at its
            initial value.
        leading: number of joint fits whose shapes are refined; a further fit is added above the two limits below.
        third_share: limit for that fit, as a share of the best score.
        third_nats: limit for that fit, in nats.
        shapes: number of shapes tried for each of these fits.
        hidden: share of the residuals that the fit without an effect rejects and a fit with the effect does not, above
            which the rejection may hide the effect. The effect is then tested by tangents at the fit with it,
        smaller: unless the scale with the effect, relative to that without, is above this limit.
        doubted: nats beyond all surrogates up to which surrogates of other plausible noise are drawn too.
        own_noise: number of leading candidates of the screening under process noise from which models of differential
            equations are searched first.
        behind: nats behind the best first fit from which a candidate is not reshaped, added to
        behind_share: this share of the best gain. Set on a simulated cart and a servo, where such candidates ended 90
            to 430 nats behind.
        stretches: number of equal stretches in a recording.
        in_one_stretch: share of an effect's evidence above which it is localised in one stretch. If there are bursts
            of outliers elsewhere, the effect is tested without that stretch.
    """

    fewest_samples: int = 40
    refitted: int = 6
    refitted_elsewhere: int = 2
    parts: int = 2
    part_better: float = 0.8
    ran_away: float = 5.0
    leading: int = 2
    third_share: float = 0.6
    third_nats: float = 50.0
    shapes: int = 5
    hidden: float = 0.01
    smaller: float = 0.8
    doubted: float = 25.0
    own_noise: int = 5
    behind: float = 50.0
    behind_share: float = 0.5
    stretches: int = 25
    in_one_stretch: float = 0.5


@dataclass(frozen=True)
class NamingSettings(_Stage):
    """Which effect is named: penalties of candidates that can imitate others, and limits of separability.

    Akaike's and Schwarz's criteria, 1 nat and half the logarithm of the number of samples for each number, are not
    settings. Penalties are by judgement, on generated recordings.

    Attributes:
        separable: nats by which a rival has to be less likely to be distinguishable: three standard errors, because the
            squared number of standard errors is twice the nats.
        kept: share of the linear search's gain that a joint fit has to reach.
        nameless: penalty of a curve without a name, in nats: it can follow any named effect slightly better.
        over_driver: penalty of such a curve over a driver, as a share of its gain.
        over_motion: the same over the motion itself, which repeats and which all forces depend on.
        is_generalisation: penalty in nats of a form that includes named forms as special cases, as a power law includes
            drags: it can follow each of them slightly better.
        roleless: penalty of a column of unknown role, as a share of its gain: it may depend on a known driver.
        follower: the same for a column that correlates with a known driver.
        alike_columns: absolute correlation above which two columns count as correlated.
        event: penalty of an event in time that correlates with a known driver, as a share of its gain.
        alike_event: absolute correlation above which an event correlates with a driver.
        shape_clear: nats by which the coloured noise of the search has to prefer another shape, such as an onset, to
            that of the joint fit, which assumes white noise.
        shape_alike: nats within which neighbouring shapes are equivalent; the middle of them is taken.
    """

    separable: float = thresholds.SEPARABLE
    kept: float = 0.8
    nameless: float = thresholds.NAMELESS
    over_driver: float = 0.25
    over_motion: float = 0.5
    is_generalisation: float = thresholds.GENERALISATION
    roleless: float = 0.3
    follower: float = 0.95
    alike_columns: float = 0.9
    event: float = 0.05
    alike_event: float = 0.85
    shape_clear: float = 4.0
    shape_alike: float = 0.5


@dataclass(frozen=True)
class ConfirmationSettings(_Stage):
    """When a candidate counts as a finding, and when the search continues. By judgement, unless a source is named.

    Attributes:
        folds: number of folds of the held-out blocks, at least 3. Five are usual (Hastie, Tibshirani & Friedman, "The
            Elements of Statistical Learning", 2009, 7.10).
        blocks_per_fold: number of blocks per fold, spread over the recording.
        gap: share of the recording that is left out next to a held-out block; a correlation time at least.
        beyond_doubt: nats beyond all surrogates from which held-out blocks need only not to be clearly worse with a
            first finding.
        further: nats beyond all surrogates from which held-out blocks need only a positive gain for a further finding.
        screening_level: p-value of the screening after a finding above which the search ends; at least the level.
        screening_draws: number of surrogates of the screening; more make it slower.
        near: share of the recording within which two steps count as the same step.
        unrecorded: share of the level at which an unrecorded cause is reported: it is tested last, on recordings in
            which the search found nothing.
    """

    folds: int = 5
    blocks_per_fold: int = 5
    gap: float = 0.01
    beyond_doubt: float = 8.0
    further: float = 20.0
    screening_level: float = 0.1
    screening_draws: int = 49
    near: float = 0.05
    unrecorded: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        checked_whole("folds", self.folds, 3, "5 are usual")
        checked_number("unrecorded", self.unrecorded, 0.0, 1.0, advice="0.1 is usual")


@dataclass(frozen=True)
class EvidenceSettings(_Stage):
    """When the tests of evidence report or warn. By judgement, unless a source is named.

    Attributes:
        inlier: scales d of the density within which a sample enters the reported root mean squares.
        believed: weight in the final fit above which it enters them.
        shift: largest shift of a driver, as a share of the recording (Harris, bioRxiv 2020.11.29.402719).
        shift_many: share of the shifted copies with at least the same gain, above which the driver is doubted.
        low_share: share of the samples, with the lowest values of a driver, that an extrapolation is fitted to.
        low_spread: share of the driver's range that these samples have to cover.
        switched: nats that a step has to lose in some stretch after its onset to be intermittent: a lasting step loses
            c by chance with a probability below exp(-c), for independent samples.
        switched_share: share of its whole gain that it has to lose there.
        stand_in: largest p-value of the common part of a drift's axes for a column to be a proxy of its cause.
        stand_in_along: absolute cosine from which the drift has the effect's direction.
        remaining_coverage: coverage of the intervals for the gain of a smooth correction; high, to warn rarely.
        remaining_gain: nats per sample that the correction has to gain, which reduce residuals by about 1 %.
        density_off: distance of two distribution functions, times the root of the number of samples, above which a
            density is rejected: one set of samples in a thousand exceeds it (Kolmogorov); with a fitted density, far
            fewer.
        student_closer: ratio of the Student-t's distance to the density's below which a warning is given.
        white_level: share of white channels that are called correlated, half of it by either test (Ljung & Box,
            Biometrika 65, 1978; Bartlett, J. R. Stat. Soc. Suppl. 8, 1946).
        followed: share of an output's variation that the open-loop simulation has to explain for a good fit.
        useful: mean explained share over all outputs that the best model has to reach open loop, if the simulation's
            fit is poor, for a verdict other than unfit.
        correction: ratio of what the findings explain of the outputs' variation in addition, to what the simulation
            explains without them, above which signs and units are doubted: by definition, at 1 the correction is larger
            than the simulation.
        above_floor: ratio to a declared noise floor above which a residual is more than the sensor's noise, and
        far_above_floor: to an estimated noise floor, above which a residual is not explained.
        shape_level: p-value of a free curve's gain below which a name is only the nearest in the catalogue, and
        shape_nats: the gain that the curve needs beyond Schwarz's penalty of its numbers.
        disturbed: length in seconds from which a stretch of rejected samples is warned of; shorter stretches are bursts
            of outliers.
    """

    inlier: float = 3.0
    believed: float = 0.5
    shift: float = 0.25
    shift_many: float = 0.1
    low_share: float = 0.7
    low_spread: float = 0.25
    switched: float = 7.0
    switched_share: float = 0.05
    stand_in: float = 0.01
    stand_in_along: float = 0.9
    remaining_coverage: float = 0.99
    remaining_gain: float = 0.01
    density_off: float = 1.95
    student_closer: float = 0.5
    white_level: float = 0.01
    followed: float = thresholds.FOLLOWED
    useful: float = thresholds.USEFUL
    correction: float = thresholds.CORRECTION
    above_floor: float = thresholds.ABOVE_FLOOR
    far_above_floor: float = thresholds.FAR_ABOVE_FLOOR
    shape_level: float = thresholds.SHAPE_LEVEL
    shape_nats: float = thresholds.SHAPE_NATS
    disturbed: float = 0.5


@dataclass(frozen=True)
class Settings:
    """The thresholds of a diagnosis by stage; an argument of :func:`mkc_torch.diagnose`.

    The published rates of false alarms and the power hold for the defaults only; with other numbers, measure them again
    where the truth is known.

    Attributes:
        drivers: which columns can drive an effect.
        noise: which samples count, and the noise models that an effect is tested against.
        search: how far the search goes, and when its results are checked again.
        naming: which effect is named, and limits of separability.
        confirmation: when a candidate counts as a finding.
        evidence: when tests of evidence report or warn.

    Example:
        >>> from dataclasses import replace
        >>> usual = Settings()
        >>> strict = replace(usual, naming=replace(usual.naming, separable=8.0))
        >>> strict.naming.separable, strict == usual, strict.noise == usual.noise
        (8.0, False, True)
    """

    drivers: DriverSettings = DriverSettings()
    noise: NoiseSettings = NoiseSettings()
    search: SearchSettings = SearchSettings()
    naming: NamingSettings = NamingSettings()
    confirmation: ConfirmationSettings = ConfirmationSettings()
    evidence: EvidenceSettings = EvidenceSettings()

    def __post_init__(self) -> None:
        for stage in fields(self):
            kind = type(stage.default)
            name = kind.__name__
            refuse_other_type(stage.name, getattr(self, stage.name), kind, name, f"pass {name}()")


_QUICK = {"refitted": 3, "refitted_elsewhere": 1, "parts": 1, "leading": 1, "shapes": 2, "own_noise": 3}
"""Upper limits of numbers of :class:`SearchSettings` in a quick look."""


def quick_settings(settings: Settings) -> Settings:
    """Return the settings of a quick look, which refits fewer candidates.

    Example:
        >>> quick_settings(Settings()).search.own_noise
        3
    """
    search = settings.search
    return replace(settings, search=replace(search, **{k: min(v, getattr(search, k)) for k, v in _QUICK.items()}))
