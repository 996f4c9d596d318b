"""Noise and physics chosen together: what each candidate gains when every model has the noise that suits it best.

Under the noise that is likeliest without a candidate, nearly all that the candidate does can be process noise. So the
likelihood with a candidate and that without are each the largest over the same models of the noise, for the recording
and for draws alike. A candidate's gain counts how far the disturbance falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.quantum import rounding_of
from mkc_torch.diagnosis.linearised.tangents import ModelTangents
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.likelihoods import Columns, LogLikelihoods, log_likelihoods
from mkc_torch.diagnosis.search.quick import COUNTS, COUNTS_NOT, price
from mkc_torch.simulation.dynamics.flow import flow_of, plausible_sizes
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid, key_of
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Observable, Observer, clipped_slope
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.whitening import SeriesAlong, gains_of, joined, relative_to, whitened

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["JointLikelihood", "JointStart", "joint_likelihood"]

_STEPS = (0.5, 0.5, 0.25, 0.25, 0.125)
"""Decades by which sizes and times of the leading models of the noise are varied, round after round."""

_PAIRED = 2
"""Rounds in which a second disturbance is tried beside that of a leading model."""

_LEADING = 6
"""Candidate physics whose noise is refined."""

_SETTLED = 0.1
"""Nats that a round has to gain for some of them, for another one to follow."""

_NULL_WITHIN = 6.0
"""Nats behind the likeliest within which another kind of noise is drawn from too."""

_KINDS = 3
"""Kinds of noise that are drawn from at most."""

_USUAL = 0.9
"""Quantile of a candidate's gains over draws that its gain is counted from."""

_FIRST_DRAWS, _ENOUGH = 19, 6
"""Draws after which the p-value is clear where so many of them come up to the recording."""


@dataclass(frozen=True)
class JointStart:
    """Where the joint fit of a candidate begins: its sizes, how far the parameters move, and its noise's observer."""

    gamma: Float[Tensor, " q"]
    shift: Float[Tensor, " p"]
    observer: Observer | None


@dataclass(frozen=True)
class JointLikelihood:
    """What candidates gain.

    Attributes:
        gain: (C,), in nats, over the simulation without one, each under its likeliest noise.
        dof: (C,), numbers of each.
        p_value: of the strongest, after the whole search, the largest over the kinds of noise drawn from.
        beyond: nats by which it is beyond the strongest of the draws.
        needed: (C,), nats at which each would have a p-value of the level.
        noise: of each candidate, its likeliest noise; ``without``, that of the simulation alone.
        scene: what the numbers are computed from.
    """

    gain: Float[Tensor, " C"]
    dof: Float[Tensor, " C"]
    p_value: float
    beyond: float
    needed: Float[Tensor, " C"]
    noise: tuple[NoiseModel, ...]
    without: NoiseModel
    scene: _LinearisedRecording

    @property
    def longer(self) -> float:
        """Times as long a recording has to be for its strongest candidate to reach the level, if it is there."""
        number = int((self.gain - self.needed).argmax())
        gain, needed = float(self.gain[number]), float(self.needed[number])
        return needed / gain if gain > 0.0 else torch.inf

    def start(self, number: int) -> JointStart:
        """Where the joint fit of a candidate begins."""
        return self.scene.start(number, self.noise[number])


