"""Distributions of states that follow a stochastic differential equation between the rows:
`ssm.SDE`.

Between two rows dx = f(x) dt + G(x) dW is approximated by its linearisation along the mean (A. H.
Jazwinski, *Stochastic Processes and Filtering Theory*, 1970, section 9.4: the prediction of the
continuous-discrete extended Kalman filter):

    dm / dt = f(m),    dP / dt = J P + P J' + G(m) G(m)',    J = df / dx at m,

from m = x and P = 0. Where f is linear and G constant this is the exact distribution, and solved as
such (C. F. Van Loan, "Computing integrals involving the matrix exponential", *IEEE Transactions on
Automatic Control* 23, 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import (
    Expr,
    apply,
    constant,
    depends_on,
    substitute,
    user_location,
)
from ssmppl.expressions.loops.affine import affine_form, array_of, dot, exponential
from ssmppl.expressions.loops.integrate import integrate
from ssmppl.expressions.loops.loop import fresh
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.distributions.continuous import Normal
from ssmppl.language.distributions.multivariate import MvNormal
from ssmppl.language.model.trace import symbols

Matrix = np.ndarray
METHODS = ("linearised", "euler-maruyama")


class SDE:
    """The distribution of a state that moves by dx = drift(x) dt + diffusion(x) dW until the next
    row.

    In a `@transition` function it stands as the distribution of the state by whose name it is
    returned, and starts from that state's value. The distribution is Gaussian: the exact one where
    the drift is linear and the diffusion does not depend on the state (then `steps` does not
    matter), else an approximation that is the better the shorter `dt` is; `explain` says which.

    With `method="euler-maruyama"` the state moves in small steps with a noise each, x + f h + G
    sqrt(h) e, which is the better the more steps there are, whatever the distribution's shape. The
    noises of all but the last step are drawn within the row, as a quantity of their own,
    `NAME_noise`; the last one's is the distribution's. For particles; each step adds to the model's
    text.

    Parameters
    ----------
    drift : function of the state, a number or a vector (d,), that gives one of the same form.
    diffusion : what multiplies the noise: a number, or a vector (d,) for noises that are
        independent, or a matrix (d, m); or a function of the state that gives one of these.
    dt : the time to the next row, in the unit of the drift's; a number, or a symbol such as the
        time step of `ssm.Model(..., time_step="dt")`.
    steps : of the integration of mean and covariance, by the classical Runge-Kutta method; or the
        small steps of Euler and Maruyama.
    method : "linearised" or "euler-maruyama".

    Raises
    ------
    ModelError : drift or diffusion are not of the state's form, or have no derivative.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> house = ssm.Model("house", time_step="dt")
    >>> @house.prior
    ... def prior():
    ...     return {"rate": ssm.HalfNormal(sd=1), "sigma": ssm.HalfNormal(sd=1)}
    >>> @house.initial
    ... def initial():
    ...     return {"x": ssm.Normal(20, sd=5)}
    >>> @house.transition
    ... def transition(x, dt, rate, sigma):
    ...     return {"x": ssm.SDE(lambda x: rate * (15 - x), sigma, dt)}
    """

    def __init__(
        self, drift: Callable[..., Any], diffusion: Any, dt: Any, *, steps: int = 10,
        method: str = "linearised",
    ):  # fmt: skip
        self.location = user_location()
        self.drift, self.diffusion, self.dt = drift, diffusion, dt
        if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 1:
            raise ModelError(
                f"SDE: steps={steps!r}", fix="give a whole number from 1", where=self.location
            )
        if not callable(drift):
            raise ModelError(
                f"SDE: the drift is {drift!r}",
                fix="give a function of the state: ssm.SDE(lambda x: -k * x, sigma, dt)",
                where=self.location,
            )
        if method not in METHODS:
            raise ModelError(
                f"SDE: method={method!r}",
                fix=f"use {' or '.join(map(repr, METHODS))}",
                where=self.location,
            )
        self.steps, self.method = int(steps), method

    def laws(self, name: str, before: Any) -> dict[str, Distribution]:
        """The distributions at a row, from the state's value at the row before: of the small steps'
        noises, where there are any, and of the state.

        Parameters
        ----------
        name : of the state.
        before : its value at the row before, a number or a vector (d,).

        Returns
        -------
        dict
            Distributions by name, that of the state last.
        """
        if self.method == "linearised":
            return {name: self.law(name, before)}
        state, x, h = array(before), before, array(self.dt)[()] / self.steps
        width = self._root(name, before, state.shape).shape[1]
        noise = f"{name}_noise"
        drawn = symbols("state", noise, ((self.steps - 1) * width,))
        for k in range(self.steps - 1):
            e = array(drawn[k * width : (k + 1) * width])
            moved = array(self._root(name, x, state.shape) @ e).reshape(state.shape)
            f = array(self._of_form(name, self.drift(x), state.shape)).reshape(state.shape)
            new = array(x) + h * f + apply("sqrt", h) * moved
            x = array(new) if state.shape else array(new)[()]
        root = self._root(name, x, state.shape)
        f = array(self._of_form(name, self.drift(x), state.shape)).reshape(state.shape)
        mean, spread = array(array(x) + h * f), array(dot(root, root.T) * array_of([h], (1,)))
        made: Distribution
        if state.shape:
            made = MvNormal(mean, covariance=spread)
        else:
            made = Normal(mean[()], variance=spread[0, 0])
        laws: dict[str, Distribution] = {noise: Normal(np.zeros(len(drawn)), sd=1), name: made}
        if not len(drawn):
            del laws[noise]
        for law in laws.values():
            law.location = self.location
        made.approximation = (
            f"the distribution of an SDE in {self.steps} small steps of Euler and Maruyama"
            + (f": that of the last one; the noises of the others are {noise}" * (self.steps > 1))
        )
        return laws

    def law(self, name: str, before: Any) -> Distribution:
        """The linearised distribution of the state at a row, from its value at the row before.

        Parameters
        ----------
        name : of the state.
        before : its value at the row before, a number or a vector (d,).

        Returns
        -------
        Distribution
            Normal of a number, MvNormal of a vector.
        """
        state = array(before)
        own = fresh(state.size)
        x = array(array_of(own, state.shape))
        given = x[()] if not state.shape else x
        rates = self._of_form(name, self.drift(given), state.shape)
        noise = self._square(name, given, state.shape)
        linear = affine_form(rates, own)
        still = not any(depends_on(e, own) for e in noise.ravel())
        if linear is not None and still:
            mean, covariance = self._exact(linear[0], noise, before)
        else:
            mean, covariance = self._linearised(name, rates, noise, own, state)
        made: Distribution
        if not state.shape:
            made = Normal(mean, variance=covariance[0, 0])
        else:
            made = MvNormal(mean, covariance=array(covariance))
        made.location = self.location
        if linear is None or not still:
            made.approximation = (
                f"the distribution of an SDE, approximated by its linearisation along the mean, in "
                f"{self.steps} steps"
            )
        return made

    def _exact(self, rows: Matrix, noise: Matrix, before: Any) -> tuple[Any, Matrix]:
        """Mean and covariance of a linear equation, by exp of [[-M, Q], [0, M']] dt."""
        n = len(rows)
        block = np.full((2 * n, 2 * n), constant(0.0), dtype=object)
        block[:n, :n], block[:n, n:], block[n:, n:] = -rows, noise, rows.T
        time = array(self.dt)[()]
        whole = exponential(block * time)
        covariance = dot(whole[n:, n:].T, whole[:n, n:])
        lower = np.tril(np.ones((n, n), dtype=bool))
        covariance = np.where(lower, covariance, covariance.T)  # the same nodes in both halves
        return integrate(self.drift, before, self.dt), covariance

    def _linearised(
        self, name: str, rates: list[Expr], noise: Matrix, own: list[Expr], state: Any
    ) -> tuple[Any, Matrix]:
        n = len(own)
        try:
            slopes = np.array([differentiate(rates, s) for s in own], dtype=object).T
        except NotDifferentiable as error:
            raise ModelError(
                f"the drift of the SDE of {name!r} has no derivative: {error}",
                fix="write it with functions that have one",
                where=self.location,
            ) from None
        places = [(i, j) for i in range(n) for j in range(i + 1)]

        def moments(m: Any, p: Any) -> dict[str, Any]:
            known = dict(zip(own, array(m).ravel(), strict=True))
            flat = substitute([*rates, *slopes.ravel(), *noise.ravel()], known)
            drift, rest = flat[:n], flat[n:]
            jacobian = array_of(rest[: n * n], (n, n))
            spread = array_of(rest[n * n :], (n, n))
            covariance = _symmetric(array(p).ravel(), places, n)
            product = dot(jacobian, covariance)
            moved = product + product.T + spread
            return {"m": array(drift), "p": array([moved[c] for c in places])}

        begun = {"m": array(state.ravel()), "p": np.zeros(len(places))}
        end = integrate(moments, begun, self.dt, steps=self.steps, linear=False)
        mean = array(array(end["m"]).reshape(state.shape))
        return (mean if state.shape else mean[()]), _symmetric(array(end["p"]), places, n)

    def _square(self, name: str, x: Any, shape: tuple[int, ...]) -> Matrix:
        """G G' (d, d)."""
        root = self._root(name, x, shape)
        return dot(root, root.T)

    def _root(self, name: str, x: Any, shape: tuple[int, ...]) -> Matrix:
        """G (d, m)."""
        given = array(self.diffusion(x) if callable(self.diffusion) else self.diffusion)
        n = int(np.prod(shape, dtype=int))
        if given.ndim == 0:
            root = np.diag(np.full(n, given[()], dtype=object))
        elif given.shape == shape:
            root = np.diag(given.view(np.ndarray))
        elif given.ndim == 2 and len(shape) == 1 and given.shape[0] == n:
            root = given.view(np.ndarray)
        else:
            raise ModelError(
                f"the diffusion of the SDE of {name!r} has the shape {given.shape}, and the state "
                f"{shape}",
                fix="give a number, a vector of the state's length, or a matrix with a row for "
                "each number of the state",
                where=self.location,
            )
        nodes = [e if isinstance(e, Expr) else constant(e) for e in root.ravel()]
        return array_of(nodes, root.shape)

    def _of_form(self, name: str, found: Any, shape: tuple[int, ...]) -> list[Expr]:
        rates = array(found)
        if rates.shape != shape:
            raise ModelError(
                f"the drift of the SDE of {name!r} has the shape {rates.shape}, and the state "
                f"{shape}",
                fix="return the derivative of each number of the state",
                where=self.location,
            )
        return list(rates.ravel())


def _symmetric(values: Any, places: list[tuple[int, int]], n: int) -> Matrix:
    out = np.empty((n, n), dtype=object)
    for value, (i, j) in zip(values, places, strict=True):
        out[i, j] = out[j, i] = value
    return out


def started(
    laws: Any, role: str, function: str, where: Location, before: Callable[[str], Any]
) -> Any:
    """What a function of the user's returned, with the distributions that its SDEs are; those of
    their small steps' noises before them.

    before : (name) -> the value of that state at the row before; None where there is no such state.
    """
    if not isinstance(laws, Mapping) or not any(isinstance(v, SDE) for v in laws.values()):
        return laws
    out: dict[str, Any] = {}
    for name, law in laws.items():
        if not isinstance(law, SDE):
            out[name] = law
            continue
        value = before(name) if role == "transition" else None
        if value is None:
            raise ModelError(
                f"@{role} {function}: {name!r} is an SDE, which is the distribution of a state's "
                "next value",
                fix="return it from a @transition function, by the name of a state that an "
                "@initial function gives",
                where=where,
            )
        out |= law.laws(name, value)
    return out


def noises(laws: Any, asked: Any) -> list[str]:
    """The names of the small steps' noises among these distributions: what the user's function did
    not return."""
    same = laws is asked or not isinstance(laws, Mapping)
    return [] if same else [name for name in laws if name not in asked]
