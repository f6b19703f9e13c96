"""Program: the generated module of a model, and its entry points.

`compile_trace` writes one readable module per model (and per kind of missing data): for each
proposal the functions of the particle filter, then those of simulation and prediction. Numba
compiles a function when it is first called, so only what is used is compiled.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap, derive
from ssmppl.analysis.proposals.twisted import twisted
from ssmppl.analysis.proposals.upper_bounds import transition_upper_bound
from ssmppl.analysis.structure import check_observations, check_start, exact_observation
from ssmppl.codegen.kernels.particle.backward import (
    backward_exact,
    backward_mcmc,
    backward_rejection,
    backward_weights,
    continuation,
)
from ssmppl.codegen.kernels.particle.particle_filter import move_blocks
from ssmppl.codegen.kernels.particle.simulation import (
    observe_states,
    simulate,
    simulate_on,
)
from ssmppl.codegen.modules.device import DeviceFilter, compile_device
from ssmppl.codegen.modules.gaussian import GaussianApproximation, compile_gaussian
from ssmppl.codegen.modules.marginal import NAMES as MARGINAL
from ssmppl.codegen.modules.marginal import MarginalFilter, compile_marginal
from ssmppl.codegen.modules.tempered import TemperedFilter, compile_tempered
from ssmppl.codegen.modules.twisted import TwistedFilter, compile_twisted
from ssmppl.codegen.native.loading import Loaded, load
from ssmppl.codegen.text.kernel_functions import (
    add_conditional_smc,
    add_filters,
    add_log_joint,
    add_parameters,
    add_predictions,
    backward_functions,
    conditional_passes,
    filter_functions,
    horizon,
    simulation_functions,
)
from ssmppl.codegen.text.module import Layout, ModuleText
from ssmppl.codegen.text.render import identifier
from ssmppl.compiling import LOCK, once_property
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.trace import Trace

# Proposals whose filters stand in a module of their own -> what a `Program` calls that.
OWN_MODULES = {"twisted": "twisted", **dict.fromkeys(MARGINAL, "marginal"), "tempered": "tempered"}


class Proposals(Mapping[str, Proposal | NotApplicable]):
    """What was derived under each name, or why nothing was.

    twisted : derives the proposal of that name when it is first asked for, as second derivatives of
        many channels in many states take longer than all else.
    """

    def __init__(
        self,
        derived: Mapping[str, Proposal | NotApplicable],
        twisted: Callable[[], Proposal | NotApplicable],
    ):
        self._derived, self._twisted = dict(derived), twisted

    def __getitem__(self, name: str) -> Proposal | NotApplicable:
        if name == "twisted" and name not in self._derived:
            with LOCK:
                if name not in self._derived:
                    self._derived[name] = self._twisted()
        return self._derived[name]

    def __contains__(self, name: object) -> bool:
        return name == "twisted" or name in self._derived

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*(n for n in self._derived if n != "twisted"), "twisted")))

    def __len__(self) -> int:
        return len({*self._derived, "twisted"})


@dataclass
class Program:
    """The generated module of a traced model.

    Attributes
    ----------
    proposals : by name, what was derived, or the reason why not.
    """

    trace: Trace
    missing: Missing
    proposals: Mapping[str, Proposal | NotApplicable]
    text: str
    module: ModuleType = field(repr=False)
    loaded: Loaded = field(repr=False)
    _entries: dict[str, Callable[..., Any]] = field(default_factory=dict, repr=False)
    _on_device: dict[tuple[str, int], DeviceFilter] = field(default_factory=dict, repr=False)

    def __reduce__(self):  # another process generates the module again, or finds it in its cache
        return compile_trace, (self.trace, self.missing)

    @once_property
    def gaussian(self) -> GaussianApproximation | NotApplicable:
        """The Gaussian approximation, in a module of its own; generated when first asked for."""
        if self.missing.noise is not None:
            return self.missing.noise
        return compile_gaussian(self.trace, self.missing)

    @once_property
    def twisted(self) -> TwistedFilter | NotApplicable:
        """The twisted filter, in a module of its own; generated when it is first asked for."""
        if self.missing.noise is not None:
            return self.missing.noise
        return compile_twisted(self.trace, self.missing, self.gaussian)

    @once_property
    def marginal(self) -> MarginalFilter | NotApplicable:
        """The Rao-Blackwellised filters, likewise."""
        return compile_marginal(self.trace, self.missing)

    @once_property
    def tempered(self) -> TemperedFilter | NotApplicable:
        """The tempered filter, likewise."""
        if self.missing.noise is not None:
            return self.missing.noise
        return compile_tempered(self.trace, self.missing)

    def apart(self, proposal: str) -> bool:
        """Whether particles of this proposal move without looking ahead at each other, as in
        blocks and on a device."""
        return f"move_blocks_{proposal}" in self.loaded

    def on_device(self, proposal: str, threads: int) -> DeviceFilter:
        """The filter of one proposal for a CUDA device, with blocks of so many threads."""
        key = proposal, threads
        if key not in self._on_device:
            found = self.proposals[proposal]
            assert isinstance(found, Proposal), found
            with LOCK:
                if key not in self._on_device:
                    self._on_device[key] = compile_device(self.trace, found, threads)
        return self._on_device[key]

    def proposal(self, name: str) -> Proposal | NotApplicable | None:
        """What was derived under this name, or why nothing was; None where no proposal has it."""
        if name in self.proposals:
            return self.proposals[name]
        own = self.own_module(name)
        return own if isinstance(own, NotApplicable | None) else own.proposals[name]

    def own_module(self, proposal: str) -> Any:
        """The module of its own in which this proposal's filters stand, or why there is none; None
        where they stand in the program's."""
        return getattr(self, OWN_MODULES[proposal]) if proposal in OWN_MODULES else None

    def carried(self, proposal: str) -> list[Expr]:
        """The components that a particle has under this proposal."""
        own = self.own_module(proposal)
        trace = self.trace if isinstance(own, NotApplicable | None) else own.trace
        return trace.state_symbols

    def source(self) -> str:
        """The generated Python module, commented with the user's lines.

        Returns
        -------
        str : its text; lines of a notebook go by the number of their cell.
        """
        text = self.text
        places = (place for found in self.trace.functions.values() for place in found)
        for file, where in {place.file: place for place in places}.items():
            # the module itself keeps the name that cells go by, which is the same in every session
            if where.cell:
                text = text.replace(f"{os.path.basename(file)}:", f"{where.cell}:")
        return text

    @property
    def path(self) -> Path:
        """The file of the generated module."""
        return Path(str(self.module.__file__))

    def entry(self, name: str) -> Callable[..., Any]:
        """A compiled entry point of the module.

        Raises
        ------
        ArgumentError : it belongs to a proposal that could not be derived; gives the reason.
        """
        if name not in self._entries:
            with LOCK:
                if name not in self._entries:
                    self._entries[name] = self._entry(name)
        return self._entries[name]

    def _entry(self, name: str) -> Callable[..., Any]:
        for proposal in OWN_MODULES:
            if name.endswith(f"_{proposal}"):
                own = self.own_module(proposal)
                if not isinstance(own, NotApplicable):
                    return own.entry(name.removesuffix(f"_{proposal}"), proposal)
        if not hasattr(self.module, name):
            for proposal in self.proposals:
                if not name.endswith("_" + proposal):
                    continue
                found = self.proposals[proposal]
                if isinstance(found, NotApplicable):
                    raise ArgumentError(
                        f"particles cannot move by the proposal {proposal!r}: {found}",
                        fix="use an exact method, or another proposal",
                    )
        return getattr(self.loaded, name)


