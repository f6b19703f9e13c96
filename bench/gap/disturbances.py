"""Smoothed disturbances of a fitted model, and how well each effect of the catalogue explains them.

The residuals that a practitioner plots (the auxiliary residuals of Harvey and Koopman 1992,
"Diagnostic checking of unobserved-components time series models", *JBES* 10): along the likeliest
trajectory of the states, what is left of every equation with noise and of every measurement, each
in units of its own root mean square. A candidate's column is what it would add to them: the
derivative of the means in its strength, by the package's own bindings, so that the column and the
effect that is added are one and the same. As in an added-variable plot, what the model's own free
parameters explain is taken off the column first.

What remembers (a missing input, coloured noise, a parameter that wanders) is held against the past
of the filter's corrections, as smoothed ones are correlated in a right model, too. A variance that
varies shows as the correlation of the squares with its column (Koenker 1981, "A note on
studentizing a test for heteroscedasticity", *Journal of Econometrics* 17), a tail as the kurtosis
(Jarque and Bera 1987, *International Statistical Review* 55).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate, refine_wave
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.equations import Equations, time_symbol
from ssmppl.errors import NotApplicable, SSMError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.language.model.trace import Site, Trace, previous

ALONE = 1e-4  # share of a column's square that the model's own parameters have to leave
FOREVER = 1.0  # memory of a random walk, from one row to the next

Values = dict[Expr, np.ndarray | float]


class Disturbances:
    """The disturbances of one experiment (T rows) at a fit.

    values : (N,) those of all parts with noise end to end, each part in units of its root mean
    square. row, part : (N,) the row of each, from 0, and its label. step : (N,) whether it is that
    of a step into that row, else of a measurement. unit : (N,) what its unit is.
    """

    def __init__(self, fitter: Fitter, fit: Fit, e: Experiment):
        self.fitter, self.fit, self.e = fitter, fit, e
        self.trace = fitter.problem.trace
        self.equations = Equations(self.trace)
        self.x = _trajectory(fitter, fit.theta, e)
        self.at = {
            role: self._symbols(self.trace, role, self.x) for role in ("transition", "observation")
        }
        self.parts = [
            (label, role, p.symbol)
            for label, p in self.equations.parts.items()
            for role in ({"state": "transition", "channel": "observation"}.get(p.role, ""),)
            if role and np.any(self._law(self.trace, role, p.symbol, "variance") > 0.0)
        ]
        columns = []  # of each part: values, rows, units, labels, whether a step
        for label, role, s in self.parts:
            left = self._seen(role, s) - self._law(self.trace, role, s, "mean")
            size, begins = float(np.sqrt(np.nanmean(left**2))) or 1.0, role == "transition"
            same, rows = np.ones(len(left)), np.arange(begins, e.steps)
            names = np.full(len(left), label)
            columns.append((left / size, rows, size * same, names, same == begins))
        values, *rest = map(np.concatenate, zip(*columns, strict=True))
        self.kept = np.isfinite(values)
        self.values = values[self.kept]
        self.row, self.unit, self.part, self.step = (a[self.kept] for a in rest)

    # -- what candidates explain
    def statistic(self, c: Candidate, column: np.ndarray) -> float:
        """Of a candidate with its `column`: r sqrt(N), r the correlation with the disturbances;
        its sign is that of the strength. 0 where that cannot be."""
        if c.change in ("noise", "tail"):
            z = self._of_law(c, column)
        elif c.process:
            z = self._of_process(c, column)
        else:
            g = self._alone(column * self._in_time(c))
            z = float(g @ self.values) / float(np.sqrt(g @ g)) if g.any() else 0.0
        return z if np.isfinite(z) and z * (c.sided or z) >= 0.0 else 0.0

    def strength(self, c: Candidate, column: np.ndarray) -> float:
        """About the strength by which the candidate explains the most."""
        if c.change == "tail":
            return 0.1
        if c.process:
            size = np.sqrt(np.mean(column[column != 0.0] ** 2))
            return float((0.1 if c.process == "random walk" else 0.5) / size)
        own = column != 0.0
        if c.change == "noise":
            g = column[own] - column[own].mean()
            return float(g @ (self.values[own] ** 2 - 1.0) / (g @ g))
        g = self._alone(column * self._in_time(c))
        return float(g @ self.values / (g @ g))

    def column(self, c: Candidate) -> np.ndarray | None:
        """(N,) what the strength of a candidate adds to the means of the disturbances, or to the
        log variance of a part, with a function of time or a process held at 1; None where it has
        no column."""
        if c.change == "initial":
            return None
        if c.change == "tail":
            return np.where(self.part == c.equation, 1.0, 0.0)
        try:
            whole = augment(self.trace, [c.increment], prior=False)
            what = "variance" if c.change == "noise" else "mean"
            found = self._slopes(whole, symbol("parameter", c.strength), what)
        except SSMError:
            return None
        return found if np.all(np.isfinite(found)) and found.any() else None

    def refined(self, c: Candidate, column: np.ndarray) -> Candidate:
        """A wave with the period and phase of all rows; any other candidate as it is."""
        if c.effect.profile != "wave":
            return c
        by_row = np.bincount(self.row, column * self.values, self.e.steps)
        return refine_wave(c, by_row, [0], self.e.steps)

    def _of_law(self, c: Candidate, column: np.ndarray) -> float:
        own = self.part == c.equation
        w = self.values[own]
        if c.change == "tail":
            return float(np.sum(w**4 - 6.0 * w**2 + 3.0)) / float(np.sqrt(24.0 * len(w)))
        g, square = column[own] - column[own].mean(), w**2 - 1.0
        size = float(np.sqrt((g @ g) * np.mean(square**2)))
        return float(g @ square) / size if size > 0.0 else 0.0

    def _of_process(self, c: Candidate, column: np.ndarray) -> float:
        memory = dict(c.shape).get("memory", FOREVER) if c.process == "ar1" else FOREVER
        now, past = column * self.corrections, np.zeros(self.e.steps)
        total = np.bincount(self.row, now, self.e.steps)
        for t in range(1, len(past)):
            past[t] = memory * (past[t - 1] + total[t - 1])
        g = column * past[self.row]
        size = float(np.sqrt((g @ g) * np.mean(self.corrections[column != 0.0] ** 2)))
        return float(g @ self.corrections) / size if size > 0.0 else 0.0

    def _in_time(self, c: Candidate) -> np.ndarray:
        """(N,) a candidate's function of time: of a step, at the row that it comes from."""
        # the `weights` of a transition stand in the row that it leads to as it is
        before = self.step & (c.change != "transition")
        return c.weights(self.e.steps)[self.row - before]

    def _alone(self, column: np.ndarray) -> np.ndarray:
        """What the model's own parameters leave of a column; nothing where that is rounding."""
        left = column - self._own @ (self._own.T @ column)
        return left if left @ left > ALONE * (column @ column) else np.zeros_like(column)

    @cached_property
    def _own(self) -> np.ndarray:
        """(N, P) an orthonormal basis of what the model's own free parameters can move."""
        fixed = self.fitter.fixed
        free = [s for s in self.trace.parameter_symbols if s.data[1] not in fixed]
        columns = np.stack([self._slopes(self.trace, s) for s in free], axis=1)
        size = np.sqrt(np.sum(columns**2, axis=0))
        left, values, _ = np.linalg.svd(columns[:, size > 0.0] / size[size > 0.0], False)
        return left[:, values > 1e-6]

    @cached_property
    def corrections(self) -> np.ndarray:
        """(N,) by how much the filter corrects each state at each row, and its errors of each
        measurement, in units of their root mean squares: white in a right model."""
        mean, predicted = _filtered(self.fitter, self.fit.theta, self.e)
        at = self._symbols(self.trace, "observation", predicted)
        place = _place(self.trace.state_symbols)
        out = []
        for _, role, s in self.parts:
            if role == "transition":
                left = (mean - predicted)[1:, place[s]]
            else:
                left = self._seen(role, s) - self._law(self.trace, role, s, "mean", at)
            out.append(left / (np.sqrt(np.nanmean(left**2)) or 1.0))
        return np.concatenate(out)[self.kept]

    # -- evaluation along the trajectory
    def _slopes(self, whole: Trace, s: Expr, what: str = "mean") -> np.ndarray:
        """(N,) the derivatives in s of the means, in the disturbances' units, or of the log
        variances; where it is 0 if it is a strength."""
        x, out = self._completed(whole, s), []
        for _, role, target in self.parts:
            root = _moment(whole, role, target, what)
            at = self._symbols(whole, role, x)
            at.setdefault(s, 0.0)
            slope, value = evaluate([*differentiate([root], s), root], at)
            slope = slope / value if what == "variance" else slope
            out.append(np.broadcast_to(slope, (self.e.steps - (role == "transition"),)))
        found = np.concatenate(out)[self.kept]
        return found / self.unit if what == "mean" else found

    def _completed(self, whole: Trace, s: Expr) -> np.ndarray:
        """The trajectory with the further states of an effect, which follow from it."""
        known, symbols = len(self.trace.state_symbols), whole.state_symbols
        if len(symbols) == known:
            return self.x
        place = _place(symbols)
        x = np.zeros((self.e.steps, len(symbols)))
        x[:, [place[s] for s in self.trace.state_symbols]] = self.x
        new = [s for s in symbols if s not in set(self.trace.state_symbols)]
        at = [place[s] for s in new]
        first = self._symbols(whole, "observation", x, slice(0, 1))
        x[0, at] = np.ravel(evaluate([_mean_of(whole.initial, s) for s in new], first | {s: 0.0}))
        roots = [_mean_of(whole.transition, s) for s in new]
        for t in range(1, self.e.steps):
            step = self._symbols(whole, "transition", x, slice(t - 1, t))
            x[t, at] = np.ravel([np.ravel(v)[0] for v in evaluate(roots, step | {s: 0.0})])
        return x

    def _symbols(self, trace: Trace, role: str, x: np.ndarray, rows: slice = slice(None)) -> Values:
        """The values of a trace's symbols in the laws of one role: of the steps from `rows`, of
        which the last has none, or of the measurements at them."""
        e, out = self.e, dict[Expr, np.ndarray | float]()
        out |= zip(self.trace.parameter_symbols, self.fit.theta.tolist(), strict=True)
        inputs = list(zip(trace.input_symbols, e.u.T, strict=True))
        states = list(zip(trace.state_symbols, x.T, strict=True))
        time = np.arange(1.0, e.steps + 1.0)
        if role == "observation":
            out |= {s: v[rows] for s, v in (*inputs, *states, (time_symbol(role), time))}
            return out
        measured = zip(trace.observation_symbols, e.y.T, strict=True)  # which a step may read
        before = (*inputs, *states, *measured)
        out |= {previous(s): v[:-1][rows] for s, v in before}
        out |= {s: v[1:][rows] for s, v in states}  # a new value that another one reads
        out[time_symbol(role)] = time[:-1][rows]
        return out

    def _seen(self, role: str, s: Expr) -> np.ndarray:
        """What became of a part: its states after each step, or what was measured."""
        if role == "transition":
            return self.x[1:, _place(self.trace.state_symbols)[s]]
        k = _place(self.trace.observation_symbols)[s]
        return np.where(self.e.seen[:, k] == 1.0, self.e.y[:, k], np.nan)

    def _law(
        self, trace: Trace, role: str, s: Expr, what: str, at: Values | None = None
    ) -> np.ndarray:
        value = evaluate(_moment(trace, role, s, what), at or self.at[role])
        return np.broadcast_to(value, (self.e.steps - (role == "transition"),))


