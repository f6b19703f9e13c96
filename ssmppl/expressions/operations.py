"""The operations of expressions: one table of what each means and how it is written.

Whoever adds an operation enters it here, its derivative, and whether it jumps, in `calculus.py` and
its compiled function in `codegen/kernels/math`. What else is known of some operations, such as
rules of simplification and signs, stands where it is used: nothing goes wrong without.

Expressions are written in four dialects: for people (`expr.py`), in plain Python
(`analysis/lambdify.py`), in generated code (`codegen/text/render.py`) and in model files
(`diagnosis/report/spelling.py`). A dialect gives each operation a `Phrase`, most of them from this
table; parentheses are set by the levels of phrases, in the same way for all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.special as sp

from ssmppl.expressions import special

CHEAP, SLOW = 0.15, 30.0  # costs; slow is what is no vectorised pass


class Level:
    """How tightly a text binds, from Python's table of precedence."""

    CHOICE, OR, AND, NOT, COMPARISON, BIT_OR, BIT_AND, SUM, PRODUCT, SIGN, POWER, ATOM = range(12)


Text = tuple[str, int]  # and how tightly it binds


def within(part: Text, level: int) -> str:
    """The text, in parentheses where it binds less tightly than that."""
    text, own = part
    return text if own >= level else f"({text})"


class Phrase(NamedTuple):
    """How an operation is written: a template for its operands' texts, how tightly the whole binds,
    and how tightly each operand has to."""

    template: str
    level: int
    operands: tuple[int, ...]

    def of(self, parts: Sequence[Text]) -> Text:
        """The phrase with the operands' texts put in."""
        inside = [
            text if own >= level else f"({text})"
            for (text, own), level in zip(parts, self[2], strict=True)
        ]
        return self[0].format(*inside), self[1]


def call(function: str, operands: int) -> Phrase:
    """`function({0}, {1}, ...)`."""
    places = ", ".join(f"{{{k}}}" for k in range(operands))
    return Phrase(f"{function}({places})", Level.ATOM, (Level.CHOICE,) * operands)


def infix(sign: str, level: int, left: int = 0, right: int = 1) -> Phrase:
    """`{0} sign {1}`; how much more tightly than the whole the operands have to bind."""
    return Phrase(f"{{0}}{sign}{{1}}", level, (level + left, level + right))


class Operation(NamedTuple):
    """An operation on numbers.

    Attributes
    ----------
    operands : how many it has.
    numpy : the function of NumPy ("np.") or scipy.special ("special.") that users call; "" where
        neither has it.
    kernel : file and function of `codegen/kernels/math` that generated code calls; without a file a
        built-in function.
    plain : the function that plain Python calls on floats ("logaddexp" is one of `lambdify.py`), or
        a phrase of its own; "" where `written` says it, or where the interpreter is asked.
    cost : nanoseconds per particle, from timings of single passes; what they weigh matters, not the
        unit.
    written : by Python's signs and words, where it has any.
    meaning : function of arrays, where it is neither `numpy` nor one of this name in `special.py`.
    """

    name: str
    operands: int
    numpy: str = ""
    kernel: str = ""
    plain: str | Phrase = ""
    cost: float = SLOW
    written: Phrase | None = None
    meaning: Callable[..., Any] | None = None

    @property
    def called(self) -> Callable[..., Any] | None:
        """The function `numpy`."""
        home, _, own = self.numpy.partition(".")
        return getattr({"np": np, "special": sp}[home], own) if own else None

    @property
    def function(self) -> Callable[..., Any]:
        """What it means: a function of arrays that broadcast against each other."""
        found: Callable[..., Any] = self.meaning or self.called or getattr(special, self.name)
        return found


# max(1.0, nan) is 1.0 in Python, and nan in NumPy
_LARGER = Phrase("{0} if {0} >= {1} or {0} != {0} else {1}", Level.CHOICE, (Level.ATOM,) * 2)
_SMALLER = _LARGER._replace(template=_LARGER.template.replace(">=", "<="))

