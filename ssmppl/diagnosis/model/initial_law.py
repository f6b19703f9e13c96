"""A proper initial distribution for augmented models that cannot have a flat one.

A model whose x_1 is Flat has a likelihood while it is linear and Gaussian, and an effect may end
that. Such a model gets x_1 ~ N(m, s^2) in each flat component, so wide that the data alone tell
where it starts. As p(y) under it is then p(y) under the flat distribution (of density 1) times the
largest density of the normal distribution, the log of that is taken off again (`log_correction`):
gains over the model as it was compare like with like.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.structure import flat_start, linear_gaussian
from ssmppl.data import Experiment
from ssmppl.diagnosis.model.equations import Augmented, as_it_was
from ssmppl.diagnosis.model.smoothing import LAG, Smoother
from ssmppl.errors import NotApplicable
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.distributions import Normal
from ssmppl.language.model.trace import Trace

WIDE = 5.0  # times how far the states go, root mean square, or the starts differ in all
KEPT = 64  # means of x_1 at a time
DIGITS = 2  # of the spread, which a reader of the model sees


@dataclass(frozen=True)
class ProperInitialLaw:
    """The distribution of x_1 in place of a flat one.

    laws : by flat state, the mean and the spread of its proper distribution, of the state's shape.
    """

    laws: Mapping[str, tuple[np.ndarray, np.ndarray]]

    @property
    def log_correction(self) -> float:
        """Minus the log density of the distributions at their means."""
        spread = np.concatenate([np.ravel(s) for _, s in self.laws.values()])
        return float(np.sum(np.log(spread)) + 0.5 * len(spread) * math.log(2.0 * math.pi))

    def applied_to(self, trace: Trace) -> Trace:
        """The trace with these initial distributions."""
        initial = dict(trace.initial)
        for name, (mean, spread) in self.laws.items():
            site = initial[name]
            law = Normal(mean, sd=spread)
            law.location = site.distribution.location
            initial[name] = replace(site, distribution=law)
        if isinstance(trace, Augmented):  # what is added later is added to a model with it
            return replace(trace, initial=initial, origin=self.applied_to(as_it_was(trace)))
        return replace(trace, initial=initial)

    def __str__(self) -> str:
        laws = (f"{n} ~ Normal({_text(m)}, sd={_text(s)})" for n, (m, s) in self.laws.items())
        return ", ".join(laws)


def proper_initial_law(
    trace: Trace, starts: Sequence[np.ndarray], states: Sequence[np.ndarray]
) -> ProperInitialLaw | None:
    """Proper distributions of the flat states; None where there is none.

    starts : (D,) of each experiment, where its x_1 is about. states : (..., D) of each experiment,
    draws from where its states are.
    """
    flat, place = flat_start(trace), {s: i for i, s in enumerate(trace.state_symbols)}
    if not flat:
        return None
    mean = np.mean(starts, axis=0)
    away = np.concatenate([np.reshape(x, (-1, x.shape[-1])) for x in states]) - mean
    # each start that is d from the mean costs d^2 / (2 s^2) nats: 1/50 for all of them together
    between = np.sum((np.asarray(starts) - mean) ** 2, axis=0)
    spread = WIDE * np.sqrt(np.fmax(np.mean(away**2, axis=0), between))
    spread = np.where(np.isfinite(spread) & (spread > 0.0), spread, 1.0)
    laws = {}
    for site in flat:
        own = [place[s] for s in site.components]
        rounded = [_rounded(m, s) for m, s in zip(mean[own], spread[own], strict=True)]
        m, s = (np.reshape(v, site.shape) for v in zip(*rounded, strict=True))
        laws[site.name] = m, s
    return ProperInitialLaw(laws)


def needs_proper_initial_law(trace: Trace) -> bool:
    """Whether an initial distribution is flat that cannot be."""
    return bool(flat_start(trace)) and isinstance(linear_gaussian(trace), NotApplicable)


class InitialStateMeans:
    """(D,) mean of x_1 given the rows up to `LAG`, by the ancestors of the particles there.

    What was found for an experiment and theta (P,) is kept: many sets are drawn from the same.
    """

    def __init__(self, smoother: Smoother):
        self.smoother, self._kept = smoother, dict[tuple[bytes, ...], np.ndarray]()

    def __call__(self, e: Experiment, theta: np.ndarray) -> np.ndarray:
        key = (theta.tobytes(), *(v.tobytes() for v in (e.y, e.u, e.seen)))
        found = self._kept.get(key)
        if found is None:
            stream = random_state(np.random.SeedSequence(0))
            system, weights = self.smoother.system(e, theta, stream)
            last = min(LAG, e.steps - 1)
            index = np.arange(weights.shape[1])
            for t in range(last, 0, -1):
                index = system.ancestors[t][index]
            found = system.particles[0][:, index] @ weights[last]
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[key] = found
        return found


def _rounded(mean: float, spread: float) -> tuple[float, float]:
    """Both to the digits of the spread."""
    place = DIGITS - 1 - math.floor(math.log10(spread))
    return round(float(mean), place) + 0.0, round(float(spread), place)


def _text(values: np.ndarray) -> str:
    return f"{values:.6g}" if values.ndim == 0 else str(values.tolist())
