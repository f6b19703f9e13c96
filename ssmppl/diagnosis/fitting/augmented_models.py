"""Augmented models, made once and fitted often: their code, their shapes, their proposal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.compiling import LOCK
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.model.augment import augment, with_given_parameters
from ssmppl.diagnosis.model.basis import symbolic_shapes
from ssmppl.diagnosis.model.initial_law import ProperInitialLaw, needs_proper_initial_law
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.run.problem import Problem
from ssmppl.language.distributions import Uniform
from ssmppl.language.model.pickling import UnpackedCache, digest_of, packed, unpacked
from ssmppl.language.model.trace import Trace


class AugmentedModels:
    """Makes and fits augmented models of one base model.

    initial_law : of those that cannot have the model's flat one.
    """

    def __init__(
        self, trace: Trace, missing: Missing, fixed: Mapping[str, np.ndarray], settings: Settings,
        initial_law: ProperInitialLaw | None = None,
    ):  # fmt: skip
        self.trace, self.missing, self.fixed, self.settings = trace, missing, dict(fixed), settings
        self.initial_law = initial_law
        self._made: dict[tuple[tuple[str, str], ...], Fitter] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process makes what it needs, and keeps it from one stage to the next."""
        content = packed((self.trace, self.missing, self.fixed, self.settings, self.initial_law))
        _received.put(digest_of(content), self)
        return _receive, (content,)

    @property
    def base_fitter(self) -> Fitter:
        """The fitter of the model itself."""
        return self.fitter(())

    def fitter(self, candidates: Sequence[Candidate]) -> Fitter:
        """The fitter of the model with these effects; shapes are fixed parameters, so that the
        generated code is the same for all data."""
        made, shapes = symbolic_shapes(candidates, of_time=True)
        key = tuple((c.key, c.strength) for c in made)  # the shapes' symbols, not their values

        def trace() -> Trace:
            return with_given_parameters(augment(self.trace, made), shapes) if made else self.trace

        return self._cached(key, trace, shapes)

    def with_free_shapes(
        self, candidates: Sequence[Candidate], free: Mapping[str, tuple[float, float]]
    ) -> Fitter:
        """The fitter of the model with these effects, some of their shapes between bounds.

        The last parameters are then the shapes as fractions of the range (`range_fraction`); the
        bounds are fixed parameters, so that the generated code is the same for all data.
        """
        made, shapes = symbolic_shapes(candidates, of_time=True)
        given = {n: v for n, v in shapes.items() if n not in free}
        inside: dict[Expr, Expr] = {}
        for name, (low, high) in free.items():
            ends = (f"{name}_from", f"{name}_range")
            given |= dict(zip(ends, (low, high - low), strict=True))
            a, b, u = (symbol("parameter", n, ()) for n in (*ends, range_fraction(name)))
            inside[symbol("parameter", name, ())] = a + b * u
        key = (*((c.key, c.strength) for c in made), *((n, "free") for n in free))

        def trace() -> Trace:
            own = [replace(c, shape=tuple((n, inside.get(v, v)) for n, v in c.shape)) for c in made]
            whole = with_given_parameters(augment(self.trace, own), given)
            return with_given_parameters(whole, map(range_fraction, free), lambda: Uniform(0, 1))

        return self._cached(key, trace, given)

    def _cached(
        self, key: tuple[tuple[str, str], ...], trace: Callable[[], Trace],
        given: Mapping[str, float],
    ) -> Fitter:  # fmt: skip
        """The fitter of a trace that is made once for each key, with these parameters given."""
        if key not in self._made:
            with LOCK:  # refits in threads ask for the same models
                if key not in self._made:
                    self._made[key] = self.fitter_of(trace(), given)
        return self._made[key].with_fixed(given)

    def fitter_of(self, trace: Trace, given: Mapping[str, float]) -> Fitter:
        """The fitter of an augmented trace, with the values of what it was given besides."""
        law = self.initial_law if needs_proper_initial_law(trace) else None
        trace = law.applied_to(trace) if law else trace
        program = compile_trace(trace, self.missing)
        fixed = self.fixed | {n: np.asarray(v) for n, v in given.items()}
        settings = Settings(self.settings.particles, proposal_of(program), self.settings.lag)
        return Fitter(Problem(trace, (), program), fixed, settings, law)


_received: UnpackedCache[AugmentedModels] = UnpackedCache(most=4)


def _receive(content: bytes) -> AugmentedModels | None:
    return _received.get(digest_of(content), lambda: AugmentedModels(*unpacked(content)))


def range_fraction(shape: str) -> str:
    """The parameter that says how far a shape is from its lower bound (0) to its upper one (1)."""
    return f"{shape}_share"


def proposal_of(program: Program) -> str:
    """The proposal of a program's filters: the user's, the twisted one, or the best there is."""
    if "user" in program.proposals:
        return "user"
    if _steerable(program):
        return "twisted"
    found = program.proposals.get("auxiliary")
    if found is not None and not isinstance(found, NotApplicable) and found.exact_look_ahead:
        return "auxiliary"
    return "bootstrap"


def _steerable(program: Program) -> bool:
    """Whether the twisted proposal applies, and its extended Kalman filter can be trusted: it may
    step out of a support with an end, as LogNormal's, where its guide and predictions are lost."""
    laws = [s.distribution for s in program.trace.transition.values()]
    twisted = program.proposals.get("twisted", NotApplicable("there is none"))
    return not isinstance(twisted, NotApplicable) and not any(
        d.support().kind == "interval" for d in laws
    )