_TABLE = (
    # in signs and words; a + (b - c) keeps its parentheses: without them it rounds otherwise
    Operation("neg", 1, "np.negative", cost=CHEAP,
              written=Phrase("-{0}", Level.SIGN, (Level.SIGN,))),
    Operation("add", 2, "np.add", cost=CHEAP, written=infix(" + ", Level.SUM)),
    Operation("sub", 2, "np.subtract", cost=CHEAP, written=infix(" - ", Level.SUM)),
    Operation("mul", 2, "np.multiply", cost=CHEAP, written=infix(" * ", Level.PRODUCT)),
    Operation("div", 2, "np.divide", cost=0.7, written=infix(" / ", Level.PRODUCT)),
    Operation("mod", 2, "np.mod", written=infix(" % ", Level.PRODUCT)),
    Operation("pow", 2, "np.power", "scalars.power", "math.pow", 8.0,
              infix("**", Level.POWER, 1, -1),
              lambda a, b: np.power(np.asarray(a, dtype=float), b)),
    # a < b < c is another thing in Python than (a < b) < c
    Operation("lt", 2, "np.less", cost=CHEAP, written=infix(" < ", Level.COMPARISON, 1)),
    Operation("le", 2, "np.less_equal", cost=CHEAP, written=infix(" <= ", Level.COMPARISON, 1)),
    Operation("eq", 2, "np.equal", cost=CHEAP, written=infix(" == ", Level.COMPARISON, 1)),
    Operation("ne", 2, "np.not_equal", cost=CHEAP, written=infix(" != ", Level.COMPARISON, 1)),
    Operation("not", 1, "np.logical_not", written=Phrase("not {0}", Level.NOT, (Level.NOT,))),
    Operation("and", 2, "np.logical_and", cost=CHEAP, written=infix(" and ", Level.AND, right=0)),
    Operation("or", 2, "np.logical_or", cost=CHEAP, written=infix(" or ", Level.OR, right=0)),
    Operation("where", 3, "np.where", cost=0.3,
              written=Phrase("{1} if {0} else {2}", Level.CHOICE, (Level.OR,) * 3)),
    # elementary functions
    Operation("exp", 1, "np.exp", "elementary.exp", "math.exp", 1.0),
    Operation("log", 1, "np.log", "elementary.log", "math.log", 1.0),
    Operation("log1p", 1, "np.log1p", "elementary.log1p", "math.log1p", 1.5),
    Operation("expm1", 1, "np.expm1", "elementary.expm1", "math.expm1", 1.5),
    Operation("sqrt", 1, "np.sqrt", "elementary.sqrt", "math.sqrt", 1.0),
    Operation("sin", 1, "np.sin", "elementary.sin", "math.sin", 1.3),
    Operation("cos", 1, "np.cos", "elementary.cos", "math.cos", 1.3),
    Operation("tan", 1, "np.tan", "scalars.tan", "math.tan"),
    Operation("arcsin", 1, "np.arcsin", "scalars.arcsin", "math.asin"),
    Operation("arccos", 1, "np.arccos", "scalars.arccos", "math.acos"),
    Operation("arctan", 1, "np.arctan", "elementary.arctan", "math.atan"),
    Operation("arctan2", 2, "np.arctan2", "scalars.arctan2", "math.atan2"),
    Operation("sinh", 1, "np.sinh", "elementary.sinh", "math.sinh"),
    Operation("cosh", 1, "np.cosh", "elementary.cosh", "math.cosh"),
    Operation("tanh", 1, "np.tanh", "elementary.tanh", "math.tanh", 2.0),
    Operation("arcsinh", 1, "np.arcsinh", "scalars.arcsinh", "math.asinh"),
    Operation("arccosh", 1, "np.arccosh", "scalars.arccosh", "math.acosh"),
    Operation("arctanh", 1, "np.arctanh", "scalars.arctanh", "math.atanh"),
    Operation("logaddexp", 2, "np.logaddexp", "scalars.logaddexp", "logaddexp", 3.5),
    Operation("abs", 1, "np.abs", "abs", "abs", CHEAP),
    Operation("sign", 1, "np.sign", "scalars.sign"),
    Operation("floor", 1, "np.floor", "scalars.floor", cost=CHEAP),
    Operation("ceil", 1, "np.ceil", "scalars.ceil"),
    Operation("maximum", 2, "np.maximum", "scalars.maximum", _LARGER, CHEAP),
    Operation("minimum", 2, "np.minimum", "scalars.minimum", _SMALLER, CHEAP),
    # functions of probability
    Operation("gammaln", 1, "special.gammaln", "special.lgamma", "math.lgamma"),
    Operation("gammaln_rise", 2, "", "special.gammaln_rise"),
    Operation("digamma", 1, "special.psi", "special.digamma"),
    Operation("digamma_rise", 2, "", "special.digamma_rise"),
    Operation("trigamma", 1, "", "special.trigamma"),
    Operation("betaln", 2, "special.betaln", "special.betaln", meaning=special.betaln),
    Operation("ndtr", 1, "special.ndtr", "special.ndtr"),
    Operation("log_ndtr", 1, "special.log_ndtr", "special.log_ndtr"),
    Operation("ndtri", 1, "special.ndtri", "special.ndtri"),
    Operation("erf", 1, "special.erf", "special.erf", "math.erf"),
    Operation("erfc", 1, "special.erfc", "special.erfc", "math.erfc"),
    Operation("i0e", 1, "special.i0e", "special.i0e"),
    Operation("i1e", 1, "special.i1e", "special.i1e"),
    Operation("gammainc", 2, "special.gammainc", "special.gammainc"),
    Operation("gammaincc", 2, "special.gammaincc", "special.gammaincc"),
    Operation("gammaincinv", 2, "special.gammaincinv", "special.gammaincinv"),
    Operation("gammainccinv", 2, "special.gammainccinv", "special.gammainccinv"),
    Operation("betainc", 3, "special.betainc", "special.betainc"),
    Operation("betaincc", 3, "special.betaincc", "special.betaincc"),
    Operation("betaincinv", 3, "special.betaincinv", "special.betaincinv"),
    Operation("betainccinv", 3, "special.betainccinv", "special.betainccinv"),
    Operation("poisson_quantile", 2, "", "scalars.poisson_quantile"),
    Operation("poisson_survival_quantile", 2, "", "scalars.poisson_survival_quantile"),
    Operation("binomial_quantile", 3, "", "scalars.binomial_quantile"),
    Operation("negbinomial_quantile", 3, "", "scalars.negbinomial_quantile"),
    Operation("negbinomial_survival_quantile", 3, "", "scalars.negbinomial_survival_quantile"),
    Operation("betabinomial_cdf", 4, "", "special.betabinomial_cdf"),
    Operation("betabinomial_quantile", 4, "", "special.betabinomial_quantile"),
    Operation("vonmises_cdf", 2, "", "special.vonmises_cdf"),
    Operation("vonmises_quantile", 2, "", "special.vonmises_quantile"),
    Operation("skewnormal_cdf", 2, "", "special.skewnormal_cdf"),
    Operation("skewnormal_quantile", 2, "", "special.skewnormal_quantile"),
    Operation("skellam_log_mass", 3, "", "skellam.skellam_log_mass"),
    Operation("skellam_cdf", 3, "", "skellam.skellam_cdf"),
    Operation("skellam_quantile", 3, "", "skellam.skellam_quantile"),
)  # fmt: skip
OPERATIONS = {o.name: o for o in _TABLE}
WRITTEN = {o.name: o.written for o in _TABLE if o.written is not None}
BOOLEAN = frozenset(("lt", "le", "eq", "ne", "and", "or", "not"))

# Operations on a matrix, whose n * n entries, row by row, are the operands: how users write them,
# and their meaning, a function of a stack of matrices. Kernels have the same names.
MATRICES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "cholesky": ("np.linalg.cholesky({0})", special.factor_of_semidefinite),
    "inverse": ("np.linalg.inv({0})", np.linalg.inv),
    "logdet": ("np.linalg.slogdet({0})[1]", lambda a: np.linalg.slogdet(a)[1]),
    "det": ("np.linalg.det({0})", np.linalg.det),
}
MATRIX_OPS = tuple(MATRICES)
# Kinds of "random" nodes; most normals and uniforms are drawn in bulk.
DRAWS = ("normal", "uniform", "gamma", "gamma_by", "poisson", "binomial", "vonmises")

# Functions of `codegen/kernels/math` -> the file where they stand.
KERNELS = dict(o.kernel.split(".")[::-1] for o in _TABLE if "." in o.kernel)
KERNELS |= dict.fromkeys((*MATRIX_OPS, "whole"), "scalars") | dict.fromkeys(DRAWS, "random")
