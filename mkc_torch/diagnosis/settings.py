"""The numbers that decide a diagnosis, by stages, each with what it means and where it is from.

Those that set how finely something is computed (grids, orders, iterations, tolerances) stand beside their code. Gains
and differences of log-likelihood are in nats, times in seconds, shares between 0 and 1. A number without a source was
set by judgement, on the project's own generated recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_other_type

__all__ = [
    "ConfirmationSettings", "DriverSettings", "EvidenceSettings", "NamingSettings", "NoiseSettings", "SearchSettings",
    "Settings",
]  # fmt: skip


class _Stage:
    """Refuses what no number of its kind can be: whole numbers from 1, others finite and not below 0."""

    def __post_init__(self) -> None:
        for known in fields(self):  # type: ignore[arg-type]
            value, usual = getattr(self, known.name), f"{known.default} is usual"
            if isinstance(known.default, int):
                checked_whole(known.name, value, 1, usual)
            elif isinstance(known.default, float):
                checked_number(known.name, value, ends="[)", advice=usual)


@dataclass(frozen=True)
class DriverSettings(_Stage):
    """Which columns can drive an effect, and when values of one count as missing. All by judgement.

    Attributes:
        fewest_finite: share of finite values below which a column is left out, with a warning.
        repeats: correlation, of either sign, above which a column repeats a measured one and is left out.
        wild: times the range of all other values that one is off to count as missing.
        wild_share: share of the samples that may be wild; of more, none is.
        wild_in_a_row: samples in a row that may be wild, unless all wild values are the same, as a code for none is.
    """

    fewest_finite: float = 0.5
    repeats: float = 0.995
    wild: float = 50.0
    wild_share: float = 5e-3
    wild_in_a_row: int = 3


@dataclass(frozen=True)
class NoiseSettings(_Stage):
    """Which samples count, and what noise an effect is judged against. By judgement, unless a reason is named.

    Attributes:
        domain: half-width of the density's domain, over that of a rough fit of the simulation alone; all models share
            it, so it has to hold whatever an effect does to residuals.
        rejected_below: MKC weight below which a residual is rejected: it says nothing of noise or effect.
        far: robust standard deviations from the wander beyond which a residual is rejected. Where outliers five of them
            away are many, the likeliest density is so wide that most would count, and bursts of one sign pass for a
            wander: seen on generated recordings.
        neighbours: samples to either side that make up a neighbourhood.
        crowded: share of outliers in its neighbourhood above which a sample counts as one too.
        one_sided: robust standard deviations of neighbourhoods' means beyond which a neighbourhood lies to one side
            together, as the mild samples of a burst do, and is rejected.
        in_common: share of a channel's outliers that are outliers in others too, above which it is rejected in all.
        bursts: largest share of the residuals that can be bursts; what is more is physics that is not in the model yet.
        slow_courses: cosines of time that a wander is made of, in each channel; on 90 s they reach 0.67 Hz.
        plateaus: families of wander beside a random walk. Of each the number of the course beyond which it falls off,
            as a wander about a mean does, and that up to which a walk beside it is larger, 0 for none.
        walk_first: nats that another family has to gain over a random walk: beside a spectrum of any form it can pass
            for a walk, and then knows too little of its slowest courses.
        doubted_family: nats that a family may be less likely and still have a say in standard errors.
        wander_drawn: nats that a wander has to gain to be in the draws of noise: half of all white noise fits a small
            one, and p-values of white noise were too careful with it.
        plausible: nats that a colour may be less likely than the likeliest and still be drawn from: as many as one of
            more numbers gains by chance.
        told_wander: nats that a wander has to gain to be told of.
        told_colour: sum of squared autoregression coefficients above which noise is called coloured.
        pushed: nats that a push of a state, or slow noise of an output, has to gain to be in the noise of the world.
        pushes: of these at most.
        last_step: standard errors beyond which the final step of least squares is not taken, for the noise misfits.
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
    wander_drawn: float = 2.0
    plausible: float = 6.0
    told_wander: float = 3.0
    told_colour: float = 0.05
    pushed: float = 6.0
    pushes: int = 2
    last_step: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for pair in self.plateaus:
            for number, least in zip(pair, ("(", "["), strict=True):
                checked_number("plateaus", number, ends=f"{least})", advice="((25.0, 0.0), (25.0, 5.0)) is usual")


