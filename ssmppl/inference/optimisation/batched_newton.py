"""Newton's ascent of a function that takes many points at once.

Value and gradient are differences over one set of points, so that a step that climbs costs one
call; shares of it are tried where it does not, or climbs by much less than it promised. On the way
up slopes take one point in each coordinate, and what a difference to one side adds is taken off by
the second derivatives that there are, which is not enough near the top of a long ridge: there they
take two. Second derivatives take many points. Of a log-likelihood whose increments
are known row by row the climb begins with the outer products of their slopes (Berndt, Hall, Hall
and Hausman, *Annals of Economic and Social Measurement* 3, 1974), which cost nothing more; of
another function with differences. Differences are taken where a step led nowhere, and at the top;
between these the slopes update what there is (`newton.bfgs_update`), and before a climb ends by
that it is held against outer products made there. Several climbs go on side by side in the same
calls. Where the function is not concave, eigenvalues count by their size (`newton.newton_step`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ssmppl.inference.optimisation.newton import Top, bfgs_update, newton_step
from ssmppl.inference.optimisation.parts import Parts, split, summed

# (B, F) -> (B,), -inf where there is no value; or the parts of sums.
Values = np.ndarray | Parts
Function = Callable[[np.ndarray], Values]

STEPS = 60
FIRST, SHORTEST, LONGEST = 0.02, 1e-4, 0.1  # steps of differences in z
WIDTH = 0.05  # of the steps of differences, in standard deviations by the last curvature
FARTHEST = 2.0  # of a step in any coordinate, in units of it where it is larger than one
LATE = 3  # steps of the others once the highest is at its end
EARLY, HOPEFUL = 3, 3.0  # steps after which those wait that cannot reach the highest one, even if
# they had so many times as far to go as their quadratics say
SHARES = (1.0, 0.5, 0.15, 0.03, 1e-3)  # of a step that are tried
ENOUGH = 0.1  # of what a step promises: where it gains less, shares of it are tried
MUCH = 0.4  # of a step: where less of it is best, its second derivatives were wrong
CLOSE = 0.5  # nats that the quadratic still expects, from where on slopes take both sides
GOOD = 1e-7  # that the quadratic still expects to gain, where a climb is at its end
FINAL = 1e-3  # from where on differences are extrapolated to zero step
NEAR = 1e-2  # likewise, where a climb that need not be precise is at its end
CRAWL, PATIENCE = 0.02, 4  # nats that so many steps have not gained, one after the other: it ends
LEAST_SCALE = 1e-3  # of outer products
FORWARD, SLOPES, CURVATURES, FINE = 0, 1, 2, 3  # what a stencil tells


@dataclass(eq=False)
class Climber:
    """One of the climbs. size : (F,) of its differences. path : where it has been. stale : whether
    second derivatives are to be taken anew; by_parts : whether outer products will do for that;
    rough : whether those are all there is. told : what the last stencil was to tell. slow : how
    many of the last steps gained next to nothing. bent : (F,) minus the second derivatives of the
    last part of a sum, where they were looked at."""

    z: np.ndarray
    value: float
    size: np.ndarray
    slope: np.ndarray = field(default_factory=lambda: np.empty(0))
    information: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    distance: float = np.inf
    reach: float = FARTHEST
    ended: bool = False
    path: list[np.ndarray] = field(default_factory=list)
    stale: bool = True
    by_parts: bool = False
    rough: bool = False
    told: int = FORWARD
    slow: int = 0
    bent: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def tells(self) -> int:
        """What its next stencil has to tell."""
        if self.distance < FINAL:
            return FINE
        if self.stale:
            return SLOPES if self.by_parts else CURVATURES
        return SLOPES if self.distance < CLOSE else FORWARD

    @property
    def top(self) -> Top:
        return Top(self.z, self.value, self.information, self.distance)


def climb_together(function: Function, starts: np.ndarray, precise: bool = True) -> Climber | None:
    """The highest of the climbs from starts (K, F); None where none has a value.

    precise : to the very top, with the second derivatives there; else to within `NEAR`, with what
        the climb has made of them.

    Ctrl-C is left to the caller, who sees every point that the function is asked for.
    """
    starts = np.atleast_2d(starts)
    found = function(starts)
    climbers = [
        Climber(
            z.copy(),
            float(v),
            np.full(len(z), FIRST),
            path=[z.copy()],
            by_parts=isinstance(found, Parts),
        )
        for z, v in zip(starts, summed(found), strict=True)
        if np.isfinite(v)
    ]
    if not climbers:
        return None
    if not starts.shape[1]:  # nothing is free
        climbers[0].distance, climbers[0].ended = 0.0, True
        return climbers[0]
    _differentiate(function, dict.fromkeys(climbers))
    further = LATE
    for step in range(STEPS):
        going = [c for c in climbers if not c.ended]
        best = max(climbers, key=lambda c: c.value)
        if best.ended:
            going = [c for c in going if c.value + c.distance > best.value]
            further -= 1
        elif step >= EARLY:
            going = [c for c in going if c is best or c.value + HOPEFUL * c.distance > best.value]
        if not (going and further):
            break
        was = {c: c.value for c in going}
        _step(function, going)
        for c in going if not precise else ():
            c.slow = c.slow + 1 if c.value - was[c] < CRAWL else 0
            near = c.distance < NEAR and c.told > FORWARD
            c.ended = c.ended or near or c.slow >= PATIENCE
    return max(climbers, key=lambda c: c.value)


def _step(function: Function, climbers: list[Climber]) -> None:
    """One step of each."""
    moves = {}
    for c in climbers:
        move = newton_step(c.slope, c.information)
        size = float(np.max(np.abs(move) / np.maximum(1.0, np.abs(c.z))))
        moves[c] = move * min(1.0, c.reach / max(size, 1e-300))
    found = _together(function, [_stencil(c.z + moves[c], c.size, c.tells) for c in climbers])
    wholes = dict(zip(climbers, found, strict=True))
    gained = {c: float(summed(wholes[c][:1])[0]) - c.value for c in climbers}
    short = [c for c in climbers if not gained[c] > ENOUGH * _promised(c, moves[c])]
    parts = _together(function, [[c.z + s * moves[c] for s in SHARES[1:]] for c in short])
    shares = dict(zip(short, parts, strict=True))
    later: dict[Climber, np.ndarray | None] = {}
    for c in climbers:
        move, tried = moves[c], np.array([c.value + gained[c]])
        if c in shares:
            tried = np.concatenate([tried, summed(shares[c])])
        k = int(np.argmax(np.where(np.isfinite(tried), tried, -np.inf)))
        if not tried[k] > c.value:
            # a gain below the rounding of the function: the step is as right as can be told
            c.ended = c.distance < FINAL or c.reach < SHORTEST
            c.reach *= 0.1
            if not c.ended and (c.by_parts or not c.stale):
                c.stale, c.by_parts = True, False
                later[c] = None
            continue
        c.z, c.value = c.z + SHARES[k] * move, float(tried[k])
        c.path.append(c.z.copy())
        c.reach = FARTHEST if k == 0 else max(c.reach * 0.5, 10.0 * SHORTEST)
        if k == 0:
            _take(c, wholes[c], c.tells, move)
        else:
            c.stale, c.by_parts = c.stale or SHARES[k] < MUCH, isinstance(wholes[c], Parts)
            later[c] = None if c.stale else SHARES[k] * move
    if later:
        _differentiate(function, later)


def _promised(c: Climber, move: np.ndarray) -> float:
    """What the quadratic expects a step to gain; a shortened one at most that."""
    return max(float(c.slope @ move - 0.5 * move @ c.information @ move), 0.0)


def _together(function: Function, sets: Sequence[Sequence[np.ndarray]]) -> list[Values]:
    """The values of each set of points, by one call."""
    if not sets:
        return []
    found = function(np.array([z for own in sets for z in own]))
    return split(found, [len(own) for own in sets])


def _differentiate(function: Function, climbers: Mapping[Climber, np.ndarray | None]) -> None:
    """The derivatives of each where it stands, with the step that led there, where second
    derivatives are to be updated by it."""
    parts = _together(function, [_stencil(c.z, c.size, c.tells) for c in climbers])
    for (c, move), values in zip(climbers.items(), parts, strict=True):
        _take(c, values, c.tells, move)


def _stencil(z: np.ndarray, size: np.ndarray, tells: int) -> list[np.ndarray]:
    """z, then for each step its two sides of each coordinate, and of each pair together; of
    `FORWARD` the one side alone."""
    points, n = [z], len(z)
    if tells == FORWARD:
        return points + [_moved(z, {i: size[i]}) for i in range(n)]
    for times in (1.0, 2.0) if tells == FINE else (1.0,):
        for sign in (times, -times):
            for i in range(n):
                points.append(_moved(z, {i: sign * size[i]}))
        for sign in (times, -times) if tells > SLOPES else ():
            for i in range(n):
                points += [_moved(z, {i: sign * size[i], j: sign * size[j]}) for j in range(i)]
    return points


def _moved(z: np.ndarray, by: dict[int, float]) -> np.ndarray:
    out = z.copy()
    for i, step in by.items():
        out[i] += step
    return out


def _take(c: Climber, found: Values, tells: int, move: np.ndarray | None = None) -> None:
    """Slope, curvature and the next steps from the values at a stencil, that `move` led to."""
    values, parts, size = summed(found), found if isinstance(found, Parts) else None, c.size
    expected = parts is not None and parts.predictions is not None
    if tells <= SLOPES:
        if tells == SLOPES and parts is not None:
            c.bent = parts.bent(size)
        if parts is not None and expected:
            c.information, c.rough = parts.information(size, c.bent), False
        if tells == FORWARD:
            known = 0.0 if c.rough else np.diagonal(c.information)
            slope = (values[1:] - values[0]) / size + 0.5 * known * size
        else:
            up, down = np.split(values[1:], 2)
            slope = _slopes(values[0], up, down, size)
        curvature = -c.information
        if move is not None and not expected:
            curvature = -_updated(c.information, move, c.slope - slope, c.rough)
            c.rough = False
        elif parts is not None and not expected:
            curvature, c.rough = -parts.information(size, c.bent), True
        c.stale = not np.all(np.isfinite(slope))
        c.by_parts = c.stale and tells == FORWARD and parts is not None
    else:
        slope, curvature = derivatives(values, c.size)
        c.stale = False
    c.told, missing = tells, ~np.isfinite(slope)
    c.slope = np.where(missing, 0.0, slope)
    c.information = np.where(np.isfinite(curvature), -curvature, 0.0)
    c.distance = _distance(c)
    if tells == SLOPES and parts is not None and not expected and c.distance < NEAR:
        # What was too large once in a direction of no step would be taken for the top.
        c.information, c.rough = parts.information(size, c.bent), True
        c.distance = _distance(c)
    c.ended = c.distance < GOOD and tells == FINE and not missing.any()
    wanted = np.where(missing, 0.1 * c.size, _sizes(c.information))
    c.size = np.clip(wanted, SHORTEST, LONGEST)


def _distance(c: Climber) -> float:
    """What the quadratic still expects to gain."""
    return 0.5 * float(c.slope @ newton_step(c.slope, c.information))


def _sizes(information: np.ndarray) -> np.ndarray:
    """(F,) of the differences, in standard deviations by this (F, F)."""
    with np.errstate(divide="ignore"):
        wanted = WIDTH / np.sqrt(np.abs(np.diagonal(information)))
    return np.clip(wanted, SHORTEST, LONGEST)


def information_at(function: Function, z: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Minus the second derivatives (F, F) at z (F,), in one call; NaN where there are none.

    about : (F, F) what they are, roughly, for the steps of the differences.
    """
    size = _sizes(about)
    return -derivatives(summed(function(np.array(_stencil(z, size, FINE)))), size)[1]


