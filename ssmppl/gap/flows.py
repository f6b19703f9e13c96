"""Flows: expressions that several equations share, so that what one lacks the others lack with it.

The acceleration of a cart turns the pole on it; who is infected leaves the susceptible. A force or
a loss that is missing there is missing in every equation that holds the flow: an increment g of x_i
is then one of g (d f_j / d F) / (d f_i / d F) of x_j, f the transitions' means and F the flow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ssmppl.expressions.calculus import NotDifferentiable, gradient
from ssmppl.expressions.expr import Expr, substitute, symbol, symbols_of
from ssmppl.expressions.graph import topological
from ssmppl.gap.anatomy import Anatomy
from ssmppl.gap.laws import scale_of_mean

Reaction = tuple[tuple[str, Expr], ...]  # (label of another state, its increment over the own one)

FLOW = symbol("flow", "F")


@dataclass(frozen=True)
class Flows:
    """What moves with the state of a label: `flows`, and what is `carried`."""

    reactions: Mapping[str, list[Reaction]]
    carried: Mapping[str, Reaction]

    @classmethod
    def of(cls, anatomy: Anatomy) -> Flows:
        """Of a model."""
        return cls(flows(anatomy), carried(anatomy))


def flows(anatomy: Anatomy) -> dict[str, list[Reaction]]:
    """By the label of a state: how the others move with it, once for each set of others.

    A flow is a shared expression of states or inputs, the largest of its kind, that enters the
    state's own equation with a constant factor, and the others' linearly. What integrates the state
    is not moved: see `carried`.
    """
    means = {}
    for part in anatomy.of_role("state"):
        mean = anatomy.mean(part)
        if isinstance(mean, Expr) and scale_of_mean(anatomy.law(part)) == "identity":
            means[part.label] = mean
    out: dict[str, list[Reaction]] = {}
    for label in means:
        part = anatomy.parts[label]
        if not anatomy.fixed_by_others(part):
            found: dict[tuple[str, ...], Reaction] = {}
            others = {k: m for k, m in means.items()
                      if k != label and anatomy.integral_of.get(k) != label}  # fmt: skip
            for flow in _shared(means[label], others):
                reaction = _reaction(flow, means[label], others)
                found.setdefault(tuple(other for other, _ in reaction), reaction)
            out[label] = [r for r in found.values() if r]
    return out


def carried(anatomy: Anatomy) -> dict[str, Reaction]:
    """By the label of a state: what integrates its new value, and so moves within the same step, as
    in semi-implicit steps, x + h v_new."""
    out: dict[str, Reaction] = {}
    for x, v in anatomy.integral_of.items():
        mean, whole = (anatomy.mean(anatomy.parts[label]) for label in (v, x))
        if not (isinstance(mean, Expr) and isinstance(whole, Expr)):
            continue
        if mean in set(topological([whole])):
            try:
                (slope,) = gradient(substitute([whole], {mean: FLOW})[0], [FLOW])
            except NotDifferentiable:
                continue
            if not _moving(slope) and FLOW not in symbols_of(slope):
                out[v] = ((x, slope),)
    return out


def _moving(e: Expr) -> bool:
    """Whether it depends on states or inputs."""
    return any(s.data[0] in ("state_prev", "input_prev") for s in symbols_of(e))


def _shared(mean: Expr, others: Mapping[str, Expr]) -> list[Expr]:
    """What a state's equation and some other one hold, the larger first. Without a parameter,
    as h v, cos x or x_1 - x_2, it is geometry and no flow."""
    elsewhere = set(topological(others.values()))
    out: list[Expr] = []
    seen: set[Expr] = set()
    stack = [mean]
    while stack:
        node = stack.pop()
        if node in seen or node.op in ("symbol", "const") or not _moving(node):
            continue
        seen.add(node)
        law = any(s.data[0] == "parameter" for s in symbols_of(node))
        if law and node in elsewhere and node is not mean:
            out.append(node)
        stack += node.args
    return out


def _reaction(flow: Expr, mean: Expr, others: Mapping[str, Expr]) -> Reaction:
    """How the other equations move with one; () where the flow does not enter as it has to."""
    out = []
    try:
        (own,) = gradient(substitute([mean], {flow: FLOW})[0], [FLOW])
        if _moving(own) or FLOW in symbols_of(own):
            return ()
        for label, other in others.items():
            (slope,) = gradient(substitute([other], {flow: FLOW})[0], [FLOW])
            if slope.op == "const" and slope.data == 0.0:
                continue
            if FLOW in symbols_of(slope):
                return ()
            out.append((label, slope / own))
    except NotDifferentiable:
        return ()
    return tuple(out)
