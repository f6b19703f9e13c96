"""One transition of a sampler on (parameters, states) given data that change: what the tests of the
joint distribution need, which no public verb gives.

A sampler is prepared once, as `sample` prepares it, on a first data set. Its kernels read the
observations where `Experiment.y` holds them, so new ones are written there in place; where a chain
stands is replaced by the (theta, x) that is handed in, and the sampler's own `step_block` makes one
draw.

PGAS and Gibbs are kernels on (theta, x). Metropolis-Hastings chains carry the run of the likelihood
too, which belongs to the old data. With the exact likelihood it is computed anew. With a particle
filter, its law given (theta, y) is that of a run weighed by its own estimate Z, and is drawn by
independence Metropolis steps on fresh runs at this theta (Andrieu, Doucet and Holenstein 2010,
section 2.4.1), `RUNS` of them: what they start from is forgotten at a geometric rate, by steps
that are nearly all accepted where log Z varies little, as it does over a few rows. The old states
are not used: the run brings its own, drawn from p(x | theta, y).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.data import unpack_parameters
from ssmppl.inference.chains.gibbs import GibbsState
from ssmppl.inference.chains.gibbs_updates import GibbsUpdates, log_joint
from ssmppl.inference.chains.interweaving import NoiseMove
from ssmppl.inference.chains.metropolis_kernel import ChainPoint, Metropolis, WalkState
from ssmppl.inference.chains.pgas import PGASState
from ssmppl.inference.chains.sampling import PreparedChains, SamplingSetup
from ssmppl.inference.exact import histories
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.verbs.sample import METHODS
from ssmppl.language.model.transforms import transforms, unconstrain

RUNS = 20  # independence steps that draw a run of the particle filter given (theta, y)

Renew = Callable[[Problem, np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


@dataclass
class Transitions:
    """The two halves of the successive-conditional simulator.

    problem : with the data that are written over. sampler : as prepared. state : where its chain
    stands; its tuning and random numbers go on from transition to transition. renew : draws y
    (T, K) given (theta, x) where the model's own observation law does not, as the transition names
    y.
    """

    problem: Problem
    sampler: PreparedChains
    state: Any
    rng: np.random.Generator
    stream: np.ndarray
    renew: Renew | None = None
    transforms: Any = field(init=False)
    _prior: GibbsUpdates = field(init=False)

    def __post_init__(self) -> None:
        self._prior = GibbsUpdates(self.problem, ())
        self.transforms = transforms(self.problem.trace)

    def data(self, theta: np.ndarray, path: np.ndarray) -> None:
        """(i) new data given parameters and states, where there are any."""
        e = self.problem.experiments[0]
        if self.renew is not None:
            y = self.renew(self.problem, theta, path, self.rng)
        else:
            out = np.empty((*e.y.shape, 1))
            run = self.problem.program.entry("observe_states")
            run(theta, e.y, e.seen, e.u, self.stream, path[:, :, None], out)
            y = out[:, :, 0]
        self.write(y)

    def write(self, y: np.ndarray) -> None:
        """The data are now y (T, K), with the gaps that they have always had."""
        e = self.problem.experiments[0]
        e.y[:] = np.where(e.seen == 1.0, y, 0.0)
        histories._kept.clear()  # which takes data for what never changes
        for move in self._moves():  # what they know of the data
            for known in ("references", "looks"):
                move.__dict__.pop(known, None)

    def _moves(self) -> list[NoiseMove]:
        steps = self.sampler.step_block.args[0]  # type: ignore[attr-defined]
        further = getattr(steps, "interweaving", None)
        return [m for m in (further.moves if further else ()) if isinstance(m, NoiseMove)]

    def parameters(self, theta: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(ii) one transition of the sampler: new (theta, x), the data held."""
        if isinstance(self.state, PGASState):
            begin = replace(self.state, theta=theta.copy(), paths=(path.copy(),))
        elif isinstance(self.state, GibbsState):
            begin = replace(self.state, theta=theta.copy())
        else:
            begin = replace(self.state, point=self._point(self.state, theta))
        self.state, block = self.sampler.step_block(begin, 1)
        paths = block.draws.get("path_0", [path])  # none in a warmup by an approximation alone
        return block.draws["theta"][0], np.ascontiguousarray(paths[0])

    def _point(self, state: WalkState, theta: np.ndarray) -> ChainPoint:
        kernel: Metropolis = self.sampler.step_block.args[0]  # type: ignore[attr-defined]
        w = kernel.coordinates.at(self.free(theta))
        theta, log_density = kernel.coordinates.parameters(w)
        exact = not hasattr(kernel.likelihood, "settings")
        run = None
        for _ in range(1 if exact else RUNS):
            if kernel.first is None:
                new = kernel.likelihood.run(theta, None, state.stream)
            else:
                new = kernel.likelihood.run_given(theta, kernel.first.at(theta), state.stream)
            if new is None:
                continue
            change = -np.inf if run is None else run.log_likelihood - new.log_likelihood
            if run is None or -np.log(self.rng.uniform()) > change:
                run = new
        assert run is not None, "no particle survives at parameters and data drawn jointly"
        return ChainPoint(w, theta, log_density, run, kernel.proposal.local(w, run))

    def free(self, theta: np.ndarray) -> np.ndarray:
        """The parameters on the unconstrained scale."""
        trace = self.problem.trace
        return unconstrain(trace, theta, unpack_parameters(trace, theta), self.transforms)

    def log_joint(self, theta: np.ndarray, path: np.ndarray) -> float:
        """log p(theta, x, y)."""
        return log_joint(self._prior, theta, [path])


def prepare(
    model: ssm.Model, method: Any, data: dict[str, np.ndarray], warmup: int, seed: int,
    renew: Renew | None = None,
) -> Transitions:  # fmt: skip
    """A sampler made ready on its first data; it adapts in its first `warmup` transitions."""
    problem = pose(model, data)
    root = np.random.SeedSequence(seed)
    setup = SamplingSetup(problem, space_of(problem, {}, {}), {}, 1, warmup, 1, root)
    sampler = METHODS[type(method)].prepare(setup, method)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(77,)))
    stream = random_state(root, 78)
    return Transitions(problem, sampler, sampler.states[0], rng, stream, renew)