# The last programs; each keeps its trace, and with it the trace's id, in use.
_programs: OrderedDict[tuple[int, Missing], Program] = OrderedDict()
_MOST_PROGRAMS = 64


def compile_trace(trace: Trace, missing: Missing = Missing()) -> Program:
    """Generate, write and import the module of a traced model, once per trace.

    Raises
    ------
    ModelError : a state has a flat initial distribution, and the model is not linear and Gaussian.
    """
    key = id(trace), missing
    program = _programs.get(key)  # without the lock: others may compile for long
    if program is not None:
        return program
    with LOCK:
        program = _programs.get(key)
        if program is None:
            program = _programs[key] = _compiled(trace, missing)
            while len(_programs) > _MOST_PROGRAMS:
                _programs.popitem(last=False)
        return program


def _compiled(trace: Trace, missing: Missing) -> Program:
    check_start(trace)
    check_observations(trace)
    if missing.noise is None:
        missing = replace(missing, noise=exact_observation(trace))
    derived = derive(trace, missing)
    out, lines = _write(trace, missing, derived)
    loaded = load(out, identifier(trace.name), lines)
    proposals = Proposals(
        {n: _with_densities(p, missing) for n, p in derived.items()},
        lambda: _with_densities(twisted(trace, missing), missing),
    )
    return Program(trace, missing, proposals, out.finish(lines), loaded.module, loaded)