@dataclass(frozen=True)
class _LinearisedRecording:
    """The linearised recording: its flow, with all samples and with those that count, its series, the columns."""

    prepared: Observable
    flow: Flow
    counted: Flow
    series: SeriesAlong
    columns: Columns
    largest: Float[np.ndarray, " p+m"]

    def likelihoods(self, models: Sequence[NoiseModel], draws: SeriesAlong | None = None) -> LogLikelihoods:
        series = self.series if draws is None else joined(self.series, draws)
        thing = "kind of noise" if draws is None else "draws under noise"
        return log_likelihoods(self.counted, models, series, self.columns, self.largest, thing)

    def residual(self, number: int | None, model: NoiseModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The recording whitened beside a candidate (N, m), the candidate's sizes and the parameters' shift."""
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
        names, channels = self.prepared.pushable, self.prepared.channels
        like = self.prepared.measured
        disturbances = model.disturbances(names, channels, scale)
        sensor = like.new_tensor([scale * one for one in model.sensor])
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
) -> JointLikelihood | None:
    """The search beside a fit of differential equations; None where its trajectory is lost.

    Args:
        base: the fit, along whose trajectory all is linear.
        terms: candidates.
        tangents: of the fit's parameters and the candidates.
        counts: what counts of the fit's residual.
        draws: of each kind of noise.
        generator: of the draws.
        level: of false alarms.
        declared: of each output whether its white noise is declared.
        quick: draw nothing; there is an effect if any candidate gains more than its price.
    """
    scene = _scene(base, terms, tangents, counts)
    if scene is None:
        return None
    prepared = scene.prepared
    observer = prepared.observer
    names, channels = prepared.pushable, prepared.channels
    size = base.residual.square().mul(counts).sum(0).div(counts.sum(0).clamp(min=1.0)).sqrt()
    sensor = (size if observer is None else observer.sensor).tolist()
    told = tuple(declared) or (False,) * len(channels)
    rounding = [0.0 if one else step for one, step in zip(told, rounding_of(prepared.measured).tolist(), strict=True)]
    sensor = [max(one, step, 1e-300) for one, step in zip(sensor, rounding, strict=True)]
    white = NoiseModel(tuple(sensor), (), told, tuple(rounding))
    grid = NoiseGrid(scene.counted, white)
    pushes = () if observer is None else observer.disturbances
    known = [NoiseModel.of(pushes, sensor, names, channels, told, rounding)] if pushes else []
    keys = [term.key for term in terms]
    found = _refined(scene, grid, [one for one in known if grid.plausible(one)], keys)
    without = found.without[:, 0]
    best = int(without.argmax())
    gains = found.beside[:, :, 0].max(0) - without[best]
    strongest = int((gains - found.rank).argmax())
    left, *_ = scene.residual(strongest, found.models[int(found.beside[:, strongest, 0].argmax())])
    p_value, beyond, needed = 0.0, np.inf, np.zeros(len(terms))
    if quick:
        samples, tried = int(scene.counted.counts.sum()), len(set(keys))
        needed = np.array([price(one, samples, tried) for one in found.rank])
        p_value = COUNTS if bool((gains > needed).any()) else COUNTS_NOT
    for kind in () if quick else _kinds(found):
        one = _judged(scene, found, kind, left, draws, generator, level)
        if one[0] >= p_value:
            p_value, needed = one[0], np.maximum(needed, one[2])
        beyond = min(beyond, one[1])
        if p_value > level:
            break
    return JointLikelihood(
        torch.from_numpy(gains),
        torch.from_numpy(found.rank),
        p_value,
        float(beyond),
        torch.from_numpy(needed),
        tuple(found.models[int(number)] for number in found.beside[:, :, 0].argmax(0)),
        found.models[best],
        scene,
    )


def _scene(
    base: FittedModel, terms: Sequence[Term], tangents: ModelTangents, counts: Tensor
) -> _LinearisedRecording | None:
    prepared, model = base.model.prepared, base.model
    assert isinstance(prepared, PreparedDynamics)
    flow = flow_of(prepared, base.parameters[: model.base], model.changes(base.parameters), model.near)
    if flow is None or not all(np.isfinite(one).all() for one in (flow.carried, flow.seen, flow.new, flow.shift)):
        return None
    counted = replace(flow, counts=flow.counts * counts.double().cpu().numpy())
    moved = torch.cat([tangents.nuisance, *tangents.candidates], -1).double().cpu().numpy()
    series = SeriesAlong(flow.new[..., None], flow.shift[..., None])
    columns = Columns(
        _along(flow, prepared, base.residual, moved),
        model.size,
        tuple(one.shape[-1] for one in tangents.candidates),
        tuple(term.effect.one_sided for term in terms),
    )
    theta, changes = base.parameters[: model.base], model.changes(base.parameters)
    largest = plausible_sizes(prepared, theta, changes, model.near)
    return _LinearisedRecording(prepared, flow, counted, series, columns, largest)


def _along(flow: Flow, prepared: PreparedDynamics, residual: Tensor, moved: Float[np.ndarray, "N m K"]) -> SeriesAlong:
    """Tangents of a residual as series along its trajectory."""
    observer = prepared.observer
    if observer is None:
        return SeriesAlong(moved, np.zeros((len(moved) - 1, flow.carried.shape[1], moved.shape[-1])))
    back = torch.linalg.inv(observer.white)
    slope = clipped_slope(torch.einsum("nij,nj->ni", back, residual), observer.spread)
    names, channels = prepared.pushable, prepared.channels
    model = NoiseModel.of(observer.lasting, observer.sensor.tolist(), names, channels)
    return relative_to(
        flow,
        observer.gain.double().cpu().numpy(),
        np.array([place for place, _, _ in model.pushes], dtype=int),
        np.array([lasting for _, _, lasting in model.pushes]),
        back.double().cpu().numpy() @ moved,
        slope.double().cpu().numpy(),
    )


def _refined(
    scene: _LinearisedRecording, grid: NoiseGrid, more: Sequence[NoiseModel], keys: Sequence[object]
) -> LogLikelihoods:
    """Over the grid, and around the likeliest noise of the simulation alone and beside each leading candidate."""
    singles = grid.singles()
    found = scene.likelihoods([*singles, *more])
    have = {key_of(one) for one in found.models}
    for number, decades in enumerate(_STEPS):
        leading = _leading(found, keys)
        before = _largest(found)
        tried: list[NoiseModel] = []
        for place in leading:
            model = found.models[place]
            others = grid.neighbours(model, decades)
            if number < _PAIRED and len(model.pushes) == 1:
                others += grid.pairs(model, singles)
            for one in others:
                if key_of(one) not in have:
                    have.add(key_of(one))
                    tried.append(one)
        if not tried:
            break
        found = found.and_more(scene.likelihoods(tried))
        if number >= _PAIRED and float((_largest(found) - before).max()) < _SETTLED:
            break
    return found


def _largest(found: LogLikelihoods) -> np.ndarray:
    return np.concatenate([found.without[:, 0].max(0, keepdims=True), found.beside[:, :, 0].max(0)])


def _leading(found: LogLikelihoods, keys: Sequence[object]) -> list[int]:
    """Models of the noise that are the likeliest without a candidate, or with one of the leading ones."""
    leading = [int(found.without[:, 0].argmax())]
    best = found.beside[:, :, 0].max(0) - found.rank
    seen: set[object] = set()
    for number in np.argsort(-best):
        if keys[number] in seen:
            continue
        seen.add(keys[number])
        leading.append(int(found.beside[:, number, 0].argmax()))
        if len(seen) == _LEADING:
            break
    return list(dict.fromkeys(leading))


def _kinds(found: LogLikelihoods) -> list[int]:
    """The likeliest model of each kind of noise that the recording may have without a candidate."""
    values = found.without[:, 0]
    kinds: dict[object, int] = {}
    for number in np.argsort(-values):
        if values[number] < values.max() - _NULL_WITHIN or len(kinds) == _KINDS:
            break
        kind = tuple(sorted((place, lasting > 0.0) for place, _, lasting in found.models[number].pushes))
        kinds.setdefault(kind, int(number))
    return list(kinds.values())


def _judged(
    scene: _LinearisedRecording,
    found: LogLikelihoods,
    kind: int,
    left: Float[np.ndarray, "N m"],
    draws: int,
    generator: torch.Generator,
    level: float,
) -> tuple[float, float, Float[np.ndarray, " C"]]:
    """The p-value, nats beyond all draws, and the gains that would have a p-value of the level.

    Draws are of a model of the noise, with the sizes that the innovations have beside the strongest candidate, so that
    what is missing is not among them, each with a sign of its own.
    """
    gained = np.zeros((len(found.rank), 0))
    own = found.beside[:, :, 0].max(0) - found.without[:, 0].max()
    for count in (min(_FIRST_DRAWS, draws), draws - min(_FIRST_DRAWS, draws)):
        if not count:
            break
        some = scene.likelihoods(found.models, _drawn(scene, found.models[kind], left, count, generator))
        drawn = some.beside[:, :, 1:].max(0) - some.without[:, 1:].max(0)
        gained = np.concatenate([gained, drawn], 1)
        usual = np.quantile(gained, _USUAL, axis=1, keepdims=True)
        strongest = (gained - usual).max(0)
        here = float((own - usual[:, 0]).max())
        as_much = int((strongest >= here).sum())
        if as_much >= _ENOUGH:
            break
    needed = usual[:, 0] + np.quantile(strongest, 1.0 - level)
    return (1.0 + as_much) / (1.0 + gained.shape[1]), here - float(strongest.max()), needed


def _drawn(
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
    # a sample that does not count has an innovation of 0
    back = np.linalg.inv(gains.white[:, 0] + np.eye(left.shape[1]) * ~used[:, :, None])
    innovations = back @ (sign * (left / scale)[..., None]) * used[..., None]
    models = gains.models
    return relative_to(flow, gains.gain[:, 0], models.place[0], models.lasting[0], innovations)
