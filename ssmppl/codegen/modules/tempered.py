"""The generated module of the tempered particle filter, and how it is run.

See `codegen/kernels/particle/tempered_filter.py`. Every estimate is two runs: a pilot of few
particles, which chooses temperatures and steps of the walk, and the run that counts, for which they
are given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.proposals.tempered import Tempered, tempered
from ssmppl.codegen.kernels.math.random import uniform
from ssmppl.codegen.kernels.particle.conditional_smc import ancestral_path, draw_index
from ssmppl.codegen.kernels.particle.tempered_filter import tempered_filter
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.kernel_functions import (
    WEIGH_CONNECTED,
    WEIGH_INITIAL,
    add_predictions,
    moves,
    weight_targets,
)
from ssmppl.codegen.text.module import Layout, ModuleText, Section
from ssmppl.codegen.text.render import identifier
from ssmppl.compiling import one_at_a_time
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.language.model.trace import Trace

MOVES, MOST_MOVES = 2, 8  # Metropolis steps at each temperature: so many and one for each component
LEVELS = 30  # temperatures of a row at most
PILOT = 200  # particles of the run that chooses, at most


@dataclass
class TemperedFilter:
    """The tempered filter of a model; `entry` gives its kernels.

    proposals : by its name, what it begins with.
    """

    trace: Trace
    found: Tempered
    proposals: dict[str, Proposal]
    module: Loaded = field(repr=False)

    def entry(self, name: str, proposal: str = "tempered") -> Callable[..., Any]:
        """`filter` or `filtered_path`, called like those of other proposals.

        Raises
        ------
        ArgumentError : there is no such kernel with tempering.
        """
        own: dict[str, Callable[..., Any]] = {
            "filter": self._filter, "filtered_path": self._filtered_path,
        }  # fmt: skip
        if name not in own:
            raise ArgumentError(
                f'proposal="tempered" is a proposal of particle filters, and this method runs '
                f"another kernel, {name}",
                fix='use proposal="auto" or "bootstrap" here; log_likelihood, particle_filter, '
                "FFBSi and PMMH temper",
            )
        return own[name]

    def _filter(
        self, theta: Any, y: Any, seen: Any, u: Any, particles: int, scheme: Any,
        ess_threshold: float, rng: np.ndarray, log_increment: np.ndarray, ess: np.ndarray,
        moments: Any, kept: Any = None,
    ) -> tuple[int, int]:  # fmt: skip
        """As of `particle_filter`; resampling is systematic, at every row and temperature."""
        data, d = (theta, y, seen, u), len(self.trace.state_symbols)
        first = np.array(self.found.moved_initial, dtype=np.int64)
        later = np.array(self.found.moved, dtype=np.int64)
        counts = np.ones(len(y), dtype=np.int64)
        temperatures, factors = np.ones((len(y), LEVELS)), np.zeros((len(y), LEVELS, d, d))
        schedule = counts, temperatures, factors
        run, pilot = self.module.filter_tempered, min(max(particles // 2, 20), PILOT)
        scratch = np.empty(len(y)), np.empty(len(y))
        moves = min(MOVES + int(later.sum()), MOST_MOVES)
        # rows behind one at which the pilot ends are not tempered
        run(*data, pilot, moves, first, later, True, *schedule, rng, *scratch, None)
        return run(
            *data, particles, moves, first, later, False, *schedule, rng, log_increment, ess,
            moments, kept,
        )  # fmt: skip

    def _filtered_path(
        self, theta: Any, y: Any, seen: Any, u: Any, particles: int, rng: np.ndarray,
        trajectory: np.ndarray, log_increment: np.ndarray,
    ) -> tuple[int, int, float]:  # fmt: skip
        steps, d = trajectory.shape
        x, w = np.empty((steps, d, particles)), np.empty((steps, particles))
        kept = x, w, np.zeros((steps, particles), dtype=np.int32)
        status, t = self._filter(
            theta, y, seen, u, particles, None, 1.0, rng, log_increment, np.empty(steps), None, kept
        )
        if status != OK:
            return status, t, -np.inf
        ancestral_path(x, kept[2], draw_index(w[-1], uniform(rng)), trajectory)
        return status, t, float(log_increment.sum())


@one_at_a_time
def compile_tempered(trace: Trace, missing: Missing) -> TemperedFilter | NotApplicable:
    """Generate, write and import the tempered filter; the reason where there is none."""
    found = tempered(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    plain, layout = bootstrap(trace, missing), Layout(trace)
    proposal = replace(
        plain,
        name="tempered",
        explanation="particles move by the transition, are weighed by powers of the observation's "
        "density, and take Metropolis steps between them",
        unsuited="these filters weigh a row once, without temperatures",
    )
    out = ModuleText(layout)
    add_predictions(out, trace, layout, missing)
    section = Section(layout, "tempered")
    moves(section, plain.initial_draw, plain.draw)
    section.particle_pass(
        "log_initial", "log mu(x_1).", WEIGH_INITIAL, weight_targets(found.initial),
        accumulate="log_w",
    )  # fmt: skip
    section.particle_pass(
        "log_transition", "log f(x_t | x_{t-1}).", WEIGH_CONNECTED,
        weight_targets(found.transition), accumulate="log_w",
    )  # fmt: skip
    section.particle_pass(
        "weigh_observed", "log g(y_t | x_t).", WEIGH_INITIAL, weight_targets(plain.weight),
        accumulate="log_w",
    )  # fmt: skip
    out.add(f"particle filter, {proposal.explanation}", section)
    out.algorithm(tempered_filter, "filter_tempered", section, "entry", {"predict": "predict"})
    lines = [f"Generated by ssmppl: the tempered particle filter of the model {trace.name!r}."]
    module = load(out, identifier(trace.name) + "_tempered", lines)
    return TemperedFilter(trace, found, {proposal.name: proposal}, module)
