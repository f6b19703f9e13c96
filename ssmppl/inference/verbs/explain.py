"""The verbs `explain` and `compile`: what was derived from a model, and why."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ssmppl import markup
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.density import Missing
from ssmppl.analysis.elimination.conditional import ConditionallyLinear, conditionally_linear
from ssmppl.analysis.elimination.eliminable import Eliminable, eliminable
from ssmppl.analysis.finite import FiniteStates, finite_states
from ssmppl.analysis.proposals.curvature import laplace_obstacle
from ssmppl.analysis.proposals.noises import Noises, noises
from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.analysis.proposals.tempered import tempered
from ssmppl.analysis.structure import (
    LinearGaussian,
    deterministic_memory,
    linear_gaussian,
    simulators,
    singular_covariance,
)
from ssmppl.arguments import checked
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.data import Experiment, bind, unread
from ssmppl.data.per_experiment import trace_over
from ssmppl.data.singular_rows import of_data
from ssmppl.data.times import label_text, spacing, trading_days
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.chains.sampling import TRAJECTORIES, PlanRows, reason_and_line
from ssmppl.inference.particles.deterministic import Deterministic
from ssmppl.inference.preparation.exact_models import exact_kind, exact_model
from ssmppl.inference.preparation.gaussian_pilot import MOST_NUMBERS
from ssmppl.inference.preparation.method_choice import (
    choose_maximiser,
    choose_sampler,
    choose_smoother,
    only_counts,
    why_stuck,
)
from ssmppl.inference.run.problem import missing_of
from ssmppl.inference.verbs.sample import METHODS
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Site, Trace
from ssmppl.language.model.transforms import transforms
from ssmppl.language.tracing import trace
from ssmppl.language.user_defined.primitive import primitives_in

PAGE = 100  # columns
LONGEST_LAW = 600  # characters of a law, some six lines
MOST_NAMED = 8  # unused columns
UPDATES = "Gibbs updates (full conditionals given states and data)"
TEMPERED = (
    "for observations far more informative than the transition: particles are weighted by "
    "increasing powers of the observation density, with Metropolis moves in between"
)


AUXILIARY = "auxiliary variable of the transition, undefined at t = 1"


@dataclass(frozen=True)
class Plan:
    """Everything that was derived from a model; `print` it, or show it in a notebook.

    Attributes
    ----------
    structure : the model as a linear Gaussian one, or why it is not.
    conditional : the states that are linear and Gaussian given the others, or why there are none.
    finite : the values that its states take where they are few, or why they are not.
    proposals : by name, how particles move, or why that could not be derived.
    updates : the Gibbs updates of the parameters, in the order in which they are made.
    deterministic_memory : for how many steps a deterministic state remembers; None where it never
        forgets.
    noises : what drives the states, or why it is not known.
    laplace : why the likelihood has no Laplace approximation; None where it has, or is exact.
    eliminable : the parameters that PGAS can integrate out, and why not the others.
    rows : of the longest data set, where there are data.
    declared : the model as it was declared, where `trace` has parameters of several experiments.
    """

    trace: Trace
    structure: LinearGaussian | NotApplicable
    conditional: ConditionallyLinear | NotApplicable
    finite: FiniteStates | NotApplicable
    proposals: Mapping[str, Proposal | NotApplicable]
    updates: tuple[Update, ...]
    deterministic_memory: int | None
    noises: Noises | NotApplicable
    laplace: NotApplicable | None
    eliminable: Eliminable
    data: str = ""
    rows: int | None = None
    labels: tuple[tuple[str, str], ...] = ()
    declared: Trace | None = None

    def sections(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """The parts of the plan, as `print` shows them.

        Returns
        -------
        list of (str, list of (str, str))
            Of each part its title, and its rows: what, and how.
        """
        t = self.declared or self.trace
        several = len(self.trace.experiments)
        each = f"of each of the {several} experiments" if several else "of each experiment"
        first = {n: s for n, s in t.initial.items() if n not in t.auxiliary}
        out = [
            ("Priors", _laws(t.parameters, dict.fromkeys(self.trace.per_experiment, each))),
            ("Initial distribution, t = 1", _laws(first)),
            ("Transition, x_prev to x", _laws(t.transition, dict.fromkeys(t.auxiliary, AUXILIARY))),
            ("Observation", _laws(t.observations)),
        ]
        if loops := _loops(t):
            out.append(("Numerical integration", loops))
        t = self.trace
        if t.given_inputs:
            out.append(("Inputs", [(n, "scalar" if not s else f"shape {s}")
                                   for n, s in t.given_inputs.items()]))  # fmt: skip
        if self.data:
            out.append(("Data", [("data set", self.data), *self.labels]))
        out.append(("Structure", self._structure()))
        out.append(("Derivatives of primitives", self._primitives()))
        rows = [self._proposal(n, p) for n, p in self.proposals.items()]
        guided = self.proposals.get("guided")
        if isinstance(guided, NotApplicable) and tempered(t, Missing()):
            rows.append(("tempered", TEMPERED))
        noisy, of_methods = not isinstance(exact_model(t), Deterministic), self._of_methods()
        if noisy:
            out.append(("Particle filter", rows))
            out.append((TRAJECTORIES, of_methods.pop(TRAJECTORIES)))
        out.append(("Default methods", self._choices()))
        singular = singular_covariance(t)
        if singular is not None:
            out.append((UPDATES, [("none", reason_and_line(singular))]))
        elif self.updates and noisy:
            out.append((UPDATES, [_update(u) for u in self.updates]))
            out += of_methods.items()
        return [(title, rows) for title, rows in out if rows]

    def _structure(self) -> list[tuple[str, str]]:
        if isinstance(self.finite, FiniteStates):
            return [("finite states", f"{len(self.finite.values)} combinations of values: the "
                     "likelihood is exact, by the forward algorithm; particles are used only on "
                     "request")]  # fmt: skip
        if isinstance(exact_model(self.trace), Extended):
            return self._simulators()
        if isinstance(exact_model(self.trace), Deterministic):
            return [("no noise", "given the parameters the states are known: the likelihood is "
                     "exact, from one deterministic simulation")]  # fmt: skip
        if isinstance(self.structure, NotApplicable):
            found = [("nonlinear", f"not linear Gaussian: {reason_and_line(self.structure)}")]
            found.append(("Laplace approximation", self._laplace()))
            if isinstance(self.conditional, ConditionallyLinear):
                found.append(("conditionally linear Gaussian", _integrated(self.conditional)))
            return found
        return [("linear Gaussian", "the likelihood is exact, by the Kalman filter; particles are "
                 "used only on request")]  # fmt: skip

    def _primitives(self) -> list[tuple[str, str]]:
        """Where the derivatives of opaque functions come from."""
        t = self.trace
        groups = (t.parameters, t.initial, t.transition, t.observations)
        laws = [s.distribution for sites in groups for s in sites.values()]
        found = primitives_in(e for law in laws for e in law.expressions())
        return [(p.__name__, p.how_derived()) for p in found]

    def _simulators(self) -> list[tuple[str, str]]:
        names = ", ".join(f.title for f in simulators(self.trace))
        return [
            ("simulator", f"{names}: its values and derivatives, by central differences, come from "
             "one call for all points of a row"),
            ("approximation", "the likelihood is that of the extended Kalman filter, whose update "
             "is the mode of each row: maximize, sample, smooth, score and kalman_filter use it; "
             "particles, proposal=\"bootstrap\", are used only on request"),
        ]  # fmt: skip

    def _laplace(self) -> str:
        if self.laplace is not None:
            return f"none: {reason_and_line(self.laplace)}"
        return ("an approximation to the likelihood at the mode of the states, used to initialise "
                "maximize, as proposal in PMMH and as target in ISMCMC; available in "
                "log_likelihood, kalman_filter, smooth and forecast through proposal=\"laplace\", "
                "extended and unscented Kalman filters through \"extended\" and "
                "\"unscented\"")  # fmt: skip

    def _proposal(self, name: str, proposal: Proposal | NotApplicable) -> tuple[str, str]:
        if isinstance(proposal, NotApplicable):
            return name, f"not derived: {reason_and_line(proposal)}"
        return name, proposal.explanation

    def _choices(self) -> list[tuple[str, str]]:
        kind = exact_kind(exact_model(self.trace))
        choices: dict[str, tuple[Any, str]] = {
            "sample": choose_sampler(
                kind,
                self.updates,
                self._numbers(),
                why_stuck(self.trace, self.rows),
                singular_covariance(self.trace),
                laplace=self.laplace is None and 0 < self._numbers() <= MOST_NUMBERS,
                counted=only_counts(self.trace),
            )
        }
        if self.trace.parameters:
            choices["maximize"] = choose_maximiser(kind, self.trace, self.laplace)
        choices["smooth"] = choose_smoother(kind, self.trace)
        return [(verb, f"{type(m).__name__}: {why}") for verb, (m, why) in choices.items()]

    def _numbers(self) -> int:
        """How many numbers the parameters have on the unconstrained scale."""
        return sum(len(p.free) for p in transforms(self.trace))

    def _of_methods(self) -> dict[str, PlanRows]:
        """What the methods of sampling say of the model, by title."""
        out: dict[str, PlanRows] = {}
        for method in METHODS.values():
            for title, rows in method.explain(self).items():
                out.setdefault(title, []).extend(rows)
        return out

    def __str__(self) -> str:
        lines = [f"{self.trace.name}", "=" * len(self.trace.name)]
        for title, rows in self.sections():
            lines += ["", title, "-" * len(title)]
            width = max(len(what) for what, _ in rows)
            for what, how in rows:
                first, *rest = [w for line in how.split("\n") for w in _wrapped(line, width)]
                lines.append(f"{what:<{width}}  {first}".rstrip())
                lines += [f"{'':<{width}}  {line}".rstrip() for line in rest]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        parts = [markup.heading(self.trace.name)]
        for title, rows in self.sections():
            cells = [(markup.code(what), markup.text(how)) for what, how in rows]
            parts.append(f"<b>{markup.text(title)}</b>{markup.table(cells, left=(0, 1))}")
        return "".join(parts)


def _integrated(split: ConditionallyLinear) -> str:
    names = ", ".join(map(repr, split.linear))
    pronoun = "it" if len(split.linear) == 1 else "them"
    return (
        f"{names}, given the other states: a Kalman filter for each particle marginalises "
        f"{pronoun}, and only the other states are sampled (Rao-Blackwellised particle filter; "
        'proposals "marginal", "marginal_guided", "marginal_auxiliary")'
    )


def _laws(sites: dict[str, Site], told: Mapping[str, str] | None = None) -> list[tuple[str, str]]:
    rows = []
    for s in sites.values():
        rows.append((s.name, _cut(f"~ {s.distribution!r}")))
        if told and s.quantity in told:
            rows.append(("", told[s.quantity]))
        if s.distribution.approximation:
            rows.append(("", s.distribution.approximation))
    return rows


def _loops(trace: Trace) -> list[tuple[str, str]]:
    """What the names of loops in the distributions stand for, and of how many steps they are."""
    sites = (trace.parameters, trace.initial, trace.transition, trace.observations)
    laws = [s.distribution for group in sites for s in group.values()]
    waiting = [e for law in reversed(laws) for e in reversed(law.expressions())]
    found, seen = dict[str, str](), set[Expr]()
    while waiting:
        node = waiting.pop()
        if node in seen:
            continue
        seen.add(node)
        if node.op != "loop":
            waiting += reversed(node.args)
            continue
        times, name = node.args[-1], node.data.name
        count = f"{times.data:.0f}" if times.op == "const" else f"{times!r}"
        text = (
            "the exponential of a matrix" if name == "expm" else f"{name}, repeated {count} times"
        )
        found[repr(node).partition("(")[0]] = text
    return list(found.items())


def _cut(law: str) -> str:
    """A distribution short enough to be read: one whose mean is a loop of small steps fills
    pages."""
    if len(law) <= LONGEST_LAW:
        return law
    head = law[: law.rindex(" ", 0, LONGEST_LAW)]
    return f"{head} ... (cut here; ssm.compile(model).source() has all of it, in steps)"


def _wrapped(line: str, width: int) -> list[str]:
    """A line folded to the page, its continuation indented a little further."""
    indent = " " * (len(line) - len(line.lstrip()))
    room = max(PAGE - width - 2, 40)
    return textwrap.wrap(
        line, room, subsequent_indent=indent + "  ", break_long_words=False,
        break_on_hyphens=False, drop_whitespace=True,
    ) or [""]  # fmt: skip


def _update(update: Update) -> tuple[str, str]:
    title, _, law = str(update.explanation).partition(": ")
    return title, law


@checked
def explain(model: Model, data: Any = None) -> Plan:
    """The structure, proposals, default methods and Gibbs updates derived from a model, with
    reasons.

    Parameters
    ----------
    model : the model, as declared.
    data : checks that they fit, and takes account of what is missing in them.

    Returns
    -------
    Plan : `print` it; it renders as tables in a notebook.

    Raises
    ------
    ModelError, DataError : what is wrong, where, and the fix.
    """
    traced = trace_over(model, data)
    bare, missing, bound, rows = traced, Missing(none=True), "", None
    labels: tuple[tuple[str, str], ...] = ()
    if data is not None:
        experiments = bind(traced, data)
        known = of_data(traced, experiments)
        missing = missing_of(experiments, known)
        gaps = sum(int((e.seen == 0).sum()) for e in experiments)
        rows = max(e.steps for e in experiments)
        bound = ", ".join(f"{e.steps} rows" for e in experiments)
        bound += f", {gaps} missing" if gaps else ", none missing"
        labels = _labels(traced, experiments) + _unread([*unread(traced, data)], experiments)
        traced = known
    program = compile_trace(bare, missing)
    nonlinear = isinstance(exact_model(traced), NotApplicable)
    return Plan(
        traced,
        linear_gaussian(traced),
        conditionally_linear(traced),
        finite_states(traced),
        program.proposals,
        tuple(derive_updates(traced, (), missing)),
        deterministic_memory(traced),
        noises(traced, missing),
        laplace_obstacle(traced, missing) if nonlinear else None,
        eliminable(traced, (), missing),
        bound,
        rows,
        labels,
        trace(model),
    )


def _labels(trace: Trace, experiments: Sequence[Experiment]) -> tuple[tuple[str, str], ...]:
    """How rows are labelled: the ends of each data set that has labels, and uneven steps."""
    times = [e.time for e in experiments if e.time is not None]
    if not times:
        return ()
    ends = ", ".join(f"{label_text(t[0])} to {label_text(t[-1])}" for t in times)
    uneven = next((found for t in times if (found := spacing(t)) and not trading_days(t)), "")
    if not uneven and any(map(trading_days, times)):
        uneven = "days without weekends, one row is one step"
    if trace.time_step is not None:
        name, unit = trace.time_step
        unit = f", in {unit}" if any(t.dtype.kind == "M" for t in times) else ""
        uneven = f"{name} is the time from each row to the next{unit}"
    return (("labels", ends), *([("steps", uneven)] if uneven else []))


def _unread(
    columns: Sequence[str], experiments: Sequence[Experiment]
) -> tuple[tuple[str, str], ...]:
    """Columns that no distribution reads, one of which may have been meant to name the rows."""
    if not columns:
        return ()
    named = ", ".join(columns[:MOST_NAMED]) + (", ..." if len(columns) > MOST_NAMED else "")
    if all(e.time is None for e in experiments):
        named += "; rows have numbers: call a column of times or dates `time` to name them"
    return (("unused columns", named),)


@checked
def compile(model: Model, data: Any = None) -> Program:
    """Generate the program of a model.

    Parameters
    ----------
    model : the model, as declared.
    data : with them, the variant that deals with what is missing in them; None: the one for
        complete data.

    Returns
    -------
    Program : ``.source()`` is its text, ``.path`` its file.

    Raises
    ------
    ModelError, DataError : what is wrong, where, and the fix.
    """
    traced = trace_over(model, data)
    missing = Missing(none=True) if data is None else missing_of(bind(traced, data))
    return compile_trace(traced, missing)