@dataclass(frozen=True)
class SearchSettings(_Stage):
    """How far the search goes, and when what it finds is doubted. All by judgement, on generated recordings.

    Attributes:
        fewest_samples: with fewer a diagnosis is refused: nothing can be said about structure.
        refitted: physics that are fitted jointly, those that promise most around the fit without an effect.
        refitted_elsewhere: the same around each other start, where residuals are clipped instead of rejected, say.
        parts: pieces of the recording that are fitted alone, for where one model over all of it runs away.
        part_better: scale of the residuals in a piece, over the smallest of the fits to all of it, below which
            candidates are sought around the fit to that piece.
        ran_away: times that a parameter has grown or shrunk, for candidates also to be sought from where it began.
        leading: joint fits whose shapes are tried, and one more if it scores
        third_share: above this share of the first one, and
        third_nats: above so many nats.
        shapes: tried of each of these.
        hidden: share of the residuals that a fit without an effect may reject and one with it may not, and
        smaller: scale with the effect over that without, which has to be above this, for the fit without it to hide
            nothing: then the effect is judged by tangents there.
        doubted: nats beyond all draws of noise up to which draws of other plausible noise are asked too.
        own_noise: leading candidates that are fitted and compared under the pushes that each of them leaves,
        behind: but for those whose first fit is so many nats behind the best one
        behind_share: and this share of what that one gains. Set on a simulated cart and a servo, where they were 90 to
            430 nats behind in the end.
        stretches: a stretch of the recording is as long as one of so many.
        in_one_stretch: share of an effect's evidence above which it lies in one stretch. If there are bursts of
            outliers elsewhere, the stretch may be another, and the effect is judged without it.
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
    """Which physics it is: handicaps of what can imitate others, and what counts as told apart.

    Akaike's and Schwarz's criteria, one nat and half the logarithm of the number of samples for each number, are no
    settings. Handicaps are by judgement, on generated recordings.

    Attributes:
        separable: nats by which a rival has to be less likely to count as told apart: three standard errors of what
            sets the two apart, whose square is twice the nats.
        kept: share of the gain that a joint fit has to keep of what the search, which is linear, promised.
        nameless: nats that a curve without a name gives: it can follow any named effect a little better.
        over_driver: share of its gain that such a curve gives over a driver.
        over_motion: the same over the motion itself, of which all forces are functions, and which repeats itself.
        is_generalisation: nats that a form gives which has named ones as special cases, as a power law has drags: it can follow
            any of them a little better.
        roleless: share of its gain that a column of unknown role gives: it may be a consequence of a known driver.
        follower: the same where it goes along with a known driver.
        alike_columns: correlation, of either sign, above which columns go along.
        event: share of its gain that an event in time gives where it goes along with a known driver.
        alike_event: correlation, of either sign, above which it does.
        shape_clear: nats by which the noise of the search has to prefer another shape, an onset say, to that of the
            joint fit, which takes noise for white.
        shape_alike: nats within which neighbouring shapes are not told apart; the middle one is taken.
    """

    separable: float = 4.5
    kept: float = 0.8
    nameless: float = 10.0
    over_driver: float = 0.25
    over_motion: float = 0.5
    is_generalisation: float = 5.0
    roleless: float = 0.3
    follower: float = 0.95
    alike_columns: float = 0.9
    event: float = 0.05
    alike_event: float = 0.85
    shape_clear: float = 4.0
    shape_alike: float = 0.5


@dataclass(frozen=True)
class ConfirmationSettings(_Stage):
    """When what was located counts as a finding, and when the search goes on. By judgement, unless a source is named.

    Attributes:
        folds: of the held-out blocks, at least 3. Five are usual (Hastie, Tibshirani & Friedman, "The Elements of
            Statistical Learning", 2009, 7.10).
        blocks_per_fold: blocks of a fold, all over the recording.
        gap: share of the recording that is left out beside a held-out block; a correlation time at least.
        beyond_doubt: nats beyond all draws of noise from which unseen blocks need only not to be clearly worse with a
            first finding.
        further: nats beyond all draws from which they need only to lean the way of a further one.
        quiet: p-value of a first look beside a finding above which nothing further is searched; at least the level.
        glance: draws of noise of a first look; more make it slower.
        near: share of the recording within which a step is the one found before.
        unrecorded: share of the level at which a cause that was not recorded is told: the question is asked last, of
            recordings in which the search found nothing.
    """

    folds: int = 5
    blocks_per_fold: int = 5
    gap: float = 0.01
    beyond_doubt: float = 8.0
    further: float = 20.0
    quiet: float = 0.1
    glance: int = 49
    near: float = 0.05
    unrecorded: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        checked_whole("folds", self.folds, 3, "5 are usual")
        checked_number("unrecorded", self.unrecorded, 0.0, 1.0, advice="0.1 is usual")


@dataclass(frozen=True)
class EvidenceSettings(_Stage):
    """What is warned of beside a finding, and when a test says anything. By judgement, unless a source is named.

    Attributes:
        inlier: scales d of the density within which a sample is in the root mean squares that are reported, and
        believed: the weight in the final fit above which it is.
        shift: share of the recording by which a driver is shifted at most (Harris, bioRxiv 2020.11.29.402719).
        shift_many: share of the copies that gain as much, above which the driver is doubted.
        low_share: share of the samples, with the lowest values of a driver, that an extrapolation is fitted to.
        low_spread: share of the driver's range that they have to cover.
        switched: nats that a step has to lose in some stretch after its onset to come and go: one that
            lasts loses c by chance with a probability below exp(-c), where samples are independent.
        switched_share: share of its whole gain that it has to lose there.
        stand_in: p-value of what a wander's axes have in common, up to which a column may stand in for its cause.
        stand_in_along: cosine, of either sign, from which the wander goes along the effect's direction.
        remaining_coverage: of the intervals by which a smooth correction is better; a warning is to be rare.
        remaining_gain: nats a sample that it has to gain, which makes residuals smaller by about a hundredth.
        density_off: distance of two distribution functions, times the root of the number of samples, above which a
            density is off: one set of samples in a thousand is (Kolmogorov); of a density that was fitted, far fewer.
        student_closer: share of the density's distance that a Student-t's has to be below for a warning.
        white_level: share of white channels that are called correlated, half of it by either criterion (Ljung & Box,
            Biometrika 65, 1978; Bartlett, J. R. Stat. Soc. Suppl. 8, 1946).
        followed: share of an output's variation that a free run has to explain to follow it at all.
        useful: share of all outputs' variation, each by its own, that the best model's free run has to explain for a
            simulation that does not follow to be judged at all.
        above_floor: times a declared noise floor above which a residual is more than the sensor's noise.
        shape_level: chance with which a free curve is as much better where a name's shape is right, below which the
            name is but the nearest in the catalogue, and
        shape_nats: what the curve has to gain beyond Schwarz's price of its numbers.
        disturbed: seconds from which a stretch of rejected samples is warned of; shorter ones are bursts of outliers.
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
    followed: float = 0.5
    useful: float = 0.35
    above_floor: float = 1.5
    shape_level: float = 0.001
    shape_nats: float = 6.0
    disturbed: float = 0.5


@dataclass(frozen=True)
class Settings:
    """The numbers that decide, by the stages of a diagnosis; an argument of :func:`mkc_torch.diagnose`.

    Others than those given void what was measured of false alarms and power: measure again where the truth is known.

    Attributes:
        drivers: which columns can drive an effect.
        noise: which samples count, and what noise an effect is judged against.
        search: how far the search goes, and when what it finds is doubted.
        naming: which physics it is, and what counts as told apart.
        confirmation: when what was located counts as a finding.
        evidence: what is warned of beside a finding.

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
            refuse_other_type(stage.name, getattr(self, stage.name), kind, name, f"pass one, {name}()")


_QUICK = {"refitted": 3, "refitted_elsewhere": 1, "parts": 1, "leading": 1, "shapes": 2, "own_noise": 3}
"""Most that a quick look refits, of each number of :class:`SearchSettings`."""


def quick_settings(settings: Settings) -> Settings:
    """The same for a quick look, which refits fewer candidates.

    Example:
        >>> quick_settings(Settings()).search.own_noise
        3
    """
    search = settings.search
    return replace(settings, search=replace(search, **{k: min(v, getattr(search, k)) for k, v in _QUICK.items()}))
