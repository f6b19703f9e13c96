"""The exact filter of linear Gaussian models (Kalman 1960), its start, and its score.

Applies where `structure.linear_gaussian` does. The matrices are put together by compiled code
(`codegen/modules/linear_gaussian.py`) and handed to the compiled filter of
`codegen/kernels/kalman/square_root.py`; the smoother and the sampler are in `kalman_matrices.py`.

Flat components of x_1 (`codegen/kernels/kalman/diffuse.py`): given the flat part the model is an
ordinary one, and given the data the flat part is Gaussian; so everything but the filter runs on the
ordinary model from the mean of that Gaussian, with its root in further columns.

The likelihood and the score run with the states in the order in which the filter passes over the
most zeros (`filter_order`); moments and draws in that of the trace.

The score: the matrices are differentiated as expressions, once for each model; their derivatives
are computed as the matrices themselves are, and meet what one backward pass of the filter says
about their entries (`codegen/kernels/kalman/adjoint.py`). No parameter costs another pass.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ssmppl.analysis.structure import LinearGaussian, linear_gaussian
from ssmppl.codegen.kernels.kalman.square_root import LOG_2PI, OK
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.modules.exact import exact_entry
from ssmppl.codegen.modules.linear_gaussian import (
    MatrixProgram,
    Slope,
    SlopeProgram,
    compile_matrices,
    compile_slopes,
)
from ssmppl.codegen.modules.program import Program
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, Location, NotApplicable, SamplingError
from ssmppl.expressions.arrays import ExprArray
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact import kalman_matrices
from ssmppl.inference.exact.derivatives import Scored
from ssmppl.inference.exact.kalman_matrices import (
    MOST_KEPT,
    Disturbances,
    SmoothedMoments,
    Stopped,
    drawn,
    drawn_by_correction,
    log_likelihoods,
    smoothed,
)
from ssmppl.inference.run.invalid_laws import total_of
from ssmppl.language.model.trace import Trace, once_per_trace

__all__ = ["Disturbances", "Matrices", "SmoothedMoments"]

LEAST_STATES = 4  # from which a single draw is made in the quick way: below, it gains nothing
AGREEMENT = 1e-6  # of log p(y) by two roads; what is worse was lost to rounding
LAWS = {"m": "initial", "P": "initial", "A": "transition", "b": "transition", "Q": "transition",
        "C": "observation", "d": "observation", "R": "observation"}  # fmt: skip


@dataclass(frozen=True)
class Start:
    """x_1 = columns[:, 0] + columns[:, 1:] n + N(0, P), n ~ N(0, I) given the data.

    columns (D, F). log_likelihood : log p(y), and log_given : log p(y | n = 0) that it entails;
    None where no component is flat.
    """

    columns: np.ndarray
    log_likelihood: float | None = None
    log_given: float | None = None

    def log_density(self, log_given: float) -> float:
        """log p(y) from what the ordinary filter says of column 0."""
        return log_given if self.log_likelihood is None else self.log_likelihood


def diffuse_filter(
    model: Matrices, flat: tuple[int, ...], experiment: Experiment, *outputs: Any
) -> tuple[np.ndarray, np.ndarray]:
    """factor (G, G) and right (G,) of the distribution of the flat part; outputs as of the kernel.

    Raises
    ------
    Stopped : the distributions have no density at theta.
    """
    g = len(flat)
    factor, right = np.empty((g, g)), np.empty(g)
    outputs = outputs if len(outputs) > 1 else (*outputs, *[None] * 6)
    status, t = exact_entry("diffuse_filter")(
        model, np.array(flat), experiment.y, experiment.seen, factor, right, *outputs
    )
    if status != OK:
        raise Stopped(status, t)
    return factor, right


def start_of(trace: Trace, flat: tuple[int, ...], model: Matrices, experiment: Experiment) -> Start:
    """The start of the ordinary model that stands for this one, given the data.

    Raises
    ------
    Stopped : the distributions have no density at theta.
    SamplingError : the data do not tell some flat component.
    """
    mean = model.m[:, None]
    if not flat:
        return Start(mean.copy())
    increments = np.empty(experiment.steps)
    factor, right = diffuse_filter(model, flat, experiment, increments)
    for j, i in enumerate(flat):
        if factor[j, j] == 0.0:
            site = trace.law_of(trace.state_symbols[i], "initial")
            raise SamplingError(
                f"the start of {trace.state_symbols[i]!r} is Flat, and the data do not tell it "
                "(together with the components that are Flat before it)",
                fix="give it a proper distribution in @initial, or data that depend on it",
                where=site.distribution.location,
            )
    total = total_of(increments)
    root = scipy.linalg.solve_triangular(factor, np.eye(len(flat)))
    columns = np.zeros((len(mean), 1 + len(flat)))
    columns[:, :1] = mean
    columns[list(flat), 0] += root @ right
    columns[list(flat), 1:] = root
    spread = float(np.log(abs(np.diag(factor))).sum()) - 0.5 * len(flat) * LOG_2PI
    return Start(columns, total, total + spread)


def check_agreement(trace: Trace, start: Start, log_given: float) -> None:
    """Refuse results of a filter that disagrees with the one that found the start.

    Raises
    ------
    SamplingError : rounding errors have grown until nothing was left.
    """
    expected = start.log_given
    if expected is None or abs(log_given - expected) <= AGREEMENT * (1.0 + abs(expected)):
        return
    site = next(s for s in trace.initial.values() if not s.distribution.proper)
    raise SamplingError(
        f"the start of {site.name!r} is Flat, and its effect grows over time until rounding errors "
        f"hide it: log p(y) is {expected:.8g} or {log_given:.8g}, by where it is computed",
        fix="give it a proper distribution in @initial, or its transition some noise",
        where=site.distribution.location,
    )


@dataclass(frozen=True)
class Slopes:
    """Derivatives of a model's matrices in its parameters.

    refused : for each parameter in which some matrix has no derivative, the reason and the place.
    """

    known: tuple[Slope, ...]
    refused: dict[int, tuple[str, Location]]


def slopes(trace: Trace, form: LinearGaussian) -> Slopes:
    """All derivatives of the matrices that are not zero."""
    known: list[Slope] = []
    refused: dict[int, tuple[str, Location]] = {}
    for p, parameter in enumerate(trace.parameter_symbols):
        for field in Matrices._fields:
            entries = list(getattr(form, field).ravel())
            try:
                found = differentiate(entries, parameter)
            except NotDifferentiable as error:
                place = _culprit(trace, LAWS[field], parameter)
                refused.setdefault(p, (f"the {LAWS[field]} distribution: {error.found}", place))
                continue
            known += [
                Slope(p, field, i, e)
                for i, e in enumerate(found)
                if not (e.op == "const" and e.data == 0.0)
            ]
    return Slopes(tuple(known), refused)


def _culprit(trace: Trace, law: str, parameter: Expr) -> Location:
    """Where the distribution is written that has no derivative in the parameter."""
    sites = {
        "initial": trace.initial, "transition": trace.transition,
        "observation": trace.observations,
    }[law]  # fmt: skip
    places = [site.distribution.location for site in sites.values()]
    for site, place in zip(sites.values(), places, strict=True):
        for values in site.distribution.parameters.values():
            try:
                differentiate(list(values.ravel()), parameter)
            except NotDifferentiable:
                return place
    return places[0]


def check_free(trace: Trace, found: Slopes, free: np.ndarray) -> None:
    """Refuse free parameters in which the likelihood has no derivative in closed form.

    Raises
    ------
    ArgumentError : naming the parameter, the distribution and the reason.
    """
    for p, (reason, where) in found.refused.items():
        if free[p]:
            raise ArgumentError(
                f"the score in {trace.parameter_symbols[p]!r} has no closed form: {reason}",
                fix="fix the parameter by fixed={...}, or use a method without gradients",
                where=where,
            )


def score(
    program: MatrixProgram, slope: SlopeProgram, model: Matrices, start: np.ndarray,
    experiment: Experiment, theta: np.ndarray, gradient: np.ndarray,
) -> float:  # fmt: skip
    """Log density of column 0 of the start, of one experiment; to gradient (P,) that of log p(y) is
    added.

    Raises
    ------
    Stopped : the distributions have no density at theta.
    """
    flat, adjoint = program.room(experiment.steps, filled=False)
    increments = np.empty(experiment.steps)
    status, t = exact_entry("adjoints")(
        model, start, experiment.y, experiment.seen, slope.wanted, increments, adjoint
    )
    if status != OK:
        raise Stopped(status, t)
    slope.add_gradient(theta, experiment.y, experiment.seen, experiment.u, flat, gradient)
    return total_of(increments)


@dataclass(frozen=True)
class KalmanMoments:
    """What the exact filter tells about one experiment (T steps, D states, K components of y).

    log_increments : (T,) log p(y_t | y_{1:t-1}), 0 where nothing was measured.
    mean, covariance : (T, D), (T, D, D) of x_t given y_{1:t}; states in the trace's order.
    mean_predicted, covariance_predicted : those of x_t given y_{1:t-1}.
    observation_mean, observation_covariance : (T, K), (T, K, K) of y_t given y_{1:t-1}.
    """

    log_increments: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    mean_predicted: np.ndarray
    covariance_predicted: np.ndarray
    observation_mean: np.ndarray
    observation_covariance: np.ndarray

    @property
    def log_likelihood(self) -> float:
        return total_of(self.log_increments)


@dataclass(frozen=True)
class KalmanModel(Scored):
    """A traced model as a linear Gaussian one, and its filter."""

    form: LinearGaussian

    def matrices(self, experiment: Experiment, theta: np.ndarray) -> Matrices:
        """The matrices at theta (P,), for the rows of one experiment."""
        e = experiment
        return _program(self.trace).matrices(theta, e.y, e.seen, e.u)

    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta.

        A Flat component of x_1 counts with density 1.

        Raises
        ------
        SamplingError : the data do not tell the start of a Flat component.
        """
        d, k = len(self.trace.state_symbols), len(self.trace.observation_symbols)
        nothing = (
            np.empty((0, d)), np.empty((0, d, d)), np.empty((0, d)), np.empty((0, d, d)),
            np.empty((0, k)), np.empty((0, k, k)),
        )  # fmt: skip
        experiments, total, (_, program) = list(experiments), 0.0, _ordered(self.trace)
        if self._shared(experiments):
            e = experiments[0]
            return log_likelihoods(program.matrices(theta, e.y, e.seen, e.u), experiments)
        for e in experiments:
            model, increments = program.matrices(theta, e.y, e.seen, e.u), np.empty(e.steps)
            if self.form.flat:
                try:
                    total += start_of(self.trace, self.form.flat, model, e).log_density(np.nan)
                except Stopped:
                    return -np.inf
                continue
            exact_entry("kalman_filter")(*model, e.y, e.seen, increments, *nothing)
            total += total_of(increments)
        return total

    def _shared(self, experiments: Sequence[Experiment]) -> bool:
        """Whether these are several that have the same matrices and a start that is known, and are
        short enough to keep what the longest one shares."""
        if len(experiments) < 2 or self.form.flat or _ordered(self.trace)[1].by_row:
            return False
        k, d = len(self.trace.observation_symbols), len(self.trace.state_symbols)
        return max(e.steps for e in experiments) * k * (k + d) <= MOST_KEPT

    def draw_each(
        self, experiments: Sequence[Experiment], theta: np.ndarray, streams: Sequence[np.ndarray],
        draws: int = 1,
    ) -> list[np.ndarray]:  # fmt: skip
        """As `draw`, of each experiment with its own stream, or one and the same."""
        one = draws == 1 and all(stream is streams[0] for stream in streams)
        if one and self._shared(experiments):
            model = self.matrices(experiments[0], theta)
            start = model.m[:, None].copy()
            quick = drawn_by_correction(model, start, experiments, streams[0])
            if quick is not None:
                return quick
        return super().draw_each(experiments, theta, streams, draws)

    def filter(self, experiment: Experiment, theta: np.ndarray) -> KalmanMoments:
        """The filter's moments and predictions.

        While the data do not tell a Flat component of x_1, what depends on it has variance inf and
        mean NaN; the increments of the log-likelihood of those steps have a meaning in sum only.

        Raises
        ------
        SamplingError : the distributions have no density at theta; names the step and the
            parameters.
        """
        d, k, steps = (
            len(self.trace.state_symbols), len(self.trace.observation_symbols), experiment.steps
        )  # fmt: skip
        out = KalmanMoments(
            np.empty(steps), np.empty((steps, d)), np.empty((steps, d, d)),
            np.empty((steps, d)), np.empty((steps, d, d)),
            np.empty((steps, k)), np.empty((steps, k, k)),
        )  # fmt: skip
        model, arrays = self.matrices(experiment, theta), vars(out).values()
        if self.form.flat:
            try:
                diffuse_filter(model, self.form.flat, experiment, *arrays)
            except Stopped as stop:
                raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
            return out
        status, t = exact_entry("kalman_filter")(*model, experiment.y, experiment.seen, *arrays)
        if status != OK:
            raise kalman_matrices.failure(self.trace, theta, status, t)
        return out

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """Moments of all states given all data (Rauch, Tung and Striebel 1965).

        Raises
        ------
        SamplingError : the distributions have no density at theta; names the step and the
            parameters.
        """
        return self._smooth(experiment, theta)[0]

    def disturbances(self, experiment: Experiment, theta: np.ndarray) -> Disturbances:
        """Moments of the noises of states and observations given all data (Koopman 1993).

        Raises
        ------
        SamplingError : as of `smooth`.
        """
        found = self._smooth(experiment, theta, noises=True)[1]
        assert found is not None
        return found

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D): by backward sampling, a single
        one of many states by another record (`codegen/kernels/kalman/correction.py`).

        stream : state of the kernels' random numbers, (4,) uint64, advanced in place.

        Raises
        ------
        SamplingError : as of `smooth`.
        """
        model = self.matrices(experiment, theta)
        try:
            start = start_of(self.trace, self.form.flat, model, experiment)
            if draws == 1 and len(model.m) >= LEAST_STATES:
                quick = drawn_by_correction(model, start.columns, [experiment], stream)
                if quick is not None:
                    return quick[0]
            log_given, out = drawn(model, start.columns, experiment, stream, draws)
        except Stopped as stop:
            raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
        check_agreement(self.trace, start, log_given)
        return out

    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.

        Raises
        ------
        ArgumentError : a matrix has no derivative in a free parameter; names it and the reason.
        """
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        found, slope = _slopes(self.trace)
        check_free(self.trace, found, wanted)
        (_, program), total, gradient = _ordered(self.trace), 0.0, np.zeros(len(theta))
        for e in experiments:
            model = program.matrices(theta, e.y, e.seen, e.u)
            try:
                start = start_of(self.trace, self.form.flat, model, e)
                log_given = score(program, slope, model, start.columns, e, theta, gradient)
            except Stopped:
                return -np.inf, np.where(wanted, np.nan, 0.0)
            check_agreement(self.trace, start, log_given)
            total += start.log_density(log_given)
        return total, np.where(wanted, gradient, 0.0)

    def _smooth(
        self, experiment: Experiment, theta: np.ndarray, noises: bool = False
    ) -> tuple[SmoothedMoments, Disturbances | None]:
        model = self.matrices(experiment, theta)
        try:
            start = start_of(self.trace, self.form.flat, model, experiment)
            found, noise = smoothed(model, start.columns, experiment, noises)
        except Stopped as stop:
            raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
        check_agreement(self.trace, start, found.log_likelihood)
        return replace(found, log_likelihood=start.log_density(found.log_likelihood)), noise