def _slopes(middle: float, up: np.ndarray, down: np.ndarray, h: np.ndarray) -> np.ndarray:
    """(F,) from the values at both sides, on one side where the other has none."""
    with np.errstate(invalid="ignore"):
        one_sided = np.where(np.isfinite(up), up - middle, middle - down) / h
        both = (up - down) / (2.0 * h)
    return np.where(np.isfinite(both), both, one_sided)


def _updated(
    information: np.ndarray, move: np.ndarray, fall: np.ndarray, rough: bool
) -> np.ndarray:
    """A positive definite (F, F) for which `fall` of the slopes (F,) is about that along `move`;
    by the sizes of the eigenvalues of the last, as steps are. rough : outer products, far from the
    top, can be many times too large, and are first brought down as a whole to what is seen along
    the step (S. Oren and D. Luenberger, *Management Science* 20, 1974)."""
    values, vectors = np.linalg.eigh(information)
    least = 1e-8 * float(np.max(np.abs(values), initial=1e-300))
    h = (vectors * np.maximum(np.abs(values), least)) @ vectors.T
    if not move @ h @ move > 0.0:
        return h
    fall = np.where(np.isfinite(fall), fall, 0.0)
    if rough:
        h = h * np.clip(fall @ move / (move @ h @ move), LEAST_SCALE, 1.0)
    return bfgs_update(h, move, fall)


