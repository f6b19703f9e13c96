"""Updates in words: what is drawn, from which law, with which statistics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ssmppl.analysis.families import (
    Beta,
    Dirichlet,
    Family,
    Gamma,
    NormalGamma,
    Wishart,
)
from ssmppl.analysis.sufficient import BlockForm
from ssmppl.expressions.algebra import Separation, separate
from ssmppl.expressions.expr import Expr, constant, substitute, symbol, symbols_of, to_text

MAX_LENGTH = 100
MAX_STATISTICS = 40


@dataclass(frozen=True)
class Explanation:
    """title : what is drawn; conditional : its law, one line; statistics : one line for each C_i;
    notes : truncation, correction, fallbacks, reasons."""

    title: str
    conditional: str
    statistics: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.title}: {self.conditional}"]
        lines += [f"    {s}" for s in self.statistics]
        lines += [f"  {n}" for n in self.notes]
        return "\n".join(lines)


def joined(components: Sequence[Expr]) -> str:
    """The components' names: "phi", "(phi, tau)"."""
    names = [to_text(c) for c in components]
    return names[0] if len(names) == 1 else f"({', '.join(names)})"


def statistics(form: BlockForm) -> tuple[str, ...]:
    """One line for each function of the block: how its statistic is summed."""
    lines = []
    for i, function in enumerate(form.functions[:MAX_STATISTICS]):
        lines.append(f"{shorten(to_text(function))}: " + _linear(form, i, 1.0, 0.0))
    hidden = len(form.functions) - MAX_STATISTICS
    return tuple(lines) + ((f"... and {hidden} more",) if hidden > 0 else ())


def _sum(parts: list[str]) -> str:
    out = parts[0] if parts else "0"
    for p in parts[1:]:
        out += f" - {p[1:]}" if p.startswith("-") else f" + {p}"
    return out


def _part(role: str, coefficient: Expr) -> list[str]:
    """A summand of a statistic as text; none where it is zero."""
    if coefficient.op == "const" and coefficient.data == 0.0:
        return []
    count = {"transition": "(T - 1)", "observation": "T"}.get(role)
    if coefficient.op == "const":
        value = coefficient.data
        return [f"{value:.6g}" if count is None else _times(value, count)]
    number, text = tidy(coefficient)
    if role == "initial":
        text = f"[{text}]_1"
    elif count is not None:
        text = f"sum_{'{t=2}^T' if role == 'transition' else '{t=1}^T'} [{text}]"
    return [_times(number, text)]


def tidy(coefficient: Expr) -> tuple[float, str]:
    """A coefficient as number times text, a polynomial in its lowest terms.

    For reading only: what is computed stays as it was written, which rounds better.
    """
    symbols = symbols_of(coefficient)
    form = separate(coefficient, symbols)
    if isinstance(form, Separation) and 0 < len(form.terms) <= 4:
        whole = all(
            atom.op == "symbol" and e == int(e) and e > 0 for m in form.terms for atom, e in m
        )
        if whole:
            pairs = form.items()
            numbers = [c.data for _, c in pairs if c.op == "const"]
            if len(numbers) == len(pairs):
                scale = numbers[0] if all(abs(n) == abs(numbers[0]) for n in numbers) else 1.0
                total = constant(0.0)
                for (function, _), n in zip(pairs, numbers, strict=True):
                    total = total + constant(n / scale) * function
                return scale, shorten(to_text(total))
    if coefficient.op == "mul" and coefficient.args[0].op == "const":
        return coefficient.args[0].data, shorten(to_text(coefficient.args[1]))
    if coefficient.op == "neg":
        return -1.0, shorten(to_text(coefficient.args[0]))
    return 1.0, shorten(to_text(coefficient))


def shorten(text: str, length: int = MAX_LENGTH) -> str:
    return text if len(text) <= length else text[: length - 4] + " ..."


