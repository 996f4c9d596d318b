"""Joint selection of noise and physics: the gain of each candidate if every model has its own most likely noise.

Under the noise that is most likely without a candidate, process noise can explain nearly all that the candidate does.
So the likelihoods with and without a candidate are maximised over the same noise models, for the recording and for
surrogates alike. A candidate's gain then includes the fall in process noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.quantum import rounding_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.likelihoods import PRICE, Columns, Limits, LogLikelihoods, log_likelihoods
from mkc_torch.diagnosis.search.significance import COUNTS, COUNTS_NOT, best_rank_p_value
from mkc_torch.diagnosis.search.significance import price as price_of_candidate
from mkc_torch.diagnosis.search.tangents import ModelTangents, open_loop_tangents
from mkc_torch.diagnosis.thresholds import NULL_WITHIN
from mkc_torch.simulation.dynamics.flow import flow_of, plausible_sizes
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid, key_of
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Observable, Observer, clipped_slope
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.whitening import SeriesAlong, gains_of, joined, relative_to, whitened

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_STEPS = (0.5, 0.5, 0.25, 0.25, 0.125)
"""Decades by which sizes and times of the leading noise models are varied, round by round."""

_PAIRED = 2
"""Number of rounds in which a second disturbance is added to leading models."""

_LEADING = 6
"""Number of effects whose noise is refined."""

_SETTLED = 0.1
"""Nats that some likelihood has to gain in a round for another round."""

_KINDS = 3
"""Largest number of kinds of noise for surrogates."""

_USUAL = 0.9
"""Quantile of a candidate's gains over surrogates that is subtracted from its gain."""

_FIRST_DRAWS = 19
"""Surrogates of the first round."""

_FAR_BEHIND = 100.0
"""Nats behind the most likely noise of the recording, without and with every candidate, beyond which a kind of noise is
left out of the surrogates' search."""

_HOPELESS = 30.0
"""The same for the surrogates of the first round, and the recording, in the second round."""

_ENOUGH = 6
"""Surrogates that reach the recording's gain from which no second round is drawn."""


@dataclass(frozen=True)
class JointStart:
    """Start of a candidate's joint fit: its sizes, the shift of the parameters, and the observer of its noise."""

    gamma: Float[Tensor, " q"]
    shift: Float[Tensor, " p"]
    observer: Observer | None


@dataclass(frozen=True)
class JointLikelihood:
    """The gains of the candidates.

    Attributes:
        gain: (C,), in nats, over the simulation without a candidate, each under its most likely noise.
        dof: (C,), numbers of each.
        p_value: of the strongest candidate after the whole search, the largest over the kinds of noise.
        beyond: nats by which it exceeds the strongest surrogate.
        needed: (C,), gains in nats at which the p-value would equal the level.
        noise: the most likely noise with each candidate.
        scene: the linearised recording.
    """

    gain: Float[Tensor, " C"]
    dof: Float[Tensor, " C"]
    p_value: float
    beyond: float
    needed: Float[Tensor, " C"]
    noise: tuple[NoiseModel, ...]
    scene: _LinearisedRecording

    @property
    def longer(self) -> float:
        """Ratio by which a recording has to be longer for the strongest candidate to reach the level, if it is real."""
        number = int((self.gain - self.needed).argmax())
        gain, needed = float(self.gain[number]), float(self.needed[number])
        return needed / gain if gain > 0.0 else torch.inf

    def start(self, number: int) -> JointStart:
        """Return the start of a candidate's joint fit."""
        return self.scene.start(number, self.noise[number])


