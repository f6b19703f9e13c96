"""The Gaussian approximation of the states given the data, compiled for a model.

Two likelihoods come of it: the extended Kalman filter's, whose update is the mode of each row, and
Laplace's, at the mode of the whole trajectory. Both are approximations, exact where the model is
linear and Gaussian. The twisted filter takes its guide from here.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from types import ModuleType

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.curvature import Bend, bends
from ssmppl.analysis.proposals.twisted import LookaheadModel, jacobian, lookahead_model
from ssmppl.codegen.kernels.gaussian import mode
from ssmppl.codegen.kernels.twisted import lookahead, lookahead_backward
from ssmppl.codegen.modules.exact import load_kernels
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.module import Layout, ModuleText, Section, Target, listed
from ssmppl.codegen.text.render import identifier
from ssmppl.compiling import once, one_at_a_time
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.trace import Trace

MOST_STEPS = 12  # forward passes that improve the reference of a guide
CLOSE = 0.05  # nats of improvement with which they end
SHARES = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried
KICK = 0.1  # of noise, off a point that is stationary and no maximum
LEFT = 1e-6  # nats that Newton's method may leave, relative to 1 + |log-likelihood|


@dataclass
class GaussianApproximation:
    """The Gaussian approximation of a model.

    found : the model by its noises. bent : its second derivatives, or why there are none; Laplace's
    approximation needs them.
    """

    trace: Trace
    found: LookaheadModel
    bent: tuple[Bend, Bend] | NotApplicable
    module: Loaded = field(repr=False)
    _room: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    # -- the extended Kalman filter
    def extended_log_likelihood(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> float:
        """log p(y | theta) by the extended Kalman filter; -inf where it comes to no number, or to
        none that floating point resolves."""
        if getattr(self._room, "steps", None) != len(y):  # kept: it is called a thousand times
            found, covariance = self._empty(len(y))
            self._room.arrays = found.x, covariance, *found.derivatives
            self._room.follow, self._room.steps = self.module.follow_filter, len(y)
        value = self._room.follow(theta, y, seen, u, *self._room.arrays)
        return float(value) if value < np.inf else -np.inf

    def filtered(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Means (T, D) and covariances (T, D, D) of the extended Kalman filter; None where it
        comes to no number."""
        found, covariance = self._empty(len(y))
        value = self.module.follow_filter(
            theta, y, seen, u, found.x, covariance, *found.derivatives
        )
        return (found.x, covariance) if value > -np.inf else None

    # -- the mode of the whole trajectory
    def laplace(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray,
        e: np.ndarray | None = None,
    ) -> Mode | None:  # fmt: skip
        """The mode, and Laplace's log-likelihood there; None where there is none.

        e : noise (T, R') to begin from, such as that of a mode at another theta; None: from the
        extended Kalman filter.
        """
        given = (theta, y, seen, u)
        if e is not None and (out := self._mode(given, e)) is not None:
            return out
        start = self._start(given)
        if start is None:
            return None
        out = self._mode(given, start)
        if out is None:  # a saddle has no slope: what is beside it has
            rng = np.random.default_rng(len(y))
            out = self._mode(given, start + KICK * rng.standard_normal(start.shape))
        return out

    def _mode(self, given: tuple[np.ndarray, ...], e: np.ndarray) -> Mode | None:
        r = len(self.found.initial.noise), len(self.found.transition.noise)
        steps, d, widest = len(e), len(self.trace.state_symbols), max(r)
        shapes = [(steps, widest), (steps, widest, d), (steps, widest, widest)]
        shapes += [(steps, d, d), (steps, d, widest)]
        x, arrays = np.zeros((steps, d)), tuple(np.zeros(s) for s in shapes)
        value, left = self.module.gaussian_mode(*given, r, x, e := e.copy(), *arrays)
        if not (abs(value) < np.inf and left < LEFT * (1.0 + abs(value))):
            return None
        return Mode(float(value), x, e, *arrays[1:])

    def _start(self, given: tuple[np.ndarray, ...]) -> np.ndarray | None:
        """Noise (T, R') of a trajectory near the data, by the extended Kalman filter."""
        first, covariance = self._empty(len(given[1]))
        if not self.module.follow_filter(*given, first.x, covariance, *first.derivatives) > -np.inf:
            return None
        back = Backward.like(first)
        if not backward_passes().look_back(first.x, *first.derivatives, 0, *back.arrays):
            return None
        for share in SHARES:
            new, value = self._follow(given, share, first, back)
            if value > -np.inf:
                return new.e
        return np.zeros_like(first.e)

    # -- the reference of a guide
    def reference(self, given: tuple[np.ndarray, ...]) -> Reference | None:
        """About the likeliest trajectory, with the model's derivatives along it; None where the
        extended Kalman filter comes to no number."""
        best, covariance = self._empty(len(given[1]))
        if not self.module.follow_filter(*given, best.x, covariance, *best.derivatives) > -np.inf:
            return None
        value = -np.inf
        for k in range(MOST_STEPS):
            back = Backward.like(best)
            if not backward_passes().look_back(best.x, *best.derivatives, 0, *back.arrays):
                break
            for share in SHARES if k else (1.0,):
                new, now = self._follow(given, share, best, back)
                if now > value:
                    break
            else:
                break
            gained, best, value = now - value, new, now
            if gained < CLOSE:
                break
        return best

    def _follow(
        self, given: tuple[np.ndarray, ...], share: float, old: Reference, back: Backward
    ) -> tuple[Reference, float]:
        new = old.like()
        value = self.module.follow_gains(
            *given, share, old.x, old.e, back.aim, back.gain, new.x, new.e, *new.derivatives
        )
        return new, value

    def _empty(self, steps: int) -> tuple[Reference, np.ndarray]:
        d = len(self.trace.state_symbols)
        size = len(self.found.transition.noise), len(self.found.initial.noise)
        return Reference.empty(steps, d, *size), np.empty((steps, d, d))


