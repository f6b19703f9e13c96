"""Normalising constants and draws of the conjugate families, as expressions of their statistics.

    Z(C) = integral of exp(sum_i C_i s_i(block)) over the block

(Bernardo and Smith (1994), "Bayesian theory", appendix A). `families.py` has the same laws as
functions of numbers; here they are written out in scalars, so that every particle can have
statistics of its own. C is a list of expressions with a 0 at its end, for functions that are
absent.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ssmppl.analysis.conjugacy.families import Beta, Dirichlet, Family, Gamma, Normal, NormalGamma
from ssmppl.analysis.elimination.moments import ZERO
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.language.distributions import Draws

LARGEST = 8  # components of a Normal block: its Cholesky factor is written out


def log_normaliser(family: Family, c: Sequence[Expr]) -> Expr:
    """log Z(C), without constants that depend on nothing."""
    return _total(log_parts(family, c))


def log_parts(family: Family, c: Sequence[Expr]) -> list[Expr]:
    """The summands of log Z(C)."""
    if isinstance(family, Gamma):
        return _of_gamma((c[family.log] + 1.0) / family.power, -c[family.pow])
    if isinstance(family, Normal):
        form = _Solved(family, c)
        return [0.5 * form.square, -form.log_root_det]
    if isinstance(family, NormalGamma):
        form = _Solved(family.normal, c)
        return [*_of_gamma(*_of_precision(family, form, c)), -form.log_root_det]
    if isinstance(family, Beta):
        a, b = c[family.first] + 1.0, c[family.second] + 1.0
        return [_lgamma(a), _lgamma(b), -_lgamma(a + b)]
    if isinstance(family, Dirichlet):
        shapes = [c[k] + 1.0 for k in family.logs]
        return [*map(_lgamma, shapes), -_lgamma(_total(shapes))]
    raise TypeError(type(family).__name__)


def draw_of(family: Family, c: Sequence[Expr], draws: Draws) -> list[Expr]:
    """A draw of the block's components, from the law with density exp(C s) / Z(C)."""
    if isinstance(family, Gamma):
        g = draws.gamma((c[family.log] + 1.0) / family.power, buffered=True) / -c[family.pow]
        return [_root(g, family.power)]
    if isinstance(family, Normal):
        return _Solved(family, c).draw(draws, constant(1.0))
    if isinstance(family, NormalGamma):
        form = _Solved(family.normal, c)
        shape, rate = _of_precision(family, form, c)
        g = draws.gamma(shape, buffered=True) / rate
        return [*form.draw(draws, apply("sqrt", g)), _root(g, family.power)]
    if isinstance(family, (Beta, Dirichlet)):
        places = (family.first, family.second) if isinstance(family, Beta) else family.logs
        parts = [draws.gamma(c[k] + 1.0, buffered=True) for k in places]
        shares = [p / _total(parts) for p in parts]
        return shares[:1] if isinstance(family, Beta) else shares
    raise TypeError(type(family).__name__)


class _Solved:
    """theta ~ Normal(H^-1 h, H^-1) for H = K K': z = K^-1 h, and what follows from it.

    square : h' H^-1 h. log_root_det : log det K.
    """

    def __init__(self, family: Normal, c: Sequence[Expr]):
        self.n = n = len(family.linear)
        h = [c[k] for k in family.linear]
        self.k: list[list[Expr]] = []
        for i in range(n):
            row: list[Expr] = []
            for j in range(i + 1):
                twice = 2.0 if i == j else 1.0
                left = -twice * c[family.quadratic[i][j]]
                other = row if i == j else self.k[j]
                left = left - _total(row[m] * other[m] for m in range(j))
                row.append(apply("sqrt", left) if i == j else left / self.k[j][j])
            self.k.append(row)
        self.z: list[Expr] = []
        for i in range(n):
            left = h[i] - _total(self.k[i][m] * self.z[m] for m in range(i))
            self.z.append(left / self.k[i][i])
        self.square = _total(z * z for z in self.z)
        self.log_root_det = _total(apply("log", self.k[i][i]) for i in range(n))

    def draw(self, draws: Draws, root: Expr) -> list[Expr]:
        """K'^-1 (z + e / root): root is that of the precision that scales H."""
        aim = [z + draws.normal() / root for z in self.z]
        theta: list[Expr] = [ZERO] * self.n
        for i in range(self.n - 1, -1, -1):
            left = aim[i] - _total(self.k[m][i] * theta[m] for m in range(i + 1, self.n))
            theta[i] = left / self.k[i][i]
        return theta


def _of_precision(family: NormalGamma, form: _Solved, c: Sequence[Expr]) -> tuple[Expr, Expr]:
    """(shape, rate) of v**power, theta integrated out."""
    shape = (c[family.log] + 1.0) / family.power - 0.5 * form.n
    return shape, -(c[family.pow] + 0.5 * form.square)


def _of_gamma(shape: Expr, rate: Expr) -> list[Expr]:
    return [_lgamma(shape), -(shape * apply("log", rate))]


def _lgamma(shape: Expr) -> Expr:
    return apply("gammaln", shape)


def _root(g: Expr, power: float) -> Expr:
    if power == 1.0:
        return g
    return 1.0 / g if power == -1.0 else apply("pow", g, constant(1.0 / power))


def _total(values: Iterable[Expr]) -> Expr:
    total = ZERO
    for v in values:
        total = total + v
    return total