def derivatives(values: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (F,) and second derivatives (F, F) by central differences over steps `size` (F,),
    extrapolated to zero step where there are two of them; NaN where there are none.

    values : at the points of a stencil.
    """
    n = len(size)
    pairs = n * (n - 1) // 2
    each = 2 * n + 2 * pairs
    slopes, curves = [], []
    with np.errstate(invalid="ignore"):
        for k in range((len(values) - 1) // each if n else 0):
            h = (k + 1.0) * size
            own = values[1 + k * each : 1 + (k + 1) * each]
            up, down = own[:n], own[n : 2 * n]
            alone = up - 2.0 * values[0] + down
            slopes.append(_slopes(values[0], up, down, h))
            curve = np.diag(alone / h**2)
            ahead, back = own[2 * n : 2 * n + pairs], own[2 * n + pairs :]
            for p, (i, j) in enumerate(zip(*np.tril_indices(n, -1), strict=True)):
                both = ahead[p] - 2.0 * values[0] + back[p]
                curve[i, j] = curve[j, i] = (both - alone[i] - alone[j]) / (2.0 * h[i] * h[j])
            curves.append(curve)
        if not slopes:
            return np.zeros(n), np.zeros((n, n))
        if len(slopes) == 1:
            return slopes[0], curves[0]
        out = ((4.0 * a[0] - a[1]) / 3.0 for a in (slopes, curves))
        slope, curve = out
    return (
        np.where(np.isfinite(slope), slope, slopes[0]),
        np.where(np.isfinite(curve), curve, curves[0]),
    )