def _moment(trace: Trace, role: str, s: Expr, what: str) -> Expr:
    """The mean or variance of one component of a transition or observation."""
    sites = trace.transition if role == "transition" else trace.observations
    return _mean_of(sites, s, what)


def _mean_of(sites: dict[str, Site], s: Expr, what: str = "mean") -> Expr:
    site = sites[s.data[1]]
    moment = array(getattr(site.distribution, what)())
    values: Sequence[Expr] = np.broadcast_to(moment.view(np.ndarray), site.shape).ravel().tolist()
    return values[_place(site.value.ravel().tolist())[s]]


def _place(symbols: Sequence[Expr]) -> dict[Expr, int]:
    return {s: i for i, s in enumerate(symbols)}


def _trajectory(fitter: Fitter, theta: np.ndarray, e: Experiment) -> np.ndarray:
    """(T, D) the likeliest states given all the data.

    Raises
    ------
    ValueError : the model has no such trajectory.
    """
    if isinstance(fitter.kalman, KalmanModel):
        return fitter.kalman.smooth(e, theta).mean
    found, given = fitter.problem.program.gaussian, (theta, e.y, e.seen, e.u)
    if isinstance(found, GaussianApproximation):
        mode = None if isinstance(found.by_mode, NotApplicable) else found.laplace(*given)
        x = found.likely_trajectory(*given) if mode is None else mode.x
        if x is not None:
            return x
    raise ValueError(f"{fitter.problem.trace.name}: the likeliest states are not known")


def _filtered(fitter: Fitter, theta: np.ndarray, e: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """(T, D) the filter's means with each row's measurements, and without."""
    if isinstance(fitter.kalman, KalmanModel):
        exact = fitter.kalman.filter(e, theta)
        return exact.mean, exact.mean_predicted
    found = fitter.problem.program.gaussian
    moments = None
    if isinstance(found, GaussianApproximation):
        moments = found.extended(theta, e.y, e.seen, e.u)
    if moments is None:
        raise ValueError(f"{fitter.problem.trace.name}: there is no extended Kalman filter")
    return moments.mean, moments.predicted
