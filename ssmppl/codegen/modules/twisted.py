"""The generated module of the twisted particle filter, and the guide that it goes by.

The guide is computed anew for every theta and data set and handed to the filter as further columns
of the inputs, so that the filter's kernels are the same as for any other proposal. Where the noises
are many, the moves are functions with loops instead; see `kernels/twisted/twisting.py`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.proposals.twisted import (
    LookaheadModel,
    jacobian,
    lookahead_model,
    twisted,
    twisting_order,
)
from ssmppl.codegen.kernels.twisted import lookahead, lookahead_backward, twisting
from ssmppl.codegen.modules.exact import load_kernels
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.kernel_functions import (
    add_conditional_smc,
    add_filters,
    add_predictions,
    conditional_passes,
    filter_functions,
)
from ssmppl.codegen.text.module import (
    PARTICLE,
    Layout,
    ModuleText,
    Section,
    Target,
    level_of,
    listed,
)
from ssmppl.codegen.text.render import depends, identifier
from ssmppl.compiling import once, one_at_a_time
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, constant, symbol
from ssmppl.language.model.trace import Trace

MOST_STEPS = 12  # forward passes that improve the reference
CLOSE = 0.05  # nats of improvement with which they end
SHARES = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried


def twisted_section(
    trace: Trace, layout: Layout, found: LookaheadModel, plain: Proposal
) -> Section:
    """What the moves need to know of the model: its laws by their noise, and back."""
    section = Section(layout, "twisted")
    first, later = found.initial, found.transition
    guide = twisting_order(len(trace.state_symbols), len(first.noise))
    section.s.update((e, k) for k, e in enumerate([constant(float(len(later.noise))), *guide]))
    section.normals, section.uniforms = len(later.noise), 1
    section.fits.update((e, k) for k, e in enumerate(later.noise))
    for role, form, arguments in (
        ("begin", first, "theta, c, s, fits, states"),
        ("follow", later, "theta, c, s, states_prev, fits, states"),
    ):
        targets = [Target(f"states[{k}, i]", e) for k, e in enumerate(form.value)]
        section.particle_pass(role, "x by the noise that drives it.", arguments, targets)
    section.particle_pass(
        "rest", "x_t without noise.", "theta, c, s, states_prev, states",
        [Target(f"states[{k}, i]", e) for k, e in enumerate(later.at_rest())],
    )  # fmt: skip
    section.particle_pass(
        "spread", "dx_t / de without noise.", "theta, c, s, states_prev, states, out",
        listed(later.spread().ravel()),
    )  # fmt: skip
    for role, form, arguments in (
        ("recover_initial", first, "theta, c, s, states, out"),
        ("recover", later, "theta, c, s, states_prev, states, out"),
    ):
        section.particle_pass(role, "The noise by x.", arguments, listed(form.recovered))
    conditional_passes(trace, layout, section, plain)
    kept = 1 + (len(later.noise) * (len(later.noise) + 1) // 2 if varies(found) else 0)
    extra = [symbol("guide", "kept", (k,)) for k in range(kept)]
    section.fits.update((e, len(later.noise) + k) for k, e in enumerate(extra))
    return section


def varies(found: LookaheadModel) -> bool:
    """Whether dx_t / de depends on the particle."""
    spread = list(found.transition.spread().ravel())
    level = depends(spread, level_of)
    return any(level[e] == PARTICLE for e in spread)


def twisted_moves(out: ModuleText, section: Section, found: LookaheadModel) -> dict[str, str]:
    """Write the moves; what the filters' parameters for them stand for."""
    own = {"varies": str(varies(found))}
    for name in twisting.SPECIALISED:
        out.algorithm(vars(twisting)[name], name, section, "exact", dict(own))
        own[name.removeprefix("twisted_")] = name
    return own


