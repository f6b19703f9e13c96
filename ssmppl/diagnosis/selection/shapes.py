"""Estimates of shapes: the threshold of a stop, the period of a forcing, a disturbance's memory.

The screen tries a few values of each shape, which is enough to see an effect, and too few to
predict with it: a period that is off by a quarter of a turn over the record is out of step
afterwards. So the leading refits are fitted once more with their shapes as parameters, each between
bounds that the effect declares; whole numbers, as those of the rows of a delay, are tried one by
one from the best on, in the direction that gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import SHORTEST, Candidate
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels, range_fraction
from ssmppl.diagnosis.fitting.fit import Fit
from ssmppl.diagnosis.model.scales import Scales, value_of
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import child_seed
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.refit import Refit, effort_for
from ssmppl.diagnosis.selection.simulation_fit import fit_for_simulation
from ssmppl.errors import SSMError

SHAPED = 4  # refits at most
SHAPED_CALLED = 2  # likewise, of a model that calls a simulator
WITHIN, SHARE = 15.0, 0.4  # so many nats behind the best, or with so much of what it gains
PRICE = 1.0  # nats that a shape has to gain: one for a parameter (Akaike 1974)
INSIDE = 0.02  # share of the range from either bound where a fit starts
FURTHEST = 4.0  # of the largest whole number that a screen tries


def shape_bounds(c: Candidate, scales: Scales) -> dict[str, tuple[float, float]]:
    """Bounds of each shape parameter that can be estimated."""
    values, out = dict(c.shape), {}
    if c.effect.profile == "wave" and {"period", "phase"} <= set(values):
        frequency, near = 1.0 / values["period"], 1.0 / scales.rows
        low = max(frequency - near, 0.5 * near)
        out["period"] = (1.0 / min(frequency + near, 1.0 / SHORTEST), 1.0 / low)
        out["phase"] = (values["phase"] - np.pi, values["phase"] + np.pi)
    for name, grid in c.effect.shapes.items():
        if grid.between is None or name in out:
            continue
        scale = scales.scale.get(c.variable(grid.of))
        low, high = (value_of(grid, v, scale, scales.rows) for v in grid.between)
        if grid.unit in ("sd", "size"):  # a width of nothing would be another effect
            least = min(value_of(grid, v, scale, scales.rows) for v in grid.values)
            low = max(low, 0.5 * least)
        if low < values[name] < high:
            out[name] = (low, high)
    return out


def lengths(c: Candidate) -> dict[str, int]:
    """Its shapes that are whole numbers: of an auxiliary state's components."""
    names = [n for n in c.effect.states.values() if n is not None]
    return {n: int(dict(c.shape)[n]) for n in names} if not c.held else {}


def shaped_all(
    augmented: AugmentedModels, base: Fit, scales: Scales, refits: Sequence[Refit],
    train: Sequence[Experiment], seed: np.random.SeedSequence, checkpoint: Checkpoint, stage: str,
    simulation: SimulationGain | None = None,
) -> list[Refit]:  # fmt: skip
    """The refits, best first; those near the best of them with their shapes estimated, where that
    gains more than `PRICE` for each shape, at all horizons together too.

    simulation : as of `refit_all`.
    """
    out = list(refits)
    best = max(r.score for r in out)
    least = min(best - WITHIN, SHARE * best)
    tried = [
        i for i, r in enumerate(out)
        if r.score >= least and any(shape_bounds(c, scales) or lengths(c) for c in r.candidates)
    ][: SHAPED_CALLED if simulators(augmented.trace) else SHAPED]  # fmt: skip

    one = partial(_one, augmented, scales, [out[i] for i in tried], tuple(train), seed, simulation)
    for i, numbers in zip(tried, checkpoint.map(stage, len(tried), one), strict=True):
        name = " and ".join(map(str, out[i].candidates))
        checkpoint.failures.record_task(f"the shapes of {name}", numbers)
        if "shapes" in numbers:
            old, shapes = out[i], numbers["shapes"]
            made = _reshaped(old.candidates, scales, shapes, numbers["lengths"])
            fitter = augmented.fitter(made)
            fit = fitter.restored(train, numbers)
            moved = np.sum(_whole(old.candidates) != numbers["lengths"])
            moved += np.sum(_estimable(old, scales) != shapes)
            cost = old.cost + PRICE * moved
            gain = fit.log_likelihood - base.log_likelihood
            new = Refit(old.index, made, fitter, fit, gain, cost, begin=old.begin)
            new = new.simulated(train, numbers, simulation)
            if new.penalised_gain > old.penalised_gain and new.score > old.score:
                out[i] = new
    return sorted(out, key=lambda r: -r.score)


def _one(
    augmented: AugmentedModels, scales: Scales, refits: Sequence[Refit],
    train: Sequence[Experiment], seed: np.random.SeedSequence, simulation: SimulationGain | None,
    k: int,
) -> Numbers:  # fmt: skip
    r = _with_lengths(augmented, refits[k], train, child_seed(seed, k))
    found = _shaped(augmented, scales, r, train, child_seed(seed, k))
    if not found and r is not refits[k]:
        found = {**r.fit.numbers, "shapes": _estimable(r, scales)}
    if not found:
        return found
    found["lengths"] = _whole(r.candidates)
    if simulation is None:
        return found
    made = _reshaped(refits[k].candidates, scales, found["shapes"], found["lengths"])
    fitter = augmented.fitter(made)
    fit = fitter.restored(train, found)
    return {**found, **fit_for_simulation(fitter, fit, train, simulation).numbers}


