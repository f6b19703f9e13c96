"""Parameters whose estimate runs to a bound of their support.

Scales and shares may be driven to a bound of their support: a process noise of nothing. There the
likelihood is flat on the unconstrained scale: where the climb ended says nothing (1e-4 or 1e-13, as
it happened), and a curvature there is no information. Such a number is held at the value nearest to
where it is of consequence, the farthest inside that costs next to nothing, which keeps the other
numbers' scores and curvatures of a moderate size (Self and Liang 1987 for their distribution).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile

import numpy as np

from ssmppl.inference.optimisation.parts import Parts, summed

OUTWARDS = (1.0, 3.0, 7.0, 12.0)  # on the unconstrained scale: a factor of 3 to 160,000
FREE = 0.1  # nats that going outwards may cost where the bound is the place of the maximum
COST = 0.05  # nats that the value which is held may cost
# Inwards, where the value that is held is looked for: as far as the smallest number there is.
GRID = np.concatenate([np.linspace(0.5, 40.0, 80), np.linspace(45.0, 800.0, 152)])
TOGETHER = 16  # points of the grid that are looked at in a call
ROUNDS, SECTIONS = 7, 7  # of the interval between what costs nothing and what does
FALL = 0.5  # nats by which the function has to fall inside: else the number is not identified


def hold_at_bounds(
    function: Callable[[np.ndarray], np.ndarray], z: np.ndarray, candidates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(z, mask), each (F,): where a bound is the place of the maximum, and z moved inside there.

    function : what was maximised, (B, F) -> (B,), -inf where it has no value. candidates : (F,)
    bool, those that have a bound to run to.
    """
    z, mask = np.array(z, dtype=float), np.zeros(len(z), dtype=bool)
    for i in np.flatnonzero(candidates):

        def at(steps: np.ndarray, i: int = int(i)) -> np.ndarray:
            there = np.repeat(z[None], len(steps), axis=0)
            there[:, i] += steps
            return function(there)

        outwards = np.array(OUTWARDS)
        here, *values = at(np.concatenate([[0.0], -outwards, outwards])).tolist()
        for sign, out in ((-1.0, values[: len(outwards)]), (1.0, values[len(outwards) :])):
            # As far as there are values: nothing is resolved any more where a noise is tiny.
            out = list(takewhile(lambda v: v > -np.inf, out))
            if not out or min(out) < here - FREE:
                continue
            top = max(here, *out)
            inside = _first_below(at, -sign, top - FALL)
            if inside is None:  # flat either way: this number is not identified
                continue
            good, bad = -OUTWARDS[int(np.argmax(out))], inside  # inwards, from what costs nothing
            for _ in range(ROUNDS):
                steps = np.linspace(good, bad, SECTIONS + 2)
                dear = ~(at(-sign * steps[1:-1]) >= top - COST)
                k = int(np.argmax(dear)) if dear.any() else SECTIONS
                good, bad = steps[k], steps[k + 1]
            z[i] -= sign * good
            mask[i] = True
            break
    return z, mask


def _first_below(
    function: Callable[[np.ndarray], np.ndarray], sign: float, level: float
) -> float | None:
    """The first step of the grid, to that side, at which the function is not above a level."""
    for first in range(0, len(GRID), TOGETHER):
        steps = GRID[first : first + TOGETHER]
        below = ~(function(sign * steps) > level)
        if below.any():
            return float(steps[np.argmax(below)])
    return None


def flat_outwards(function: Callable[[np.ndarray], Parts], z: np.ndarray) -> np.ndarray:
    """(F,) bool: which may have run to a bound, as the first step outwards costs nothing; by the
    function (B, F) -> B sums of many points at once."""
    steps = OUTWARDS[0] * np.eye(len(z))
    here, *away = summed(function(np.vstack([z[None], z + steps, z - steps])))
    found: np.ndarray = np.any(np.reshape(away, (2, -1)) >= here - FREE, axis=0)
    return found


def bounds_note(names: Sequence[str], values: dict[str, float], what: str) -> str:
    """A note on parameters at a bound."""
    if not names:
        return ""
    values_at = ", ".join(f"{n} = {values[n]:.3g}" if n in values else n for n in names)
    one = len(names) == 1
    return (
        f"in {what} the {'estimate' if one else 'estimates'} of {' and '.join(names)} "
        f"{'is on the boundary of its' if one else 'are on the boundary of their'} support; "
        f"{'it is' if one else 'they are'} fixed just inside ({values_at}, at a cost of {COST:g} "
        f"nats{'' if one else ' each'}), and standard errors of the others are conditional on that"
    )