@dataclass
class TwistedFilter:
    """The twisted filter of a model: `entry` gives its kernels, `guide` what they go by.

    found : what the guide is made from.
    """

    trace: Trace
    found: LookaheadModel
    proposals: dict[str, Proposal]
    module: Loaded = field(repr=False)
    _room: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    def entry(self, name: str, proposal: str = "twisted", horizon: int = 0) -> Callable[..., Any]:
        """`filter`, `alive_filter`, `filtered_path` or `conditional_smc`, called like those of
        other proposals.

        horizon : rows after which the guide starts anew and so is blind to what comes later; 0:
        never. Up to the last row of each stretch the particles are worth most as a sample of
        what is known by then.
        """
        run = getattr(self.module, f"{name}_{proposal}")

        def call(theta: Any, y: Any, seen: Any, u: Any, *rest: Any) -> Any:
            return run(theta, y, seen, self.guide(theta, y, seen, u, horizon), *rest)

        return call

    def guide(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray, horizon: int = 0
    ) -> np.ndarray:
        """The inputs (T, U), and behind them each row's guide: precision, slope, centre.

        A guide that nothing can be computed of is flat: the particles move by the transition.
        """
        given = (theta, y, seen, u)
        steps, d = len(y), len(self.trace.state_symbols)
        size = len(self.found.transition.noise), len(self.found.initial.noise)
        out = np.zeros((steps, u.shape[1] + len(self.order)))
        out[:, : u.shape[1]] = u
        ones = [k for k, s in enumerate(self.order) if _on_diagonal(s)]
        out[0, u.shape[1] + np.array(ones, dtype=int)] = 1.0
        reference, covariance = self._empty(steps)
        where = reference.x, covariance, *reference.derivatives
        if not self.module.follow_filter(*given, *where) > -np.inf:
            return out
        reference = self._climbed(given, reference)
        back = _Back.empty(steps, d, max(size))
        if backward_passes().look_back(reference.x, *reference.derivatives, horizon, *back.arrays):
            found = out.copy()
            spread = reference.derivatives[3]
            where = back.precision, back.pull, reference.x, u, back.aim[0], spread, found
            if backward_passes().write_guide(*where) and np.all(np.isfinite(found)):
                return found
        return out

    @cached_property
    def order(self) -> list[Expr]:
        """The guide's symbols, in the order of its columns."""
        return twisting_order(len(self.trace.state_symbols), len(self.found.initial.noise))

    def mode(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> np.ndarray | None:
        """About the likeliest trajectory (T, D) given theta; None where it comes to no number."""
        given = (theta, y, seen, u)
        found, covariance = self._empty(len(y))
        where = found.x, covariance, *found.derivatives
        if not self.module.follow_filter(*given, *where) > -np.inf:
            return None
        x = self._climbed(given, found).x
        return x if np.all(np.isfinite(x)) else None

    def _empty(self, steps: int) -> tuple[_Reference, np.ndarray]:
        d = len(self.trace.state_symbols)
        size = len(self.found.transition.noise), len(self.found.initial.noise)
        return _Reference.empty(steps, d, *size), np.empty((steps, d, d))

    def filtered(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Means (T, D) and covariances (T, D, D) of the extended Kalman filter; None where it
        comes to no number."""
        found, covariance = self._empty(len(y))
        where = found.x, covariance, *found.derivatives
        value = self.module.follow_filter(theta, y, seen, u, *where)
        return (found.x, covariance) if value > -np.inf else None

    def extended_log_likelihood(
        self, theta: np.ndarray, y: np.ndarray, seen: np.ndarray, u: np.ndarray
    ) -> float:
        """log p(y | theta) by the extended Kalman filter, whose update is the mode of each row: an
        approximation, exact where the model is linear and Gaussian; -inf where it comes to no
        number, or to none that floating point resolves."""
        if getattr(self._room, "steps", None) != len(y):  # kept: it is called a thousand times
            found, covariance = self._empty(len(y))
            self._room.arrays = found.x, covariance, *found.derivatives
            self._room.follow, self._room.steps = self.module.follow_filter, len(y)
        value = self._room.follow(theta, y, seen, u, *self._room.arrays)
        return float(value) if value < np.inf else -np.inf

    def _climbed(self, given: tuple[np.ndarray, ...], first: _Reference) -> _Reference:
        """The mode of the noise, from a first trajectory that need not follow the model."""
        best, value = first, -np.inf
        widest = first.e.shape[1]
        for k in range(MOST_STEPS):
            back = _Back.empty(len(best.x), best.x.shape[1], widest)
            if not backward_passes().look_back(best.x, *best.derivatives, 0, *back.arrays):
                break
            for share in SHARES if k else (1.0,):
                new = best.like()
                now = self.module.follow_gains(
                    *given, share, best.x, best.e, back.aim, back.gain, new.x, new.e,
                    *new.derivatives,
                )  # fmt: skip
                if now > value:
                    break
            else:
                break
            gained, best, value = now - value, new, now
            if gained < CLOSE:
                break
        return best


def _on_diagonal(node: Expr) -> bool:
    _, name, index = node.data
    return name == "start_factor" and index[0] == index[1]


@dataclass(frozen=True)
class _Reference:
    """A trajectory x (T, D) of noise e (T, R'), and the model's derivatives along it."""

    x: np.ndarray
    e: np.ndarray
    derivatives: tuple[np.ndarray, ...]

    @classmethod
    def empty(cls, steps: int, d: int, r: int, r_initial: int) -> _Reference:
        shapes = [(steps, d), (steps, d, d), (steps, d, r), (d, r_initial)]
        shapes += [(steps, d), (steps, d, d)]
        noise = np.zeros((steps, max(r, r_initial)))
        return cls(np.zeros((steps, d)), noise, tuple(np.zeros(s) for s in shapes))

    def like(self) -> _Reference:
        """An empty one of the same sizes."""
        empty = tuple(np.zeros_like(a) for a in self.derivatives)
        return _Reference(np.zeros_like(self.x), np.zeros_like(self.e), empty)


@dataclass(frozen=True)
class _Back:
    """What a backward pass writes; see `kernels/twisted/lookahead.py`."""

    precision: np.ndarray
    pull: np.ndarray
    aim: np.ndarray
    gain: np.ndarray

    @classmethod
    def empty(cls, steps: int, d: int, widest: int) -> _Back:
        shapes = (steps, d, d), (steps, d), (steps, widest), (steps, widest, d)
        return cls(*(np.zeros(s) for s in shapes))

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.precision, self.pull, self.aim, self.gain


@one_at_a_time
def compile_twisted(trace: Trace, missing: Missing) -> TwistedFilter | NotApplicable:
    """Generate, write and import the twisted filter; the reason where there is none."""
    found, proposal = lookahead_model(trace, missing), twisted(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    assert isinstance(proposal, Proposal)
    layout = Layout(trace, twisting_order(len(trace.state_symbols), len(found.initial.noise)))
    out = ModuleText(layout)
    section = lookahead_functions(layout, trace, found)
    out.add("the guide", section)
    own = {"flat": str(found.flat)}
    out.algorithm(lookahead.look_at, "look_at", section, "exact", own)
    own["look_at"] = "look_at"
    out.algorithm(lookahead.most_likely, "most_likely", section, "exact", own)
    own["most_likely"] = "most_likely"
    for kernel in (lookahead.follow_filter, lookahead.follow_gains):
        out.algorithm(kernel, kernel.__name__, section, "entry", own)
    add_predictions(out, trace, layout, missing)
    plain = bootstrap(trace, missing)
    own = {"ahead": "GUIDED"}
    if found.written_out:
        section = filter_functions(layout, proposal)
        conditional_passes(trace, layout, section, plain)
        out.add(f"particle filter, {proposal.explanation}", section)
    else:
        section = twisted_section(trace, layout, found, plain)
        out.add(f"particle filter, {proposal.explanation}", section)
        own |= twisted_moves(out, section, found)
    add_filters(out, section, own)
    add_conditional_smc(out, section, trace, own)
    lines = [f"Generated by ssmppl: the twisted particle filter of the model {trace.name!r}."]
    module = load(out, identifier(trace.name) + "_twisted", lines)
    return TwistedFilter(trace, found, {proposal.name: proposal}, module)


def lookahead_functions(layout: Layout, trace: Trace, found: LookaheadModel) -> Section:
    """The functions by which the guide's kernels know the model; all of one particle."""
    section = Section(layout, "guide")
    for role, form, arguments in (
        ("begin", found.initial, "theta, c, s, noise, states"),
        ("follow", found.transition, "theta, c, s, states_prev, noise, states"),
    ):
        given: dict[Expr, str] = {e: f"noise[{k}]" for k, e in enumerate(form.noise)}
        targets = [Target(f"states[{k}, i]", e) for k, e in enumerate(form.value)]
        section.particle_pass(role, "x by the noise that drives it.", arguments, targets,
                              scalars=given)  # fmt: skip
    linear_passes(section, trace, found)
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
    """The guide's kernels that know no model, compiled once for all."""
    kernels = (
        lookahead_backward.look_back,
        lookahead_backward.look_back_scalar,
        lookahead_backward.write_guide,
    )
    return load_kernels("guide", "backward passes of the guide", {k.__name__: k for k in kernels})
