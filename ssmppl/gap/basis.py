"""The basis in which a missing term is written, as candidates: smooth functions of each variable.

For every equation with noise: increments of its mean by functions of each state and input, and of
the log of its variance likewise. Their scores tell where the gap is, whatever its form.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import symbol
from ssmppl.gap.anatomy import Anatomy, Part
from ssmppl.gap.bases import Smooth, bases
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.candidates import Scales, slug
from ssmppl.gap.effect import Effect, numbers
from ssmppl.gap.laws import has_scale, scale_of_mean
from ssmppl.language.trace import Trace

MEAN, SCALE = 4, 2  # functions of a variable, for the mean and for the scale
CURVES = bases((0.0, 1.0), MEAN + 1)[1:]  # of a standardised variable, without the constant


@dataclass(frozen=True)
class Term:
    """One basis function of one variable in one equation. moment : "mean" or "scale"."""

    candidate: Candidate
    equation: str
    moment: str
    variable: str
    function: Smooth
    centre: float
    width: float

    def at(self, values: Any) -> Any:
        """The function at values of the variable."""
        return self.function((values - self.centre) / self.width)


def basis(trace: Trace, scales: Scales) -> list[Term]:
    """The terms of all equations that have noise."""
    anatomy = Anatomy(trace)
    variables = [*anatomy.of_role("state"), *anatomy.of_role("input")]
    out = []
    for part in [*anatomy.of_role("state"), *anatomy.of_role("channel")]:
        if part.role == "state" and anatomy.deterministic(part):
            continue
        for moment, kind, count in (
            ("mean", "transition" if part.role == "state" else "observation", MEAN),
            ("scale", "noise", SCALE),
        ):
            law = anatomy.law(part)
            found = scale_of_mean(law) if moment == "mean" else has_scale(law)
            if isinstance(found, NotApplicable):
                continue
            for variable in variables:
                scale = scales.scale[variable.label]
                if not scale.sd > 0.0 or (part.role == "channel" and variable.role == "input"):
                    continue
                out += [
                    _term(part, moment, kind, variable, k, scale.mean, scale.sd)
                    for k in range(count)
                ]
    return out


def _term(
    part: Part, moment: str, kind: str, variable: Part, k: int, centre: float, width: float
) -> Term:
    curve = CURVES[k]

    def term(own, z, strength, centre, width):
        return strength * curve((z - centre) / width)

    effect = Effect(
        name=f"curve {k + 1} of {variable.label}", kind=kind, function=term, on=part.label,
        shapes={"centre": numbers(centre), "width": numbers(width)},
        given={"z": "other state"},
    )  # fmt: skip
    candidate = Candidate(
        effect, part.label, (("centre", centre), ("width", width)), (("z", variable.label),),
        part.role, slug(f"curve {k + 1} {moment} {part.label} {variable.label}"),
    )  # fmt: skip
    return Term(candidate, part.label, moment, variable.label, curve, centre, width)


def lifted(
    candidates: list[Candidate],
) -> tuple[list[Candidate], Mapping[str, float]]:
    """Candidates whose shapes are symbols, and the values of these: code that fits all data.

    Shapes that tell a number of states, or that stand in a function of time, stay numbers.
    """
    out, values = [], {}
    for c in candidates:
        lengths = {n for n in c.effect.states.values() if n is not None}
        fixed = lengths | (set(dict(c.shape)) if c.effect.profile else set())
        shape: list[tuple[str, Any]] = []
        for name, value in c.shape:
            if name in fixed:
                shape.append((name, value))
                continue
            own = f"{c.strength}_{name}"
            values[own] = value
            shape.append((name, symbol("parameter", own, ())))
        out.append(replace(c, shape=tuple(shape)))
    return out, values
