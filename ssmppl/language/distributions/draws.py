"""Random draws as nodes of expressions: standard normal, uniform, gamma, Poisson, binomial and von
Mises ones, and NumPy's `Generator` made of them, which samplers of users draw from.
"""

from __future__ import annotations

from typing import Any

from ssmppl.errors import ModelError
from ssmppl.expressions.expr import Expr, apply, constant, user_location


class Draws:
    """Makes the "random" nodes of one sampler; each draw is a node of its own."""

    def __init__(self, owner: str):
        self.owner, self.count = owner, 0

    def _node(self, kind: str, *args: Any) -> Expr:
        self.count += 1
        return Expr("random", tuple(map(_as_node, args)), (kind, (self.owner, self.count)))

    def normal(self) -> Expr:
        """Standard normal."""
        return self._node("normal")

    def uniform(self) -> Expr:
        """Uniform on the open interval (0, 1)."""
        return self._node("uniform")

    def gamma(self, shape: Any, buffered: bool = False) -> Expr:
        """Gamma with unit rate; buffered: made of a normal and a uniform where these will do."""
        if buffered:
            return self._node("gamma_by", shape, self.normal(), self.uniform())
        return self._node("gamma", shape)

    def poisson(self, rate: Any) -> Expr:
        return self._node("poisson", rate)

    def binomial(self, n: Any, p: Any) -> Expr:
        return self._node("binomial", n, p)

    def vonmises(self, concentration: Any) -> Expr:
        """Von Mises round 0, on [-pi, pi]."""
        return self._node("vonmises", concentration)


class Generator:
    """What a user's sampler draws from: these methods of NumPy's `Generator`, with its arguments.

    Every call is a draw of its own. A sampler that is called with NumPy's generator instead, and
    numbers, does the same.
    """

    def __init__(self, draws: Draws):
        self._draws = draws

    def uniform(self, low: Any = 0.0, high: Any = 1.0) -> Any:
        """Uniform between low and high, neither of them ever drawn.

        Parameters
        ----------
        low, high : the ends, numbers or expressions.

        Returns
        -------
        expression : the draw.
        """
        return low + (high - low) * self._draws.uniform()

    def random(self) -> Any:
        """Uniform between 0 and 1.

        Returns
        -------
        expression : the draw.
        """
        return self._draws.uniform()

    def normal(self, loc: Any = 0.0, scale: Any = 1.0) -> Any:
        """Normal of mean loc and standard deviation scale.

        Parameters
        ----------
        loc, scale : its mean and standard deviation.

        Returns
        -------
        expression : the draw.
        """
        return loc + scale * self._draws.normal()

    def standard_normal(self) -> Any:
        """Normal of mean 0 and standard deviation 1.

        Returns
        -------
        expression : the draw.
        """
        return self._draws.normal()

    def exponential(self, scale: Any = 1.0) -> Any:
        """Exponential of mean scale.

        Parameters
        ----------
        scale : its mean.

        Returns
        -------
        expression : the draw.
        """
        return -scale * apply("log", self._draws.uniform())

    def gamma(self, shape: Any, scale: Any = 1.0) -> Any:
        """Gamma of mean shape times scale.

        Parameters
        ----------
        shape, scale : its shape, and the scale, 1 / rate.

        Returns
        -------
        expression : the draw.
        """
        return scale * self._draws.gamma(shape)

    def poisson(self, lam: Any = 1.0) -> Any:
        """Poisson of mean lam.

        Parameters
        ----------
        lam : its mean.

        Returns
        -------
        expression : the draw.
        """
        return self._draws.poisson(lam)

    def binomial(self, n: Any, p: Any) -> Any:
        """Binomial: successes among n, each of probability p.

        Parameters
        ----------
        n : number of trials.
        p : probability of each success.

        Returns
        -------
        expression : the draw.
        """
        return self._draws.binomial(n, p)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        known = [n for n in vars(Generator) if not n.startswith("_")]
        raise ModelError(
            f"a sampler asks for rng.{name}, which there is not",
            fix=f"make the draw of those that there are: {', '.join(known)}; a beta variable is "
            "a / (a + b) of two gamma ones",
            where=user_location(),
        )


def _as_node(value: Any) -> Expr:
    return value if isinstance(value, Expr) else constant(value)
