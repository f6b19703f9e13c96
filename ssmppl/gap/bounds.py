"""Scales and shares that a fit has driven to a bound of their support: a process noise of nothing.

There the likelihood is flat on the unconstrained scale: where the climb ended says nothing (1e-4 or
1e-13, as it happened), and a curvature there is no information. Such a number is held at the value
nearest to where it is of consequence, the farthest inside that costs next to nothing, which keeps
the other numbers' scores and curvatures of a moderate size (Self and Liang 1987 for their law).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile

import numpy as np

from ssmppl.inference.particles.pilot import Space
from ssmppl.language.transforms import transforms

OUTWARDS = (1.0, 3.0, 7.0, 12.0)  # on the unconstrained scale: a factor of 3 to 160,000
FREE = 0.1  # nats that going outwards may cost where the bound is the place of the maximum
COST = 0.05  # nats that the value which is held may cost
GRID = np.linspace(0.5, 40.0, 80).tolist()  # inwards, where the value that is held is looked for
STEPS = 40  # of halving
FALL = 0.5  # nats by which the function has to fall inside: else the number is not identified


def bounded(
    function: Callable[[np.ndarray], float], z: np.ndarray, candidates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(z, mask), each (F,): where a bound is the place of the maximum, and z moved inside there.

    function : what was maximised. candidates : (F,) bool, those that have a bound to run to.
    """
    z, mask = np.array(z, dtype=float), np.zeros(len(z), dtype=bool)
    for i in np.flatnonzero(candidates):
        here = function(z)

        def at(step: float, i: int = int(i)) -> float:
            there = z.copy()
            there[i] += step
            return function(there)

        for sign in (-1.0, 1.0):
            # As far as there are values: nothing is resolved any more where a noise is tiny.
            out = list(takewhile(lambda v: v > -np.inf, (at(sign * s) for s in OUTWARDS)))
            if not out or min(out) < here - FREE:
                continue
            top = max(here, *out)
            inside = next((s for s in GRID if not at(-sign * s) > top - FALL), None)
            if inside is None:  # flat either way: nothing tells of this number
                continue
            good, bad = -OUTWARDS[int(np.argmax(out))], inside  # inwards, from what costs nothing
            for _ in range(STEPS):
                middle = 0.5 * (good + bad)
                good, bad = (middle, bad) if at(-sign * middle) >= top - COST else (good, middle)
            z[i] -= sign * good
            mask[i] = True
            break
    return z, mask


def names_of(space: Space, mask: np.ndarray) -> list[str]:
    """The components of the free numbers in `mask` (F,), by their text: `q`, `s[0]`."""
    every: list[str] = []
    for t in transforms(space.problem.trace):
        single = len(t.free) == len(t.components)
        every += (repr(t.components[k]) if single else t.site.name for k in range(len(t.free)))
    free = [every[i] for i in space.where]
    return list(dict.fromkeys(n for n, m in zip(free, mask, strict=True) if m))


def note(names: Sequence[str], values: dict[str, float], what: str) -> str:
    """What a report says of parameters at a bound."""
    if not names:
        return ""
    told = ", ".join(f"{n} at {values[n]:.3g}" if n in values else n for n in names)
    return (
        f"in {what} the best value of {' and '.join(names)} is a bound: held where it begins to "
        f"count ({told}, which costs {COST:g} nats), and left out of the information"
    )


__all__ = ["bounded", "names_of", "note"]