@dataclass(frozen=True)
class _LinearisedRecording:
    """The linearised recording: its flow, with all samples and with those that count, its series and the tangents."""

    prepared: Observable
    flow: Flow
    counted: Flow
    series: SeriesAlong
    columns: Columns
    largest: Float[np.ndarray, " p+m"]
    price: float

    def likelihoods(self, models: Sequence[NoiseModel]) -> LogLikelihoods:
        """Return the recording's log-likelihoods under noise models."""
        return log_likelihoods(
            self.counted,
            models,
            self.series,
            self.columns,
            self.largest,
            "part of the kinds of noise",
            price=self.price,
        )

    def with_draws(self, near: LogLikelihoods, draws: SeriesAlong) -> LogLikelihoods:
        """Return the log-likelihoods of the recording and of surrogates under the models of an earlier result."""
        series, thing = joined(self.series, draws), "part of the draws under noise"
        return log_likelihoods(
            self.counted, near.models, series, self.columns, self.largest, thing, near.products, self.price
        )

    def residual(self, number: int | None, model: NoiseModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the whitened recording given a candidate (N, m), the candidate's sizes and the parameters' shift."""
        gains = gains_of(self.counted, filter_models(self.counted, [model]))
        [(_, values)] = whitened(self.counted, gains, joined(self.series, self.columns.series))
        used, p = self.counted.counts > 0, self.columns.parameters
        y, own = values[used][:, 0], values[used][:, 1:][:, :p]
        place = slice(p, p) if number is None else self.columns.places(number)
        both = np.concatenate([own, values[used][:, 1:][:, place]], 1)
        norm = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
        solved = np.linalg.lstsq(both / norm, y, rcond=1e-9)[0]
        left = np.zeros(used.shape)
        left[used] = y - both / norm @ solved
        return left, -(solved / norm)[p:], -(solved / norm)[:p]

    def start(self, number: int, model: NoiseModel) -> JointStart:
        left, gamma, shift = self.residual(number, model)
        used = self.counted.counts > 0
        scale = 1.0 if any(model.known) else max(float(np.sqrt(np.square(left[used]).mean())), model.least_scale)
        names, channels = self.prepared.disturbable, self.prepared.channels
        like = self.prepared.measured
        disturbances = model.disturbances(names, channels, scale)
        sensor = like.new_tensor([scale * size for size in model.sensor])
        observer = observer_of(self.flow, disturbances, sensor, names, channels)
        return JointStart(like.new_tensor(gamma), like.new_tensor(shift), observer)


def joint_likelihood(
    base: FittedModel,
    terms: Sequence[Term],
    tangents: ModelTangents,
    counts: Float[Tensor, "N m"],
    draws: int,
    generator: torch.Generator,
    *,
    level: float,
    declared: Sequence[bool] = (),
    quick: bool = False,
    price: float = PRICE,
) -> JointLikelihood | None:
    """Search the candidates at a fit of differential equations; None if its trajectory is lost.

    Args:
        base: the fit whose trajectory is linearised.
        terms: candidates.
        tangents: of the fit's parameters and the candidates.
        counts: mask of the fit's residual.
        draws: number of surrogates for each kind of noise.
        generator: of the surrogates.
        level: rate of false alarms.
        declared: for each output whether its white noise is declared.
        quick: draw no surrogates; there is an effect if a candidate gains more than its penalty.
        price: nats that a disturbance has to gain to enter the noise model.
    """
    scene = _scene(base, terms, tangents, counts, price)
    if scene is None:
        return None
    prepared = scene.prepared
    observer = prepared.observer
    names, channels = prepared.disturbable, prepared.channels
    size = base.residual.square().mul(counts).sum(0).div(counts.sum(0).clamp(min=1.0)).sqrt()
    sensor = (size if observer is None else observer.sensor).tolist()
    known_noise = tuple(declared) or (False,) * len(channels)
    steps = rounding_of(prepared.measured).tolist()
    rounding = [0.0 if is_known else step for is_known, step in zip(known_noise, steps, strict=True)]
    sensor = [max(size, step, 1e-300) for size, step in zip(sensor, rounding, strict=True)]
    white = NoiseModel(tuple(sensor), (), known_noise, tuple(rounding))
    grid = NoiseGrid(scene.counted, white)
    disturbances = () if observer is None else observer.disturbances
    known = [NoiseModel.of(disturbances, sensor, names, channels, known_noise, rounding)] if disturbances else []
    keys = [term.key for term in terms]
    found = _refined(scene, grid, [model for model in known if grid.plausible(model)], keys)
    without = found.without[:, 0]
    best = int(without.argmax())
    gains = found.with_candidate[:, :, 0].max(0) - without[best]
    strongest = int((gains - found.rank).argmax())
    left, *_ = scene.residual(strongest, found.models[int(found.with_candidate[:, strongest, 0].argmax())])
    p_value, beyond, needed = 0.0, np.inf, np.zeros(len(terms))
    if quick:
        samples, tried = int(scene.counted.counts.sum()), len(set(keys))
        needed = np.array([price_of_candidate(rank, samples, tried) for rank in found.rank])
        p_value = COUNTS if bool((gains > needed).any()) else COUNTS_NOT
    for kind in () if quick else _kinds(found):
        of_kind = _surrogate_test(scene, found, kind, left, draws, generator, level)
        if of_kind[0] >= p_value:
            p_value, needed = of_kind[0], np.maximum(needed, of_kind[2])
        beyond = min(beyond, of_kind[1])
        if p_value > level:
            break
    return JointLikelihood(
        torch.from_numpy(gains),
        torch.from_numpy(found.rank),
        p_value,
        float(beyond),
        torch.from_numpy(needed),
        tuple(found.models[int(number)] for number in found.with_candidate[:, :, 0].argmax(0)),
        scene,
    )


def _scene(
    base: FittedModel, terms: Sequence[Term], tangents: ModelTangents, counts: Tensor, price: float
) -> _LinearisedRecording | None:
    model, prepared = base.model, base.model.prepared.dynamics
    if prepared is None:
        return None
    flow = flow_of(prepared, base.parameters[: model.base], model.changes(base.parameters), model.near)
    if flow is None or not all(
        np.isfinite(values).all() for values in (flow.transition, flow.seen, flow.new, flow.shift)
    ):
        return None
    counted = replace(flow, counts=flow.counts * counts.double().cpu().numpy())
    moved, free = _with_open_loop(base, terms, tangents)
    series = SeriesAlong(flow.new[..., None], flow.shift[..., None])
    columns = Columns(
        _along(flow, prepared, base.residual, moved, free),
        model.size,
        tuple(columns.shape[-1] for columns in tangents.candidates),
        tuple(term.effect.one_sided for term in terms),
        _limits(base),
    )
    theta, changes = base.parameters[: model.base], model.changes(base.parameters)
    largest = plausible_sizes(prepared, theta, changes, model.near)
    return _LinearisedRecording(prepared, flow, counted, series, columns, largest, price)


def _with_open_loop(
    base: FittedModel, terms: Sequence[Term], tangents: ModelTangents
) -> tuple[Float[np.ndarray, "N m K"], Bool[np.ndarray, " K"]]:
    """Return the tangents of parameters and candidates, and which of them are of the open loop next to an observer."""
    observed = base.model.prepared.observer is not None
    alone = [observed and term.effect.open_loop_only for term in terms]
    chosen = [term for term, is_alone in zip(terms, alone, strict=True) if is_alone]
    found = iter(open_loop_tangents(base.model, base.parameters, chosen))
    columns = [next(found) if is_alone else own for own, is_alone in zip(tangents.candidates, alone, strict=True)]
    moved = torch.cat([tangents.nuisance, *columns], -1).double().cpu().numpy()
    free = [is_alone for own, is_alone in zip(columns, alone, strict=True) for _ in range(own.shape[-1])]
    return moved, np.array([False] * tangents.nuisance.shape[-1] + free)


def _limits(base: FittedModel) -> Limits | None:
    """Return the priors of the simulation's own parameters; None without."""
    prior = base.model.prior
    if prior is None:
        return None
    return Limits.of(*(values.double().cpu().numpy() for values in (base.parameters, prior.mean, prior.precision)))


def _along(
    flow: Flow,
    prepared: PreparedDynamics,
    residual: Tensor,
    moved: Float[np.ndarray, "N m K"],
    free: Bool[np.ndarray, " K"],
) -> SeriesAlong:
    """Return tangents of a residual as series along its trajectory; those that are ``free`` are of the open loop."""
    observer = prepared.observer
    plain = SeriesAlong(moved, np.zeros((len(moved) - 1, flow.transition.shape[1], moved.shape[-1])))
    if observer is None:
        return plain
    back = torch.linalg.inv(observer.white)
    slope = clipped_slope(torch.einsum("nij,nj->ni", back, residual), observer.spread)
    names, channels = prepared.disturbable, prepared.channels
    model = NoiseModel.of(observer.lasting, observer.sensor.tolist(), names, channels)
    found = relative_to(
        flow,
        observer.gain.double().cpu().numpy(),
        np.array([place for place, _, _ in model.components], dtype=int),
        np.array([lasting for _, _, lasting in model.components]),
        back.double().cpu().numpy() @ moved,
        slope.double().cpu().numpy(),
    )
    return SeriesAlong(np.where(free, plain.new, found.new), np.where(free, plain.shift, found.shift))


def _refined(
    scene: _LinearisedRecording, grid: NoiseGrid, more: Sequence[NoiseModel], keys: Sequence[object]
) -> LogLikelihoods:
    """Evaluate the grid, then refine the most likely noise without a candidate and with each leading candidate."""
    singles = grid.singles()
    found = scene.likelihoods([*singles, *more])
    have = {key_of(model) for model in found.models}
    for number, decades in enumerate(_STEPS):
        leading = _leading(found, keys)
        before = _largest(found)
        tried: list[NoiseModel] = []
        for place in leading:
            model = found.models[place]
            others = grid.neighbours(model, decades)
            if number < _PAIRED and len(model.components) == 1:
                others += grid.pairs(model, singles)
            for other in others:
                if key_of(other) not in have:
                    have.add(key_of(other))
                    tried.append(other)
        if not tried:
            break
        found = found.and_more(scene.likelihoods(tried))
        if number >= _PAIRED and float((_largest(found) - before).max()) < _SETTLED:
            break
    return found


def _largest(found: LogLikelihoods) -> np.ndarray:
    return np.concatenate([found.without[:, 0].max(0, keepdims=True), found.with_candidate[:, :, 0].max(0)])


def _leading(found: LogLikelihoods, keys: Sequence[object]) -> list[int]:
    """Return the noise models that are most likely without a candidate, or with a leading candidate."""
    leading = [int(found.without[:, 0].argmax())]
    best = found.with_candidate[:, :, 0].max(0) - found.rank
    seen: set[object] = set()
    for number in np.argsort(-best):
        if keys[number] in seen:
            continue
        seen.add(keys[number])
        leading.append(int(found.with_candidate[:, number, 0].argmax()))
        if len(seen) == _LEADING:
            break
    return list(dict.fromkeys(leading))


def _kinds(found: LogLikelihoods) -> list[int]:
    """Return the most likely model of each plausible kind of noise without a candidate."""
    values = found.without[:, 0]
    kinds: dict[object, int] = {}
    for number in np.argsort(-values):
        if values[number] < values.max() - NULL_WITHIN or len(kinds) == _KINDS:
            break
        kind = tuple(sorted((place, lasting > 0.0) for place, _, lasting in found.models[number].components))
        kinds.setdefault(kind, int(number))
    return list(kinds.values())


def _surrogate_test(
    scene: _LinearisedRecording,
    found: LogLikelihoods,
    kind: int,
    left: Float[np.ndarray, "N m"],
    draws: int,
    generator: torch.Generator,
    level: float,
) -> tuple[float, float, Float[np.ndarray, " C"]]:
    """Return the p-value, nats beyond all surrogates, and the gains whose p-value would equal the level.

    Surrogates follow a noise model, with the sizes of the innovations given the strongest candidate, so that they do
    not contain the missing effect; each innovation has a random sign. Two statistics are compared, the largest gain
    with each candidate's own noise and the largest gain in the open loop, and the p-value is that of the better rank:
    process noise can follow one sample ahead what only physics follows in the open loop.
    """
    gained, free = np.zeros((len(found.rank), 0)), np.zeros((len(found.rank), 0))
    own = found.with_candidate[:, :, 0].max(0) - found.without[:, 0].max()
    own_free = found.with_candidate[0, :, 0] - found.without[0, 0]
    near = found.near_the_best(_FAR_BEHIND)
    for count in (min(_FIRST_DRAWS, draws), draws - min(_FIRST_DRAWS, draws)):
        if not count:
            break
        some = scene.with_draws(near, noise_surrogates(scene, found.models[kind], left, count, generator))
        near = some.near_the_best(_HOPELESS)
        drawn = some.with_candidate[:, :, 1:].max(0) - some.without[:, 1:].max(0)
        gained = np.concatenate([gained, drawn], 1)
        free = np.concatenate([free, some.with_candidate[0, :, 1:] - some.without[0, 1:]], 1)
        here, strongest, usual = _beyond_usual(own, gained)
        here_free, strongest_free, _ = _beyond_usual(own_free, free)
        as_much = min(int((strongest >= here).sum()), int((strongest_free >= here_free).sum()))
        if as_much >= _ENOUGH:
            break
    needed = usual + np.quantile(strongest, 1.0 - level)
    ranked = [torch.from_numpy(np.concatenate([[a], b])) for a, b in ((here, strongest), (here_free, strongest_free))]
    return best_rank_p_value(*ranked), here - float(strongest.max()), needed


def _beyond_usual(
    own: Float[np.ndarray, " C"], drawn: Float[np.ndarray, "C S"]
) -> tuple[float, Float[np.ndarray, " S"], Float[np.ndarray, " C"]]:
    """Return the largest gain beyond what each candidate usually gains: for recording and surrogates; and the usual."""
    usual = np.quantile(drawn, _USUAL, axis=1, keepdims=True)
    return float((own - usual[:, 0]).max()), (drawn - usual).max(0), usual[:, 0]


def noise_surrogates(
    scene: _LinearisedRecording,
    model: NoiseModel,
    left: Float[np.ndarray, "N m"],
    count: int,
    generator: torch.Generator,
) -> SeriesAlong:
    flow, used = scene.counted, scene.counted.counts > 0
    gains = gains_of(flow, filter_models(flow, [model]))
    scale = 1.0 if any(model.known) else np.sqrt(np.square(left[used]).mean())
    sign = 2.0 * torch.randint(2, (*left.shape, count), generator=generator).numpy() - 1.0
    # a masked sample has an innovation of 0
    back = np.linalg.inv(gains.white[:, 0] + np.eye(left.shape[1]) * ~used[:, :, None])
    innovations = back @ (sign * (left / scale)[..., None]) * used[..., None]
    models = gains.models
    return relative_to(flow, gains.gain[:, 0], models.place[0], models.lasting[0], innovations)