@dataclass(frozen=True)
class Mode:
    """The mode of the noise of a whole trajectory (T rows, D states, R' noises).

    log_likelihood : Laplace's. x (T, D), e (T, R') : states and noise. gain (T, R', D), root (T,
    R', R'), jacobian (T, D, D), spread (T, D, R') : the law round it, in which e_t given x_{t-1} is
    Gaussian with mean e_t - gain_t (x_{t-1} less its mode) and precision root_t root_t'.
    """

    log_likelihood: float
    x: np.ndarray
    e: np.ndarray
    gain: np.ndarray
    root: np.ndarray
    jacobian: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Reference:
    """A trajectory x (T, D) of noise e (T, R'), and the model's derivatives along it."""

    x: np.ndarray
    e: np.ndarray
    derivatives: tuple[np.ndarray, ...]

    @classmethod
    def empty(cls, steps: int, d: int, r: int, r_initial: int) -> Reference:
        """Room for one."""
        shapes = [(steps, d), (steps, d, d), (steps, d, r), (d, r_initial)]
        shapes += [(steps, d), (steps, d, d)]
        noise = np.zeros((steps, max(r, r_initial)))
        return cls(np.zeros((steps, d)), noise, tuple(np.zeros(s) for s in shapes))

    def like(self) -> Reference:
        """An empty one of the same sizes."""
        empty = tuple(np.zeros_like(a) for a in self.derivatives)
        return Reference(np.zeros_like(self.x), np.zeros_like(self.e), empty)


@dataclass(frozen=True)
class Backward:
    """What a backward pass writes; see `kernels/twisted/lookahead_backward.py`."""

    precision: np.ndarray
    pull: np.ndarray
    aim: np.ndarray
    gain: np.ndarray

    @classmethod
    def like(cls, reference: Reference) -> Backward:
        """Room for one along a trajectory."""
        (steps, d), widest = reference.x.shape, reference.e.shape[1]
        shapes = (steps, d, d), (steps, d), (steps, widest), (steps, widest, d)
        return cls(*(np.zeros(s) for s in shapes))

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.precision, self.pull, self.aim, self.gain


