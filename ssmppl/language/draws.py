"""Random draws as nodes of expressions: standard normal, uniform, gamma, Poisson, binomial, von
Mises ones."""

from __future__ import annotations

from typing import Any

from ssmppl.expressions.expr import Expr, constant


class Draws:
    """Makes the "random" nodes of one sampler; each draw is a node of its own."""

    def __init__(self, owner: str):
        self.owner, self.count = owner, 0

    def _node(self, kind: str, *args: Any) -> Expr:
        self.count += 1
        return Expr("random", tuple(map(_node, args)), (kind, (self.owner, self.count)))

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


def _node(value: Any) -> Expr:
    return value if isinstance(value, Expr) else constant(value)