_form = once_per_trace(linear_gaussian)


def kalman_model(source: Trace | Program) -> KalmanModel | NotApplicable:
    """The linear Gaussian form of a traced model, derived once; or the reason why it has none."""
    trace = source.trace if isinstance(source, Program) else source
    form = _form(trace)
    return form if isinstance(form, NotApplicable) else KalmanModel(trace, form)


def filter_order(form: LinearGaussian) -> list[int]:
    """The order of the states for a filter's likelihood: that of the trace, or its reverse.

    The reflections of a prediction take the rows of A L one after the other, with L lower
    triangular. In a chain of lags or seasons each state is the one before it, so that from its end
    on a row has one entry right of the diagonal, and the dense row of its head comes last. Models
    with a flat start keep the order, by which they name what the data do not tell.
    """
    n = len(form.m)
    forth, back = list(range(n)), list(range(n))[::-1]
    if form.flat:
        return forth
    return back if _work(form.reordered(back)) < 0.8 * _work(form) else forth


def _work(form: LinearGaussian) -> int:
    """About the multiplications of a prediction's reflections, whose zeros fill up on the way."""
    a, q = (~_zeros(f) for f in (form.A, form.Q))
    n = len(a)
    noise = np.eye(n, dtype=bool)[:, q.any(axis=0)]
    array, total = np.hstack([(a.astype(int) @ np.tri(n, dtype=int)) > 0, noise]), 0
    for i in range(n):
        taken = np.flatnonzero(array[i, i:]) + i
        if len(taken) > 1:
            total += len(taken) * (n - i)
            touched = np.flatnonzero(array[i + 1 :, taken].any(axis=1)) + i + 1
            array[np.ix_(touched, taken)] = True
    return total