@one_at_a_time
def compile_gaussian(trace: Trace, missing: Missing) -> GaussianApproximation | NotApplicable:
    """Generate, write and import it; the reason where there is none."""
    found = lookahead_model(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    bent = bends(found, trace)
    layout = Layout(trace)
    out = ModuleText(layout)
    section = _functions(layout, trace, found, bent)
    out.add("the Gaussian approximation", section)
    own = {"flat": str(found.flat)}
    out.algorithm(lookahead.look_at, "look_at", section, "exact", own)
    own["look_at"] = "look_at"
    out.algorithm(lookahead.most_likely, "most_likely", section, "exact", own)
    own["most_likely"] = "most_likely"
    for kernel in (lookahead.follow_filter, lookahead.follow_gains):
        out.algorithm(kernel, kernel.__name__, section, "entry", own)
    if not isinstance(bent, NotApplicable):
        out.algorithm(mode.gaussian_mode, "gaussian_mode", section, "entry", {})
    lines = [f"Generated by ssmppl: the Gaussian approximation of the model {trace.name!r}."]
    module = load(out, identifier(trace.name) + "_gaussian", lines)
    return GaussianApproximation(trace, found, bent, module)


def _functions(
    layout: Layout, trace: Trace, found: LookaheadModel, bent: tuple[Bend, Bend] | NotApplicable
) -> Section:
    """The functions by which the kernels know the model; all of one particle."""
    section = Section(layout, "gaussian")
    for role, form, arguments in (
        ("begin", found.initial, "theta, c, s, noise, states"),
        ("follow", found.transition, "theta, c, s, states_prev, noise, states"),
    ):
        given: dict[Expr, str] = {e: f"noise[{k}]" for k, e in enumerate(form.noise)}
        targets = [Target(f"states[{k}, i]", e) for k, e in enumerate(form.value)]
        section.particle_pass(role, "x by the noise that drives it.", arguments, targets,
                              scalars=given)  # fmt: skip
    linear_passes(section, trace, found)
    if not isinstance(bent, NotApplicable):
        for role, bend, arguments in (
            ("bend_initial", bent[0], "theta, c, s, noise, states, out"),
            ("bend", bent[1], "theta, c, s, states_prev, noise, states, out"),
        ):
            section.particle_pass(
                role, "Derivatives of x_t, the second ones weighted.", arguments,
                listed(bend.values), scalars={e: f"noise[{k}]" for k, e in enumerate(bend.given)},
            )  # fmt: skip
    return section


def linear_passes(section: Section, trace: Trace, found: LookaheadModel) -> None:
    """The model and the observation's density made linear and quadratic, of one particle."""
    d = len(trace.state_symbols)
    first, later = found.initial, found.transition
    section.particle_pass(
        "linear_initial", "x_1 without noise, and its derivatives in the noise.",
        "theta, c, s, states, out", listed([*first.at_rest(), *first.spread().ravel()]),
    )  # fmt: skip
    section.particle_pass(
        "linear", "x_t without noise, its derivatives in x_{t-1} and in the noise.",
        "theta, c, s, states_prev, states, out",
        listed([*later.at_rest(), *jacobian(later, trace).ravel(), *later.spread().ravel()]),
    )  # fmt: skip
    lower = [found.curvature[i, j] for i in range(d) for j in range(i + 1)]
    section.particle_pass(
        "look", "log g(y_t | x_t), its slope, minus its curvature.", "theta, c, s, states, out",
        listed([found.observed, *found.slope, *lower]),
    )  # fmt: skip


@once
def backward_passes() -> ModuleType:
    """The backward kernels that know no model, compiled once for all."""
    kernels = (
        lookahead_backward.look_back,
        lookahead_backward.look_back_scalar,
        lookahead_backward.write_guide,
    )
    return load_kernels("guide", "backward passes of the guide", {k.__name__: k for k in kernels})