def _with_densities(
    proposal: Proposal | NotApplicable, missing: Missing
) -> Proposal | NotApplicable:
    """The proposal, unless it asks for a density that does not exist in some row of the data: of
    the observation, where it is what particles weigh, or of the states, where these are drawn by
    Newton steps."""
    if isinstance(proposal, NotApplicable):
        return proposal
    if missing.noise is not None and proposal.conditioned != "all":
        return missing.noise
    fitted = proposal.name in ("guided", "auxiliary") and proposal.conditioned == "none"
    return missing.spread if fitted and missing.spread is not None else proposal


def _write(
    trace: Trace, missing: Missing, proposals: dict[str, Proposal | NotApplicable]
) -> tuple[ModuleText, list[str]]:
    layout = Layout(trace)
    plain = bootstrap(trace, missing)
    out = ModuleText(layout)
    if trace.observations:
        add_predictions(out, trace, layout, missing)
    simulation = simulation_functions(trace, layout, plain)
    out.add("simulation", simulation)
    out.algorithm(simulate, "simulate", simulation, "entry")
    out.algorithm(simulate_on, "simulate_on", simulation, "entry")
    out.algorithm(observe_states, "observe_states", simulation, "entry")
    for name, proposal in proposals.items():
        if isinstance(proposal, NotApplicable) or not trace.observations:
            continue
        section = filter_functions(layout, proposal)
        conditional_passes(trace, layout, section, plain)
        out.add(f"particle filter, {name}: {proposal.explanation}", section)
        ahead = {"ahead": proposal.look_ahead_kind}
        add_filters(out, section, ahead)
        add_conditional_smc(out, section, trace, ahead)
        if proposal.look_ahead is None:
            out.algorithm(move_blocks, section.name("move_blocks"), section, "entry")
    if trace.observations:
        _backward(out, trace, layout, plain)
    add_log_joint(out, trace, layout, missing)
    if trace.parameters:
        add_parameters(out, trace, layout)
    return out, _introduction(trace, proposals)


def _backward(out: ModuleText, trace: Trace, layout: Layout, plain: Proposal) -> None:
    """The entry points of backward simulation."""
    height = transition_upper_bound(trace)
    section = backward_functions(trace, layout, plain, height)
    why = f"; no rejection: {height.reason}" if isinstance(height, NotApplicable) else ""
    out.add(f"backward simulation{why}", section)
    own = {"horizon": horizon(trace)}
    for function in (backward_weights, continuation):
        out.algorithm(function, function.__name__, section, "exact", own)
        own[function.__name__] = function.__name__
    out.algorithm(backward_exact, "backward_exact", section, "entry", own)
    out.algorithm(backward_mcmc, "backward_mcmc", section, "entry", own)
    if not isinstance(height, NotApplicable):
        out.algorithm(backward_rejection, "backward_rejection", section, "entry", own)


def _introduction(trace: Trace, proposals: dict[str, Proposal | NotApplicable]) -> list[str]:
    lines = [f"Generated by ssmppl from the model {trace.name!r}; edits here have no effect.", ""]
    for role, places in trace.functions.items():
        for place in places:
            lines.append(f"{role:<12} {os.path.basename(place.file)}:{place.line} {place.function}")
    lines.append("")
    for name, p in proposals.items():
        what = p.explanation if not isinstance(p, NotApplicable) else f"not derived: {p.reason}"
        lines.append(f"{name:<12} {what}")
    lines.append(f"{'twisted':<12} where it can be derived: in a module of its own")
    rows = [("theta", trace.parameter_symbols), ("states", trace.state_symbols),
            ("y, seen", trace.observation_symbols), ("u", trace.input_symbols)]  # fmt: skip
    lines.append("")
    for label, symbols in rows:
        if symbols:
            lines.append(f"{label:<12} {', '.join(map(repr, symbols))}")
    return lines