def _zeros(field: ExprArray) -> np.ndarray:
    """Which entries are the number zero."""
    flat = [e.op == "const" and e.data == 0.0 for e in field.ravel()]
    return np.array(flat, dtype=bool).reshape(field.shape)


@once_per_trace
def _program(trace: Trace) -> MatrixProgram:
    """The compiled matrices of a linear Gaussian model."""
    form = _form(trace)
    assert not isinstance(form, NotApplicable)
    return compile_matrices(trace, form)


@once_per_trace
def _ordered(trace: Trace) -> tuple[LinearGaussian, MatrixProgram]:
    """The form with the states as the likelihood has them, and its compiled matrices."""
    form = _form(trace)
    assert not isinstance(form, NotApplicable)
    order = filter_order(form)
    if order == sorted(order):
        return form, _program(trace)
    ordered = form.reordered(order)
    return ordered, compile_matrices(trace, ordered)


@once_per_trace
def _slopes(trace: Trace) -> tuple[Slopes, SlopeProgram]:
    """The derivatives of the matrices of `_ordered`, and these compiled."""
    form, program = _ordered(trace)
    found = slopes(trace, form)
    later = [field for field, law in LAWS.items() if law == "transition"]
    return found, compile_slopes(trace, program, found.known, later)


def _applicable(source: Trace | Program) -> KalmanModel:
    model = kalman_model(source)
    if isinstance(model, NotApplicable):
        raise ArgumentError(
            f"the model is not linear and Gaussian: {model.reason}",
            fix='use a particle filter, proposal="auto"',
            where=model.where,
        )
    return model


def kalman_log_likelihood(
    source: Trace | Program, experiments: Iterable[Experiment], theta: np.ndarray
) -> float:
    """Exact log p(y | theta), theta (P,), summed over experiments; -inf where there is none.

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian; gives the reason and the line.
    """
    return _applicable(source).log_likelihood(experiments, theta)


def kalman_filter(
    source: Trace | Program, experiment: Experiment, theta: np.ndarray
) -> KalmanMoments:
    """Everything that the exact filter tells about one experiment at theta (P,).

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian.
    SamplingError : the distributions have no density at theta.
    """
    return _applicable(source).filter(experiment, theta)
