"""Gibbs sampling interweaved with moves of the parameters that take the states along.

Given the states, a parameter is known much better than given the data alone where the states carry
what the data tell of it: the scale of their noise above all. Gibbs sampling then crawls, however
well the states mix. So each sweep has further steps, in which theta moves while not the states x
are held but their noises (Yu and Meng 2011, "To center or not to center: that is not the question -
an ancillarity-sufficiency interweaving strategy (ASIS)", *JCGS* 20; Kastner and Frühwirth-Schnatter
2014 for state space models):

1. e = T_theta(x), the noises of the trajectory (`codegen/kernels/twisted/interweaving.py`), T_theta
   one to one for every theta;
2. theta' by a symmetric random walk on the unconstrained scale z, x' = T_theta'^{-1}(e);
3. accepted with probability min(1, pi(theta', x') / pi(theta, x)), where

       pi(theta, x) = p(theta, x, y) |d theta / dz| |dx / de|.

Why this leaves p(theta, x | y) invariant: (z, e) is a change of variables of (theta, x), whose
Jacobian is block triangular (theta depends on z alone), |d theta / dz| |dx / de|. So pi is the
density of (z, e) given y, and steps 2 and 3 are a Metropolis step on z given e, in detailed balance
with it; step 1 and its inverse change variables only. (It is a group move in the sense of Liu and
Sabatti 2000, "Generalised Gibbs sampler", *Biometrika* 87, with Metropolis in place of a draw.) The
map may depend on data and on anything fixed before the chains start, but on no state of a chain.

Two maps are at hand (`NoiseMove`). The noises of the model's distributions are plain non-centring.
Those of a Gaussian approximation to p(x | y, theta) take the data into the map: on a linear
Gaussian model, where it is exact, pi(theta, x) is p(theta | y) times a function of e alone, a
Metropolis step on the marginal; elsewhere nearly so. (Compare Murray and Adams 2010, "Slice
sampling covariance hyperparameters of latent Gaussian models"; Tan 2023, "Efficient data
augmentation techniques for some classes of state space models", *Statistical Science* 38, where the
data choose location and scale of the states.) Where the states can be drawn exactly, the step is on
p(theta | y) itself, before they are drawn (`Collapsed`). There more numbers than a random walk can
move at once are also proposed about a mode m of p(z | y): z' = m + sqrt(1 - s^2) (z - m) + s N(0,
C), which keeps N(m, C), C from the information at m (Cotter, Roberts, Stuart and White 2013, "MCMC
methods for functions: modifying old algorithms to make them faster", *Statistical Science* 28; here
with the posterior's own Gaussian approximation in place of the prior). One step of a sweep remains
a random walk, for tails that are not Gaussian.

All choices are made in the warmup: which parameters move (those slow in the plain chain at its
beginning), the walk's covariance, which of the maps; afterwards the kernel is fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ssmppl.analysis.proposals.noises import Noises, noises
from ssmppl.codegen.kernels.data_sets.each import (
    linearise_each,
    noise_of_each,
    path_of_each,
)
from ssmppl.codegen.modules.gaussian import GaussianApproximation, backward_passes_of_each
from ssmppl.codegen.modules.interweaving import compile_noises
from ssmppl.codegen.native.entries import over_data_sets
from ssmppl.codegen.native.loading import Loaded
from ssmppl.compiling import once_property
from ssmppl.data import unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.chains.gibbs_updates import log_joints
from ssmppl.inference.chains.metropolis_kernel import RandomWalk
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.exact.hidden_markov import HiddenMarkov
from ssmppl.inference.optimisation.newton import climb
from ssmppl.inference.preparation.exact_models import ExactModel
from ssmppl.inference.preparation.method_choice import LEAST_WARMUP
from ssmppl.inference.preparation.pilot import Pilot
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.problem import Problem, joined
from ssmppl.inference.updates.slices import comparable
from ssmppl.language.model.transforms import free_number, parameter_bounds, transforms, unconstrain

Paths = list[np.ndarray]
_NO_GUIDE = np.empty((0, 0, 0)), np.empty((0, 0)), np.empty((0, 0))
PROPOSALS = 4  # a sweep
LOOK = 0.25  # share of the warmup in which "auto" looks at the plain chain
LONGEST_LOOK = 400  # sweeps
FEW = 6  # numbers that a random walk moves at once without trouble
SLOW = 0.5  # lag-1 autocorrelation from which a parameter moves
WALK = RandomWalk()
MOST = 30  # free numbers up to which the mode is climbed to by differences: F^2 likelihoods a step
SHARE = 0.5  # of a step about the mode that is drawn anew, at first
ACCEPTED = 0.4  # of such steps, to which the share is adapted
LEAST_SHARE = 1e-3


class Move(Protocol):
    """How a proposal of theta is weighed and what it takes along: the trajectory by its noises, or
    nothing. Both log densities are of theta on its own scale given what is held, up to a constant:

        NoiseMove   log p(theta, x, y) + log |dx / de|, the noises e held
        Collapsed   log p(theta, y), the states integrated out
    """

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, Any]:
        """(log density, what is held fixed); nothing can be moved from where it is not finite."""

    def at(self, theta: np.ndarray, held: Any, paths: Paths) -> tuple[float, Paths]:
        """(log density, trajectories) at another theta; -inf where there is none."""


@dataclass(frozen=True)
class NoiseMove:
    """The trajectory follows theta with its noises held fixed.

    found : the model by its noises. steered : whether they are those of the Gaussian approximation
    to the states' posterior, made at each theta along the trajectory that is likeliest at `near`.
    """

    problem: Problem
    found: Noises
    steered: bool
    near: np.ndarray

    def __getstate__(self) -> dict:
        return {f.name: self.__dict__[f.name] for f in fields(self)}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)

    @once_property
    def module(self) -> Loaded:
        return compile_noises(self.problem.trace, self.found, self.steered)

    @cached_property
    def references(self) -> np.ndarray | None:
        """The trajectories to linearise along, end to end (R, D); None where some data set has
        none. They depend on no chain, and never change: see the kernel."""
        gaussian = self.problem.program.gaussian if self.steered else None
        if not isinstance(gaussian, GaussianApproximation):
            return None
        parts = []
        for e in self.problem.experiments:
            part = gaussian.likely_trajectory(self.near, e.y, e.seen, e.u)
            if part is None:
                return None
            parts.append(part)
        return joined(parts)

    def stands_near(self) -> bool:
        """Whether every experiment has a guide at `near`; elsewhere it hardly has, if not there."""
        return self._guide(self.near) is not None

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, np.ndarray]:
        every, rows = self.problem.end_to_end, joined(paths)
        widest = max(len(self.found.initial.noise), len(self.found.transition.noise))
        held, log_volume = np.empty((len(rows), widest)), np.empty(len(paths))
        guide = self._guide(theta)
        if guide is None:
            return -np.inf, held
        run = over_data_sets(noise_of_each, self.module.noise_of)
        run(theta, *every.data, *guide, rows, held, log_volume)
        return self._density(theta, rows, log_volume), held

    def at(self, theta: np.ndarray, held: np.ndarray, paths: Paths) -> tuple[float, Paths]:
        every, rows, guide = self.problem.end_to_end, joined(paths), self._guide(theta)
        if guide is None:
            return -np.inf, paths
        new, log_volume = np.empty_like(rows), np.empty(len(paths))
        run = over_data_sets(path_of_each, self.module.path_of)
        if not run(theta, *every.data, *guide, rows, held, new, log_volume):
            return -np.inf, paths
        return self._density(theta, new, log_volume), every.split(new)

    def _density(self, theta: np.ndarray, rows: np.ndarray, log_volume: np.ndarray) -> float:
        """log p(x, y | theta) + log |dx / de|; deterministic components are set on the way."""
        parts = self._log_joints(theta, rows)
        with np.errstate(all="ignore"):
            total = np.cumsum(np.stack([log_volume, parts], axis=1))[-1]
        return comparable(float(total))

    def _log_joints(self, theta: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return log_joints(self.problem, theta, rows)

    def _guide(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """A (R, D, D), g (R, D) and their centre (R, D); None where they are not finite."""
        if not self.steered:
            return _NO_GUIDE
        x = self.references
        if x is None:
            return None
        every = self.problem.end_to_end
        (rows, d), n = x.shape, len(every.first) - 1
        r, r_initial = len(self.found.transition.noise), len(self.found.initial.noise)
        shapes = (rows, d), (rows, d, d), (rows, d, r), (n, d, r_initial)
        derivatives = [np.zeros(s) for s in shapes]
        looking = not self.looks
        g, h = self.looks[0] if self.looks else (np.empty((rows, d)), np.empty((rows, d, d)))
        linearise = over_data_sets(linearise_each, self.module.linearise)
        if not linearise(theta, *every.data, x, looking, *derivatives, g, h):
            return None
        if looking and not self.data_told_by:
            self.looks.append((g, h))
        a, pull = np.empty((rows, d, d)), np.empty((rows, d))
        given = (every.first, x, *derivatives, g, h)
        if d == r == r_initial == 1:
            fine = backward_passes_of_each().look_back_scalar_each(*given, a, pull)
        else:
            widest = max(r, r_initial)
            rest = np.empty((rows, widest)), np.empty((rows, widest, d))
            fine = backward_passes_of_each().look_back_each(*given, a, pull, *rest)
        return (a, pull, x) if fine else None

    @cached_property
    def looks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """What the data say of the references, where no parameter stands in it, once known."""
        return []

    @cached_property
    def data_told_by(self) -> bool:
        """Whether a parameter is in the distribution of an observation."""
        assert not isinstance(self.found.lookahead, NotApplicable)
        return any(s.data[0] == "parameter" for s in symbols_of(self.found.lookahead.observed))


@dataclass(frozen=True)
class Collapsed:
    """The states are integrated out by the exact likelihood, and drawn anew after the move."""

    problem: Problem
    model: ExactModel

    def about(self, space: Space, near: np.ndarray) -> Reference | None:
        """A mode of the posterior near z (free,), and the curvature there; None where it has none
        or there are too many numbers."""
        experiments = self.problem.experiments

        def log_density(z: np.ndarray) -> float:
            theta, prior = space.parameters(z)
            value = -np.inf if prior == -np.inf else self.model.log_likelihood(experiments, theta)
            return value + prior if value > -np.inf else value

        top = climb(log_density, near) if len(near) <= MOST else None
        if top is None or not np.all(np.isfinite(top.information)):
            return None
        positive = np.linalg.eigvalsh(top.information)[0] > 0.0
        return Reference(top.z, top.information) if positive else None

    def stand(self, theta: np.ndarray, paths: Paths) -> tuple[float, None]:
        return comparable(self.model.log_likelihood(self.problem.experiments, theta)), None

    def at(self, theta: np.ndarray, held: None, paths: Paths) -> tuple[float, Paths]:
        return self.stand(theta, paths)[0], paths


@dataclass(frozen=True)
class Reference:
    """A Gaussian of the free numbers z: mode (free,), precision (free, free)."""

    mode: np.ndarray
    precision: np.ndarray

    def moved(
        self, z: np.ndarray, where: np.ndarray, share: float, normals: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """z (free,) with those at `where` moved in detailed balance with the Gaussian, given the
        others; and the log of its density before over that after."""
        away = z - self.mode
        own = self.precision[np.ix_(where, where)]
        others = np.delete(np.arange(len(z)), where)
        shift = np.linalg.solve(own, self.precision[np.ix_(where, others)] @ away[others])
        root, before = np.linalg.cholesky(own), away[where] + shift
        step = np.linalg.solve(root.T, normals)
        after = np.sqrt(1.0 - share**2) * before + share * step
        trial = z.copy()
        trial[where] = self.mode[where] - shift + after
        return trial, 0.5 * float(np.sum((root.T @ after) ** 2) - np.sum((root.T @ before) ** 2))


@dataclass(frozen=True)
class Interweaving:
    """The further steps of a chain, as far as they are the same for all chains.

    moves : what can be held fixed. movable : positions, among the free numbers on the unconstrained
    scale, of those that may move. scale : (d,) of the first steps.
    adapting : sweeps of the warmup. looking : of these, the first, plain, by which "auto" decides.
    bounds : of all components of theta, where they are numbers. near : (free,) about the mode.
    """

    space: Space
    moves: tuple[Move, ...]
    movable: np.ndarray
    scale: np.ndarray
    adapting: int
    looking: int
    bounds: list[tuple[float, float]] | None
    near: np.ndarray | None = None

    def __getstate__(self) -> dict:
        return {f.name: self.__dict__[f.name] for f in fields(self)}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)

    @once_property
    def reference(self) -> Reference | None:
        """What the steps about the mode are made by; None where there are none."""
        if self.near is None or not isinstance(self.moves[0], Collapsed):
            return None
        return self.moves[0].about(self.space, self.near)

    def begin(self) -> InterweavingTuning:
        """What a new chain begins with."""
        if self.looking:
            return InterweavingTuning(0, None, (), None, ())
        return self._tune(InterweavingTuning(0, None, (), None, ()), self.movable)

    def _tune(self, tuning: InterweavingTuning, where: np.ndarray) -> InterweavingTuning:
        size = 2.4 / np.sqrt(max(len(where), 1))
        factors = tuple(size * np.diag(self.scale[where]) for _ in self.moves)
        chosen, won = 0 if len(self.moves) == 1 or not self.adapting else None, (0,) * len(factors)
        return replace(tuning, where=where, factors=factors, chosen=chosen, seen=(), won=won)

    def step(
        self, tuning: InterweavingTuning, theta: np.ndarray, paths: Paths,
        generator: np.random.Generator,
    ) -> tuple[InterweavingTuning, float]:  # fmt: skip
        """One sweep's steps; theta and paths in place. Returns the share that was accepted."""
        sweep = tuning.sweep
        if tuning.where is None:
            tuning = replace(tuning, seen=(*tuning.seen, self._free(theta)))
            if sweep + 1 >= self.looking:
                tuning = self._tune(tuning, self._slow(tuning.seen))
            return replace(tuning, sweep=sweep + 1), 0.0
        accepted, made = 0, 0
        if len(tuning.where):
            if tuning.chosen is None and sweep >= self.adapting:
                tuning = replace(tuning, chosen=_farthest(tuning))
            for k in range(len(self.moves)):
                if tuning.chosen is None or tuning.chosen == k:
                    factor, share, won = self._propose(k, tuning, theta, paths, generator)
                    accepted, made = accepted + won, made + PROPOSALS
                    factors = (*tuning.factors[:k], factor, *tuning.factors[k + 1 :])
                    tuning = replace(tuning, factors=factors, share=share)
                    if tuning.chosen is None:
                        wins = (*tuning.won[:k], tuning.won[k] + won, *tuning.won[k + 1 :])
                        tuning = replace(tuning, won=wins)
        return replace(tuning, sweep=sweep + 1), accepted / made if made else 0.0

    def _propose(
        self, k: int, tuning: InterweavingTuning, theta: np.ndarray, paths: Paths,
        generator: np.random.Generator,
    ) -> tuple[np.ndarray, float, int]:  # fmt: skip
        """Metropolis steps with one thing held fixed; (adapted factor, adapted share, number
        accepted)."""
        move, where, factor, share = self.moves[k], tuning.where, tuning.factors[k], tuning.share
        assert where is not None
        reference = self.reference if len(where) > FEW else None
        value, held = move.stand(theta, paths)
        z = self._free(theta)
        _, prior = self.space.parameters(z)
        value += prior
        if not abs(value) < np.inf:
            return factor, share, 0
        d, won = len(where), 0
        target = 0.44 if d == 1 else 0.35 if d == 2 else 0.234
        for j in range(PROPOSALS):
            normals = generator.standard_normal(d)
            trial, balance = z.copy(), 0.0
            if about := reference is not None and j > 0:
                trial, balance = reference.moved(z, where, share, normals)
            else:
                trial[where] += factor @ normals
            new, prior = self.space.parameters(trial)
            probability, moved = 0.0, paths
            if prior > -np.inf:
                log_density, moved = move.at(new, held, paths)
                change = log_density + prior - value
                probability = min(1.0, float(np.exp(min(change + balance, 0.0))))
            if generator.uniform() < probability:
                theta[:], z, value = new, trial, value + change
                paths[:] = moved
                won += 1
            if tuning.sweep < self.adapting:
                at = (tuning.sweep - self.looking) * PROPOSALS + j
                if about:
                    size = share * np.exp((probability - ACCEPTED) / np.sqrt(at + 1.0))
                    share = float(np.clip(size, LEAST_SHARE, 1.0))
                else:
                    factor = WALK.adapt(factor, normals, probability - target, at)
        return factor, share, won

    def _free(self, theta: np.ndarray) -> np.ndarray:
        """The free numbers on the unconstrained scale."""
        trace = self.space.problem.trace
        if self.bounds is not None:  # much the fastest, and most models are so
            pairs = zip(theta.tolist(), self.bounds, strict=True)
            return np.array([free_number(v, *b) for v, b in pairs])[self.space.positions]
        return unconstrain(trace, theta, unpack_parameters(trace, theta))[self.space.positions]

    def _slow(self, seen: Sequence[np.ndarray]) -> np.ndarray:
        """Which numbers move: those whose plain chain is slow, by the lag-1 autocorrelation of its
        later half (a drift towards the posterior counts as slow); where some are, all, as they may
        depend on each other, if they are few or move about the mode."""
        z = np.array(seen)[len(seen) // 2 :]
        z = z - z.mean(axis=0)
        lagged = (z[1:] * z[:-1]).sum(axis=0) / np.maximum((z**2).sum(axis=0), 1e-300)
        slow = lagged[self.movable] > SLOW
        if slow.any() and (len(slow) <= FEW or self.reference is not None):
            return self.movable
        return self.movable[slow]


@dataclass(frozen=True)
class InterweavingTuning:
    """What a chain has learned; part of its state.

    sweep : how many it has made. where : positions of the numbers that move; None while it looks,
    empty where none does. factors : of each move's walk, (d, d). chosen : the move that is made;
    None while all are tried. seen : (d_free,) of each sweep while it looks. won : of each
    move, steps that were accepted while all were tried. share : of a step about the mode that is
    drawn anew.
    """

    sweep: int
    where: np.ndarray | None
    factors: tuple[np.ndarray, ...]
    chosen: int | None
    seen: tuple[np.ndarray, ...]
    won: tuple[int, ...] = ()
    share: float = SHARE


def _farthest(tuning: InterweavingTuning) -> int:
    """The move of the greatest accepted steps times their squared size |S|^(2/d), the speed at
    which its walk spreads. All are tuned to one rate of acceptance, so that mostly the widest wins;
    but one that can seldom or never be made, where the guide is no number, stays as wide as it
    began."""
    with np.errstate(divide="ignore"):
        won = np.log(np.array(tuning.won, dtype=float))
    size = [float(np.mean(np.log(np.diag(f)))) for f in tuning.factors]
    return int(np.argmax(won + 2.0 * np.array(size)))


def applicable(found: Noises | NotApplicable, model: ExactModel | None) -> Noises | NotApplicable:
    """The model by its noises, or why nothing is interweaved. model : the exact form, if any."""
    if isinstance(model, HiddenMarkov):
        return NotApplicable("the states take finitely many values")
    return found


def requested_noises(
    problem: Problem, setting: str | bool, model: ExactModel | None
) -> Noises | NotApplicable:
    if setting is False:
        return NotApplicable("interweave=False")
    found = applicable(noises(problem.trace, problem.program.missing), model)
    if isinstance(found, NotApplicable) and setting is True:
        raise _refused(found)
    return found


def _refused(found: NotApplicable) -> ArgumentError:
    return ArgumentError(
        f"interweave=True does not apply: {found.reason}",
        fix='use interweave="auto" or False',
        where=found.where,
    )


def prepare_interweaving(
    setup: SamplingSetup, setting: str | bool, pilot: Pilot, model: ExactModel | None = None
) -> tuple[Interweaving | None, str]:
    """The further steps of a method's chains, and in words what they are or why there are none.

    model : where the states are drawn exactly, and so can be integrated out.

    Raises
    ------
    ArgumentError : `interweave` is True and cannot be.
    """
    found = requested_noises(setup.problem, setting, model)
    if isinstance(found, NotApplicable):
        return None, f"none: {found.reason}"
    space, adapting = setup.space, setup.warmup * setup.thin
    if not len(space.positions):
        return None, "none: no parameter is free"
    if setting == "auto" and adapting < LEAST_WARMUP:
        return None, f"none: fewer than {LEAST_WARMUP} sweeps of warmup, too few to tune them"
    near = space.parameters(pilot.z)[0]
    steered = not isinstance(found.lookahead, NotApplicable)
    moves: list[Any] = []
    if model is not None:
        moves = [Collapsed(setup.problem, model)]
    elif steered:
        moves = [NoiseMove(setup.problem, found, True, near)]
        if not moves[0].stands_near():
            reason = "the Gaussian approximation to the states' posterior is not finite"
            none = NotApplicable(reason)
            found, steered, moves = replace(found, lookahead=none), False, []
            if not found.parameters:
                if setting is True:
                    raise _refused(none)
                return None, f"none: {reason}"
    if model is None and found.parameters:
        moves.append(NoiseMove(setup.problem, found, False, near))
    names = found.tied
    owner = [t.site.name for t in transforms(setup.problem.trace) for _ in t.free]
    movable = np.array([k for k, i in enumerate(space.positions) if owner[i] in names], dtype=int)
    if not len(movable):
        return None, "none: no free parameter is in the distribution of a state"
    looking = 0 if setting is True else min(int(LOOK * adapting), LONGEST_LOOK)
    bounds = parameter_bounds(setup.problem.trace)
    steps = Interweaving(
        space, tuple(moves), movable, pilot.scale, adapting, looking, bounds,
        None if model is None else pilot.z,
    )  # fmt: skip
    moved = ", ".join(dict.fromkeys(owner[space.positions[k]] for k in movable))
    who = f"those with high autocorrelation in the plain chain, of {moved}" if looking else moved
    return steps, f"{who}: moved with {describe_interweaving(found, model)}"


def describe_interweaving(found: Noises, model: ExactModel | None) -> str:
    """What is held fixed, in words."""
    if model is not None:
        return "the states integrated out"
    held = []
    if not isinstance(found.lookahead, NotApplicable):
        held.append("the noises of a Gaussian approximation to the states' posterior")
    if found.parameters:
        held.append("the noises of the transition")
    text = " or ".join(held) + " held fixed"
    return (
        text + ", whichever has the larger expected squared jump distance"
        if len(held) > 1
        else text
    )


def with_states(found: Noises) -> str:
    """Who may move with the trajectory, how and why: a line of the plan."""
    steered = not isinstance(found.lookahead, NotApplicable)
    who = ", ".join(found.tied if steered else found.parameters)
    text = (
        f"{who}: if warmup autocorrelation is high, also updated jointly with the trajectory in a "
        f"non-centred parametrisation, {describe_interweaving(found, None)}"
    )
    if isinstance(found.lookahead, NotApplicable):
        text += f" (no Gaussian approximation: {found.lookahead.reason})"
    centred = dict.fromkeys((*found.initial.centred, *found.transition.centred))
    return text + (f"; others stay centred: {', '.join(centred)}" if centred else "")
