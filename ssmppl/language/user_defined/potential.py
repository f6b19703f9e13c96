"""A term of the log density that belongs to no measured value."""

from __future__ import annotations

import math
from typing import Any

from ssmppl.errors import ModelError
from ssmppl.language.distributions.base import Distribution


class Potential(Distribution):
    """Potential(log_density): a term of the log density, in the place of an observation.

    It is added in every row of the data, the first one included, and takes no column of them: a
    soft constraint on the states, or what another measurement says about them. It is no
    distribution: nothing is drawn from it, and where the rows of the data end it acts no more. A
    term of some rows alone is ``np.where(condition, term, 0)``; one of the parameters is given in
    the first row, ``np.where(t == 1, term, 0)``. So the log-likelihood of the verbs is the log of
    the normalising constant of density times potentials (Feynman-Kac models; P. Del Moral,
    *Feynman-Kac Formulae*, 2004).

    Parameters
    ----------
    log_density : any expression in states, parameters, inputs and t; of an array every component is
        added.
    """

    drawable = False
    truncatable = False
    measured = False

    def __init__(self, log_density: Any):
        self._set(log_density_=log_density)

    def log_densities(self, value):
        return self.log_density_

    def mean(self):
        return self._full(math.nan)

    def variance(self):
        return self._full(math.nan)

    def cdf(self, value):
        return self._full(math.nan)

    def inverts(self):
        return False

    def undrawable(self, why: str) -> ModelError:
        """The error of a potential where something has to be drawn."""
        return ModelError(
            f"a Potential is a term of the log density, which nothing is drawn from, and {why}",
            fix="simulate from the model without it",
            where=self.location,
        )