# -- the law
def conditional(family: Family, form: BlockForm) -> str:
    """The law of the block given all else, its parameters in terms of the statistics."""
    names = [to_text(c) for c in form.components]

    def stat(i: int, factor: float = 1.0, plus: float = 0.0) -> str:
        return _linear(form, i, factor, plus)

    def c(i: int) -> str:
        return f"C[{to_text(form.functions[i])}]" if i >= 0 else "0"

    if isinstance(family, Gamma):
        shape = stat(family.log, 1.0 / family.power, 1.0 / family.power)
        return f"{_variate(names[0], family.power)}, shape = {shape}, rate = -{c(family.pow)}"
    if isinstance(family, Beta):
        a, b = stat(family.first, 1.0, 1.0), stat(family.second, 1.0, 1.0)
        return f"{names[0]} ~ Beta({a}, {b})"
    if isinstance(family, Dirichlet):
        inside = ", ".join(stat(i, 1.0, 1.0) for i in family.logs)
        return f"{joined(form.components)} ~ Dirichlet({shorten(inside)})"
    if isinstance(family, Wishart):
        p = family.size
        sign, plus = (-2.0, -p - 1.0) if family.inverse else (2.0, p + 1.0)
        matrix = "scale S" if family.inverse else "inverse scale S"
        law = "inverse Wishart" if family.inverse else "Wishart"
        name = names[0].split("[")[0]
        s = f"tr(S {name}^-1) / 2" if family.inverse else f"tr(S {name}) / 2"
        return f"{name} ~ {law}(df = {stat(family.log, sign, plus)}, {matrix}: -{s} collects C)"
    if isinstance(family, NormalGamma):
        *thetas, v = names
        n = len(thetas)
        shape = stat(family.log, 1.0 / family.power, 1.0 / family.power - 0.5 * n)
        scale = v if family.power == 1.0 else f"{v}**{family.power:g}"
        normal = family.normal
        if n == 1:
            precision = stat(normal.quadratic[0][0], -2.0)
            h = c(normal.linear[0])
            rate = (
                f"-{c(family.pow)} - {h}**2 / (2*H)"
                if normal.linear[0] >= 0
                else f"-{c(family.pow)}"
            )
            return (
                f"{_variate(v, family.power)}, shape = {shape}, rate = {rate}; {thetas[0]} | {v} ~ "
                f"Normal({h} / H, precision = {scale}*H), H = {precision}"
            )
        block = f"({', '.join(thetas)})"
        return (
            f"{_variate(v, family.power)}, shape = {shape}, "
            f"rate = -{c(family.pow)} - h' H^-1 h / 2; "
            f"{block} | {v} ~ Normal(H^-1 h, precision = {scale}*H), h and H from the linear and "
            "quadratic statistics"
        )
    if len(names) == 1:
        h = c(family.linear[0])
        return (
            f"{names[0]} ~ Normal({h} / H, precision = H), H = {stat(family.quadratic[0][0], -2.0)}"
        )
    return (
        f"({', '.join(names)}) ~ Normal(H^-1 h, precision = H), h and H from the linear and "
        "quadratic statistics"
    )


def _variate(name: str, power: float) -> str:
    if power == 1.0:
        return f"{name} ~ Gamma"
    if power == -1.0:
        return f"{name} ~ inverse Gamma (1/{name} ~ Gamma)"
    return f"{name}**{power:g} ~ Gamma"


def _linear(form: BlockForm, i: int, factor: float, plus: float) -> str:
    """plus + factor * C_i, numbers gathered."""
    parts, total = [], plus
    by_role = {
        role: constant(factor) * c[i] if i >= 0 else constant(0.0)
        for role, c in form.coefficients.items()
    }
    for role in ("prior", "initial"):
        if by_role[role].op == "const":
            total += by_role.pop(role).data
    merged = _merged(by_role.get("initial"), by_role["transition"])
    if merged:
        del by_role["initial"], by_role["transition"]
        parts.append(merged)
    for role, e in by_role.items():
        parts += _part(role, e)
    if abs(total) > 1e-12 or not parts:
        parts.insert(0, f"{total:.6g}")
    return _sum(parts)


def _merged(initial: Expr | None, transition: Expr) -> str | None:
    """The initial and the transition summands as one sum, where they are of one form.

    f(x_t) at t = 1 and at t = 2..T: a sum from 1. -f(x_t) at t = 1 and f(x_{t-1}) at t = 2..T:
    what is left of the latter is a sum from 2 to T - 1.
    """
    if initial is None:
        return None
    (a, first), (b, text) = tidy(initial), tidy(transition)
    before = {s: _next(s) for s in symbols_of(transition) if s.data[0].endswith("_prev")}
    if not before and first == text and a == b:
        return _times(b, f"sum_{{t=1}}^T [{text}]")
    if before and len(before) == len(symbols_of(transition) - _parameters(transition)):
        (moved,) = substitute([transition], before)
        if tidy(moved) == (-a, first):
            return _times(-a, f"sum_{{t=2}}^{{T-1}} [{first}]")
    return None


def _next(s: Expr) -> Expr:
    kind, name, index = s.data
    return symbol(kind.removesuffix("_prev"), name, index)


def _parameters(e: Expr) -> frozenset[Expr]:
    return frozenset(s for s in symbols_of(e) if s.data[0] == "parameter")


def _times(number: float, text: str) -> str:
    return {1.0: text, -1.0: f"-{text}"}.get(number, f"{number:.6g}*{text}")


def correction_text(form: BlockForm, positions: Sequence[int]) -> str:
    """exp(sum_j C_j s_j) as a person writes it, where the C_j are numbers."""
    total, rest = constant(1.0), []
    for j in positions:
        function = form.functions[j]
        numbers = [form.coefficients[r][j] for r in ("prior", "initial")]
        if all(n.op == "const" for n in numbers) and function.op == "log":
            exponent = math.fsum(n.data for n in numbers)
            total = total * function.args[0] ** exponent
        else:
            parts = [t for r in ("prior", "initial") for t in _part(r, form.coefficients[r][j])]
            value = _sum(parts)
            value = f"({value})" if len(parts) > 1 else value
            rest.append(f"exp({value}*{shorten(to_text(function))})")
    if not (total.op == "const" and total.data == 1.0):
        rest.insert(0, to_text(total))
    return " * ".join(rest) or "1"
