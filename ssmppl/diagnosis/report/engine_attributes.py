"""Which number in a physics engine's own file would carry an effect: MuJoCo's `frictionloss` of a
joint for its Coulomb friction."""

from __future__ import annotations

import math
from typing import Any

from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.model.equations import Equations
from ssmppl.expressions.batched.call import OP
from ssmppl.expressions.expr import Expr, topological
from ssmppl.language.model.trace import Trace


def attribute_of(trace: Trace, c: Candidate, strength: float) -> str:
    """The attribute and its value, in words; "" where the engine has none, or there is none.

    trace : of the model without the effect. strength : of the effect.
    """
    if not math.isfinite(strength) or strength == 0.0:
        return ""
    out: list[str] = []
    numbers = {n: float(v) for n, v in c.shape if not isinstance(v, Expr)}
    for one in c.each:
        for simulator, argument in _arguments(trace, one):
            told = getattr(simulator.step, "attribute_of", None)
            if callable(told) and (found := told(c.effect.name, argument, strength, numbers)):
                out.append(str(found))
                break
    return ", ".join(out)


def _arguments(trace: Trace, c: Candidate) -> list[tuple[Any, str]]:
    """The simulators, and the arguments of theirs, through which an effect acts."""
    equations = Equations(trace)
    part = equations.parts[c.equation]
    if c.force:
        force = equations.force(part)
        return [(force.call.data.function.simulator, c.force)] if force else []
    if part.role != "input":
        return []
    roots = [e for s in trace.transition.values() for e in s.distribution.arguments()]
    return [
        (node.data.function.simulator, name)
        for node in topological(roots)
        if node.op == OP
        for name, given in zip(
            node.data.function.arguments, node.args[:-1], strict=True
        )  # but the row
        if given is part.seen_from("transition")
    ]
