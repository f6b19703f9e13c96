"""Functions that symbols do not have, and what to write for them."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

SHOWN = 3
_ROUNDED = "np.floor(x + 0.5), which takes halves up, where NumPy takes them to even numbers"
_SORTED = "np.minimum and np.maximum of the elements"
_TABLE = "np.where(...) by pieces, or wrap the table by @ssm.primitive"
# by the names that NumPy, SciPy and their ufuncs have
INSTEAD: dict[str, str] = {
    **dict.fromkeys(["round", "rint", "around"], _ROUNDED),
    **dict.fromkeys(["trunc", "fix"], "np.sign(x) * np.floor(np.abs(x))"),
    **dict.fromkeys(["select", "piecewise"], "np.where(condition, a, b), one inside another"),
    **dict.fromkeys(["interp", "interp1d", "searchsorted", "digitize"], _TABLE),
    **dict.fromkeys(["any", "logical_xor"], "conditions joined by |"),
    "all": "conditions joined by &",
    **dict.fromkeys(["sort", "median", "partition"], _SORTED),
    **dict.fromkeys(["argmax", "argmin"], "np.where(x[0] >= x[1], 0, 1), and so on"),
    "cumprod": "np.exp(np.cumsum(np.log(x))) of positive numbers, or the products one by one",
    "nan_to_num": "np.where(np.isnan(x), 0.0, x)",
    "sinc": "np.where(x == 0, 1.0, np.sin(np.pi * x) / (np.pi * x))",
    "gamma": "np.exp(scipy.special.gammaln(x)) of positive numbers",
    "erfcx": "2 * np.exp(x**2 + scipy.special.log_ndtr(-np.sqrt(2) * x))",
    "factorial": "np.exp(scipy.special.gammaln(x + 1))",
    "beta": "np.exp(scipy.special.betaln(a, b))",
    **dict.fromkeys(["comb", "binom"], "np.exp(gammaln(n + 1) - gammaln(k + 1) - "
                    "gammaln(n - k + 1)), with scipy.special.gammaln"),
    "poch": "np.exp(scipy.special.gammaln(x + m) - gammaln(x))",
    "logsumexp": "np.logaddexp(a, b), for more one inside another",
    "softmax": "np.exp(x) / np.sum(np.exp(x))",
    "log_softmax": "x - np.log(np.sum(np.exp(x)))",
    "log_expit": "-np.logaddexp(0, -x)",
    "cdf": "scipy.special.ndtr(z) for a normal law, gammainc and betainc for gamma and beta laws",
    "logcdf": "scipy.special.log_ndtr(z) for a normal law",
    "sf": "scipy.special.ndtr(-z) for a normal law, gammaincc for a gamma law",
    "ppf": "scipy.special.ndtri(p) for a normal law",
    **dict.fromkeys(["pdf", "pmf"], "the formula of the density"),
    **dict.fromkeys(["logpdf", "logpmf"], "the formula of the log density"),
    **dict.fromkeys(["quad", "odeint", "solve_ivp"], "a fixed number of steps in a Python loop, "
                    "such as Euler's or Runge-Kutta's, or wrap it by @ssm.primitive"),
    "expm": "the solution in closed form, or some terms of its series",
    **dict.fromkeys(["eig", "eigh", "eigvals", "svd", "pinv", "lstsq"],
                    "np.linalg.inv, solve, det or cholesky, or the eigenvalues in closed form"),
}  # fmt: skip


def fix_for(name: str, known: Iterable[str]) -> str:
    """What to write for a function of this name: what is known to do, else those that are spelled
    nearly so."""
    if name in INSTEAD:
        return f"write {INSTEAD[name]}"
    if name in known:  # a namesake in another module, as in np.linalg
        return f"write np.{name}"
    near = ", ".join(difflib.get_close_matches(name, sorted(known), SHOWN))
    return (f"there are {near}; else " if near else "") + (
        "write the computation by functions that symbols have, or wrap it by @ssm.primitive"
    )


__all__ = ["INSTEAD", "fix_for"]