def _with_lengths(
    augmented: AugmentedModels, r: Refit, train: Sequence[Experiment], seed: np.random.SeedSequence
) -> Refit:
    """The refit with the whole numbers that fit best, one after the other up or down by one for as
    long as that gains."""
    for i, c in enumerate(r.candidates):
        for name in lengths(c):
            most = FURTHEST * max(c.effect.shapes[name].values)
            for step in (1, -1):
                moved = False
                while 1 <= (value := dict(r.candidates[i].shape)[name] + step) <= most:
                    new = _refitted(augmented, r, i, {name: value}, train, seed)
                    if new is None or new.gain <= r.gain:
                        break
                    r, moved = new, True
                if moved:
                    break
    return r


def _refitted(
    augmented: AugmentedModels, r: Refit, i: int, shape: dict[str, float],
    train: Sequence[Experiment], seed: np.random.SeedSequence,
) -> Refit | None:  # fmt: skip
    """The refit with another shape of its effect i, from where it ended, with as much less strength
    as it is longer: delays that shift alike. None where it fails."""
    candidates = (*r.candidates[:i], r.candidates[i].with_shape(**shape), *r.candidates[i + 1 :])
    try:
        fitter = augmented.fitter(candidates)
        start = r.fit.by_parameter
        old, upper = r.candidates[i], r.candidates[i].effect.upper
        for name, value in shape.items():
            strength = start[old.strength] * dict(old.shape)[name] / value
            if np.isfinite(upper):
                strength = np.minimum(strength, (1.0 - INSIDE) * upper)
            start = start | {old.strength: strength}
        fit = fitter.fit(train, seed, start, effort_for(candidates))
    except SSMError:
        return None
    gain = r.gain + fit.log_likelihood - r.fit.log_likelihood
    return replace(r, candidates=candidates, fitter=fitter, fit=fit, gain=gain)


def _shaped(
    augmented: AugmentedModels, scales: Scales, r: Refit, train: Sequence[Experiment],
    seed: np.random.SeedSequence,
) -> Numbers:  # fmt: skip
    """The values of the shapes, in order, and the fit with them; empty where there is none, or one
    of them runs to its bound."""
    known = _bounded(r, scales)
    if not known:
        return {}
    start = {n: v for n, v in r.fit.by_parameter.items() if n not in known}
    for name, (low, high, value) in known.items():
        share = (value - low) / (high - low)
        start[range_fraction(name)] = np.asarray(np.clip(share, INSIDE, 1.0 - INSIDE))
    try:
        fitter = augmented.with_free_shapes(r.candidates, {n: v[:2] for n, v in known.items()})
        fit = fitter.fit(train, seed, start, effort_for(r.candidates))
    except SSMError:
        return {}
    if not np.isfinite(fit.log_likelihood):
        return {}
    values = fit.by_component
    shares = np.array([values[range_fraction(n)] for n in known])
    if np.any(np.minimum(shares, 1.0 - shares) < 0.5 * INSIDE):  # it wants to be another effect
        return {}
    shapes = np.array(
        [a + (b - a) * s for (a, b, _), s in zip(known.values(), shares, strict=True)]
    )
    plain = augmented.fitter(_reshaped(r.candidates, scales, shapes, _whole(r.candidates)))
    own = {repr(s): s.data[1] for s in plain.problem.trace.parameter_symbols}
    theta = [values[text] if text in values else float(plain.fixed[name])
             for text, name in own.items()]  # fmt: skip
    rest = slice(0, len(fit.z) - len(shapes))  # the shapes are the last parameters
    return {
        **fit.numbers, "shapes": shapes, "theta": np.array(theta), "z": fit.z[rest],
        "information": fit.information[rest, rest], "at_bound": fit.at_bound[rest],
    }  # fmt: skip


def _bounded(r: Refit, scales: Scales) -> dict[str, tuple[float, float, float]]:
    """Bounds and value of each shape that can be estimated, by the name of its parameter."""
    return {
        f"{c.shares or c.strength}_{name}": (low, high, dict(c.shape)[name])
        for c in r.candidates
        for name, (low, high) in shape_bounds(c, scales).items()
    }


def _estimable(r: Refit, scales: Scales) -> np.ndarray:
    """The values of all shapes that can be estimated, in order."""
    return np.array([value for _, _, value in _bounded(r, scales).values()], dtype=float)


def _whole(candidates: Sequence[Candidate]) -> np.ndarray:
    """The whole numbers of all candidates, in order."""
    return np.array([v for c in candidates for v in lengths(c).values()], dtype=float)


def _reshaped(
    candidates: Sequence[Candidate], scales: Scales, shapes: np.ndarray, whole: np.ndarray
) -> tuple[Candidate, ...]:
    """The candidates with these values of all shapes that can be estimated, and whole numbers."""
    rest, counts = list(map(float, shapes)), list(map(float, whole))
    out = []
    for c in candidates:
        own = {name: rest.pop(0) for name in shape_bounds(c, scales)}
        own |= {name: counts.pop(0) for name in lengths(c)}
        out.append(c.with_shape(**own) if own else c)
    return tuple(out)
