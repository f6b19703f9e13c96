"""Particle Gibbs on the varves: what one effective sample costs, and the Gibbs step by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .tasks import Work

COLUMNS = {"phi": 0, "tau": 1}
Run = Callable[[], tuple[float, np.ndarray]]


@dataclass
class Chains:
    """Runs of a sampler: (seconds, draws (n, 2) of phi and tau), each used for both."""

    run: Run
    made: list[tuple[float, np.ndarray]] = field(default_factory=list)
    used: Counter[str] = field(default_factory=Counter)

    def work(self, parameter: str) -> Work:
        """Seconds for one effective sample (bulk, Vehtari et al. 2021) of phi or tau."""

        def seconds() -> float:
            k = self.used[parameter]
            self.used[parameter] += 1
            if k == len(self.made):
                self.made.append(self.run())
            import arviz  # here, so that nobody's start waits for it

            seconds, draws = self.made[k]
            return seconds / float(arviz.ess(draws[:, COLUMNS[parameter]]))

        return seconds


def draw_parameters(rng: np.random.Generator, x: np.ndarray, phi: float) -> tuple[float, float]:
    """tau given phi and a path x, exactly; then phi by the Gaussian of its density but for the
    factor sqrt(1 - phi^2) of x_1's law, which is accepted or not (ssmppl draws both jointly, until
    that factor accepts)."""
    n = len(x)
    squares = (1 - phi**2) * x[0] ** 2 + ((x[1:] - phi * x[:-1]) ** 2).sum()
    tau = rng.gamma(0.01 + 0.5 * n) / (0.01 + 0.5 * squares)
    inner = (x[1:-1] ** 2).sum()
    mean, sd = (x[1:] * x[:-1]).sum() / inner, 1 / np.sqrt(tau * inner)
    new = mean + sd * rng.normal()
    if abs(new) < 1 and rng.uniform() ** 2 < (1 - new**2) / (1 - phi**2):
        phi = new
    return phi, tau
