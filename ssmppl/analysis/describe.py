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
)
from ssmppl.analysis.families_matrix import MatrixNormalWishart, Wishart
from ssmppl.analysis.sufficient import BlockForm
from ssmppl.expressions.algebra import Separation, separate, split_constant
from ssmppl.expressions.expr import (
    Expr,
    constant,
    substitute,
    symbol,
    symbols_of,
    to_text,
    topological,
)

MAX_LENGTH = 100
MAX_STATISTICS = 12


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


def prior_alone(
    components: Sequence[Expr], hyperparameters: Sequence[str], how: str
) -> Explanation:
    """The explanation of a block that no law of the model reads, moved as `how` says."""
    given = f", given {', '.join(hyperparameters)}," if hyperparameters else ""
    pronoun, noun = ("it", "its") if len(components) == 1 else ("them", "their")
    return Explanation(
        joined(components),
        f"no law of the model reads {pronoun}, so that the data tell nothing of {pronoun}: {noun} "
        f"posterior{given} is {noun} prior, {how}",
    )


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
    """The summands of a statistic as text; none where it is zero."""
    number, core = split_constant(coefficient)
    if core.op in ("add", "sub") and (role == "prior" or _measured(core.args[0])):
        sign = -1.0 if core.op == "sub" else 1.0
        parts = [constant(number) * core.args[0], constant(sign * number) * core.args[1]]
        return [text for e in parts for text in _part(role, e)]
    measured = _measured(core) if role == "observation" else None
    if measured is not None:
        names, inner = measured
        more, core = split_constant(inner)
        number *= more
        index, count = f"{{t: {names} measured}}", f"#{{t: {names} measured}}"
    else:
        index = {"transition": "{t=2}^T", "observation": "{t=1}^T"}.get(role, "")
        count = {"transition": "(T - 1)", "observation": "T"}.get(role, "")
    if number == 0.0:
        return []
    if core.op == "const":
        return [_times(number, count) if count else f"{number:.6g}"]
    condition = _indicator(core)
    if condition is not None:
        text = f"1{{{', '.join(condition)}}}"
    else:
        factor, text = tidy(core)
        number *= factor
        if index or role == "initial" or " + " in text or " - " in text:
            text = f"[{text}]"
    if role == "initial":
        text = f"{text}_1"
    elif index:
        text = f"sum_{index} {text}"
    return [_times(number, text)]


def _measured(core: Expr) -> tuple[str, Expr] | None:
    """(components, a) of a summand where(measured, a, 0)."""
    if core.op != "where" or not _is_number(core.args[2], 0.0):
        return None
    symbols = symbols_of(core.args[0])
    if {s.data[0] for s in symbols} != {"seen"}:
        return None
    return ", ".join(sorted(map(to_text, symbols))), core.args[1]


def _indicator(core: Expr) -> list[str] | None:
    """The conditions under which this is 1, else 0."""
    if core.op != "where":
        return None
    condition, a, b = core.args
    if _is_number(b, 0.0):
        inner = [] if _is_number(a, 1.0) else _indicator(a)
        return None if inner is None else [to_text(condition), *inner]
    if _is_number(a, 0.0) and condition.op == "eq":
        inner = [] if _is_number(b, 1.0) else _indicator(b)
        opposite = Expr("ne", condition.args)
        return None if inner is None else [to_text(opposite), *inner]
    return None


def _is_number(e: Expr, value: float) -> bool:
    return e.op == "const" and e.data == value


_ARITHMETIC = frozenset(["add", "sub", "mul", "neg", "const", "symbol"])


def tidy(coefficient: Expr) -> tuple[float, str]:
    """A coefficient as number times text, a polynomial in its lowest terms.

    For reading only: what is computed stays as it was written, which rounds better. Functions are
    taken for symbols, named by their text.
    """
    while coefficient.op == "where" and _vanishes_anyway(coefficient):
        coefficient = coefficient.args[2]
    opaque = {
        n: symbol("parameter", to_text(n))
        for n in topological([coefficient])
        if n.op not in _ARITHMETIC and not _whole_power(n)
    }
    (plain,) = substitute([coefficient], opaque)
    form = separate(plain, symbols_of(plain))
    number, core = split_constant(coefficient)
    written = (number, to_text(core))
    if isinstance(form, Separation) and 0 < len(form.terms) <= 4:
        pairs = form.items()
        if all(c.op == "const" for _, c in pairs) and all(e == int(e) for _, e in _atoms(form)):
            numbers = [c.data for _, c in pairs]
            scale = numbers[0] if all(abs(n) == abs(numbers[0]) for n in numbers) else 1.0
            total = constant(0.0)
            for (function, _), n in zip(pairs, numbers, strict=True):
                total = total + constant(n / scale) * function
            if _sums(total) <= _sums(core):  # (y - x)**2 rather than its three terms
                return scale, shorten(to_text(total))
    return number, shorten(written[1])


def _sums(e: Expr) -> int:
    """How many sums are written in an expression."""
    total = dict.fromkeys(topological([e]), 0)
    for n in topological([e]):
        total[n] = sum(total[a] for a in n.args) + (n.op in ("add", "sub"))
    return total[e]


def _vanishes_anyway(node: Expr) -> bool:
    """where(a == 0, 0, a), which is a."""
    condition, zero, value = node.args
    return (
        _is_number(zero, 0.0)
        and condition.op == "eq"
        and condition.args[0] is value
        and _is_number(condition.args[1], 0.0)
    )


def _whole_power(node: Expr) -> bool:
    if node.op == "div":
        return node.args[1].op in ("const", "symbol")
    return node.op == "pow" and node.args[1].op == "const" and node.args[1].data == 2.0


def _atoms(form: Separation) -> list[tuple[Expr, float]]:
    return [pair for m in form.terms for pair in m]


def shorten(text: str, length: int = MAX_LENGTH) -> str:
    return text if len(text) <= length else text[: length - 4] + " ..."


# -- the law
def conditional(family: Family, form: BlockForm, name: str) -> str:
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
        return f"{name} ~ {law}(df = {stat(family.log, sign, plus)}, {matrix})"
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
    if isinstance(family, MatrixNormalWishart):
        return _matrix_normal(family, form)
    if len(names) == 1:
        h = c(family.linear[0])
        return (
            f"{names[0]} ~ Normal({h} / H, precision = H), H = {stat(family.quadratic[0][0], -2.0)}"
        )
    return f"{name} ~ Normal(H^-1 h, precision = H), {len(names)} numbers"


def _matrix_normal(family: MatrixNormalWishart, form: BlockForm) -> str:
    wishart, name = family.wishart, form.components[-1].data[1]
    sign, plus = (-2.0, -1.0) if wishart.inverse else (2.0, 1.0)
    df = _linear(form, wishart.log, sign, plus * (wishart.size + 1.0) - len(family.rows[0]))
    law, scale = ("inverse Wishart", "scale S") if wishart.inverse else ("Wishart", "scale S^-1")
    rows = name if wishart.inverse else f"{name}^-1"
    return (
        f"{name} ~ {law}(df = {df}, {scale}), S = S_yy - S_yz K^-1 S_yz'; A | {name} ~ Normal("
        f"mean = S_yz K^-1, covariance = {rows} (x) K^-1)"
    )


def _variate(name: str, power: float) -> str:
    base = name if abs(power) == 1.0 else f"{name}**{abs(power):g}"
    if power > 0.0:
        return f"{base} ~ Gamma"
    return f"{base} ~ inverse Gamma"


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
