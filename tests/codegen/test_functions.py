"""Every generated function computes what the interpreter computes, for a corpus of models."""

from dataclasses import replace

import numpy as np
import pytest

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.proposals.channels import channel_draws, observation_draws
from ssmppl.analysis.proposals.curvature import adjoint_of, bends, seen_adjoint
from ssmppl.analysis.proposals.proposals import bootstrap
from ssmppl.analysis.proposals.twisted import jacobian, lookahead_model
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.text.kernel_functions import filter_functions
from ssmppl.codegen.text.module import Layout
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.distributions import Dirac, MvNormal
from ssmppl.language.tracing import trace
from tests.codegen.harness import (
    PARTICLES,
    ROOM,
    STAND_INS,
    STEPS,
    Numbers,
    noise_of,
    plain,
    stand_in,
)
from tests.models.statements import MODELS, build

CASES = [(name, gaps) for name in MODELS for gaps in (False, True)]


def missing_of(traced, gaps):
    partial = {s.name for s in traced.observations.values() if isinstance(s.distribution, MvNormal)}
    return Missing(False, frozenset(partial)) if gaps else Missing(none=True)


@pytest.fixture(scope="module", params=CASES, ids=lambda c: f"{c[0]}-{'gaps' if c[1] else 'all'}")
def case(request):
    name, gaps = request.param
    traced = trace(build(name))
    program = compile_trace(traced, missing_of(traced, gaps))
    return program, Numbers(traced, np.random.default_rng(5), gaps)


def close(found, expected, what):
    expected = np.broadcast_to(expected, np.shape(found))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11, err_msg=what)


class Generated:
    """The functions of one section at one time step.

    Those of the twisted filter and of the Gaussian approximation stand in modules of their own;
    the former read a guide behind the inputs.
    """

    def __init__(self, program, numbers, suffix, t):
        self.module, self.suffix = program.module, suffix
        if suffix == "gaussian":
            self.module = program.gaussian.module
        elif suffix == "mode":
            self.module = program.gaussian.by_mode
        elif suffix == "adjoint":
            self.module = program.gaussian.by_adjoint
        elif suffix == "twisted":
            self.module = program.twisted.module
            numbers = numbers.guided(program.twisted.order, np.random.default_rng([8, t]))
        self.numbers = numbers
        self.c, self.s = np.full(ROOM, np.nan), np.full(ROOM, np.nan)
        self.call("prepare", numbers.theta, self.c)
        self.call(
            "step", numbers.theta, self.c, numbers.y, numbers.seen, numbers.u, t, self.s
        )  # fmt: skip

    def call(self, role, *args):
        return plain(getattr(self.module, f"{role}_{self.suffix}"), **STAND_INS)(*args)

    def pass_(self, role, *args):
        return self.call(role, self.numbers.theta, self.c, self.s, *args)


def fitted(generated, t):
    """What the proposal computes once per particle, as the arguments of a pass; or nothing."""
    if not hasattr(generated.module, f"weigh_{generated.suffix}"):
        return []  # a section that only simulates
    fits = np.full((ROOM, PARTICLES), np.nan)
    if hasattr(generated.module, f"fit_{generated.suffix}"):
        generated.pass_("fit", generated.numbers.states[t - 1], fits)
    return [fits]


def check_draw(generated, role, draws, t, rng):
    """A pass that moves particles against the draws' expressions."""
    numbers, order = generated.numbers, generated.numbers.traced.state_symbols
    roots = [draws[s] for s in order]
    normals, uniforms, noise = noise_of(roots, rng)
    out = np.full((len(order), PARTICLES), np.nan)
    before = [] if role == "draw_initial" else [numbers.states[t - 1], *fitted(generated, t)]
    generated.pass_(role, *before, out, normals, uniforms, None)
    expected = evaluate(roots, {**numbers.values(t), **noise}, stand_in)
    for k, e in enumerate(expected):
        close(out[k], e, f"{generated.suffix} {role} {order[k]!r} t={t}")


def check_weight(generated, role, weight, t):
    numbers = generated.numbers
    log_w = np.full(PARTICLES, np.nan)
    before = [] if role == "weigh_initial" else [numbers.states[t - 1]]
    if role == "weigh":
        before += fitted(generated, t)
    generated.pass_(role, *before, numbers.states[t], log_w)
    expected = sum(evaluate([w.guarded() for w in weight], numbers.values(t)), 0.0)
    close(log_w, expected, f"{generated.suffix} {role} t={t}")


def test_particle_filters(case):
    program, numbers = case
    rng = np.random.default_rng(6)
    for name, p in program.proposals.items():
        if isinstance(p, NotApplicable) or not p.draw:
            continue  # not derived, or made in loops: `test_moves_in_loops`
        for t in range(STEPS):
            generated = Generated(program, numbers, name, t)
            if t == 0:
                check_draw(generated, "draw_initial", p.initial_draw, t, rng)
                check_weight(generated, "weigh_initial", p.initial_weight, t)
                continue
            check_draw(generated, "draw", p.draw, t, rng)
            check_weight(generated, "weigh", p.weight, t)
            if p.look_ahead is not None:
                log_v = np.full(PARTICLES, np.nan)
                generated.pass_("look_ahead", numbers.states[t - 1], *fitted(generated, t), log_v)
                expected = evaluate(p.look_ahead, generated.numbers.values(t))
                close(log_v, expected, f"{name} look_ahead t={t}")


def test_what_is_kept_of_a_fit_has_a_row_of_its_own(case):
    """Also where two of its numbers are the same expression, as entries of a factor can be."""
    program, numbers = case
    for p in program.proposals.values():
        if isinstance(p, NotApplicable) or not p.fit:
            continue
        twice = replace(p, fit=(p.fit[0], p.fit[0], *p.fit))
        for proposal in (p, twice):
            rows = filter_functions(Layout(numbers.traced), proposal).fits.values()
            assert sorted(rows) == list(range(len(rows)))


def test_joining_a_reference(case):
    """What conditional SMC adds to a filter: f and g apart, and x_t with its noisy part given."""
    program, numbers = case
    traced, t = program.trace, 2
    noisy = [s for s in traced.transition.values() if not isinstance(s.distribution, Dirac)]
    moved = [e for e in terms(traced, "transition") if e.site in noisy]
    reference = np.ascontiguousarray(numbers.states[t, :, 3])
    for name, p in program.proposals.items():
        if isinstance(p, NotApplicable):
            continue
        generated = Generated(program, numbers, name, t)
        check_weight(generated, "weigh_connected", moved, t)
        log_w = np.full(PARTICLES, np.nan)
        generated.pass_("weigh_observed", numbers.states[t], log_w)
        observed = bootstrap(traced, program.missing).weight
        expected = sum(evaluate([w.guarded() for w in observed], numbers.values(t)), 0.0)
        close(log_w, expected, f"{name} weigh_observed")
        joined = np.full(numbers.states[t].shape, np.nan)
        generated.pass_("connect", numbers.states[t - 1], reference, joined)
        known = numbers.values(t) | dict(zip(traced.state_symbols, reference, strict=True))
        for k, s in enumerate(traced.state_symbols):
            site = traced.transition[s.data[1]]
            expected = reference[k]
            if site not in noisy:
                place = {v: i for i, v in enumerate(site.value.ravel())}
                mean = array(site.distribution.mean()).ravel()[place[s]]
                expected = evaluate(mean, known)
            close(joined[k], expected, f"{name} connect {s!r}")


def test_gaussian_approximation(case):
    """The model by its noise, with its derivatives, of one particle at a time."""
    program, numbers = case
    found = lookahead_model(program.trace, program.missing)
    if isinstance(found, NotApplicable):
        assert isinstance(program.gaussian, NotApplicable)
        assert isinstance(program.twisted, NotApplicable)
        return
    rng, d = np.random.default_rng(9), len(program.trace.state_symbols)
    lower = [found.curvature[i, j] for i in range(d) for j in range(i + 1)]
    seen = [found.observed, *found.slope, *lower]
    for t in range(STEPS):
        generated = Generated(program, numbers, "gaussian", t)
        form, suffix = (found.transition, "") if t else (found.initial, "_initial")
        e = rng.normal(size=len(form.noise))
        noise = dict(zip(form.noise, e, strict=True))
        before = [numbers.states[t - 1]] if t else []
        out = np.full((d, PARTICLES), np.nan)
        generated.pass_("follow" if t else "begin", *before, e, out)
        check_rows(generated, out, form.value, t, "by noise", noise)
        derivatives = [*form.at_rest()]
        derivatives += [*jacobian(form, program.trace).ravel()] if t else []
        derivatives += [*form.spread().ravel()]
        out = np.zeros((len(derivatives), PARTICLES))  # entries that are always 0 are not written
        generated.pass_(f"linear{suffix}", *before, numbers.states[t], out)
        check_rows(generated, out, derivatives, t, "linear")
        out = np.zeros((len(seen), PARTICLES))  # entries that are always 0 are not written
        generated.pass_("look", numbers.states[t], out)
        check_rows(generated, out, seen, t, "look")


def test_second_derivatives_of_the_gaussian_approximation(case):
    """Those of the transition by the noise, weighted by the costate, of one particle at a time."""
    program, numbers = case
    if isinstance(program.gaussian, NotApplicable):
        return
    bent = bends(program.gaussian.found, program.trace)
    if isinstance(bent, NotApplicable):
        assert isinstance(program.gaussian.by_mode, NotApplicable)
        return
    rng = np.random.default_rng(11)
    for t in range(STEPS):
        generated = Generated(program, numbers, "mode", t)
        bend = bent[1 if t else 0]
        given = dict(zip(bend.given, rng.normal(size=len(bend.given)), strict=True))
        before = [numbers.states[t - 1]] if t else []
        out = np.zeros((len(bend.values), PARTICLES))
        role = "bend" if t else "bend_initial"
        generated.pass_(role, *before, np.array(list(given.values())), numbers.states[t], out)
        check_rows(generated, out, bend.values, t, role, given)


def test_gradients_at_the_mode(case):
    """What the adjoint of Laplace's approximation adds up, of one particle at a time."""
    program, numbers = case
    traced = program.trace
    if isinstance(program.gaussian, NotApplicable):
        return
    if isinstance(program.gaussian.by_adjoint, NotApplicable):
        return
    found, theta, before = program.gaussian.found, traced.parameter_symbols, []
    rng, bent = np.random.default_rng(12), program.gaussian.bends
    laws = {
        "": adjoint_of(found.transition, bent[1], traced.state_prev_symbols, theta),
        "_initial": adjoint_of(found.initial, bent[0], [], theta),
        "_seen": seen_adjoint(found, traced.state_symbols, theta),
    }
    for t, suffix in [
        (0, "_initial"),
        (0, "_seen"),
        *((t, s) for t in (1, 2) for s in ("", "_seen")),
    ]:
        generated, law = Generated(program, numbers, "adjoint", t), laws[suffix]
        given = dict(zip(law.given, rng.normal(size=len(law.given)), strict=True))
        before = [] if suffix else [numbers.states[t - 1]]
        for role, values in (("third", law.moving), ("fixed", law.fixed)):
            out = np.zeros((len(values), PARTICLES))
            noise = np.array(list(given.values()))
            generated.pass_(f"{role}{suffix}", *before, noise, numbers.states[t], out)
            check_rows(generated, out, values, t, f"{role}{suffix}", given)


def test_moves_in_loops(case):
    """What the loops know of a model of many noises, for every particle."""
    program, numbers = case
    found = lookahead_model(program.trace, program.missing)
    if isinstance(found, NotApplicable) or found.written_out:
        return
    rng, d = np.random.default_rng(10), len(program.trace.state_symbols)
    for t in range(STEPS):
        generated = Generated(program, numbers, "twisted", t)
        form = found.transition if t else found.initial
        before = [numbers.states[t - 1]] if t else []
        assert generated.s[0] == len(form.noise)
        guide = [generated.numbers.values(t)[g] for g in program.twisted.order]
        np.testing.assert_array_equal(generated.s[1 : 1 + len(guide)], guide)
        e = rng.normal(size=(len(form.noise), PARTICLES))
        noise, out = dict(zip(form.noise, e, strict=True)), np.full((d, PARTICLES), np.nan)
        generated.pass_("follow" if t else "begin", *before, e, out)
        check_rows(generated, out, form.value, t, "by noise", noise)
        out = np.zeros((len(form.noise), PARTICLES))
        generated.pass_("recover" if t else "recover_initial", *before, numbers.states[t], out)
        check_rows(generated, out, form.recovered, t, "recovered")
        if t:
            out = np.full((d, PARTICLES), np.nan)
            generated.pass_("rest", *before, out)
            check_rows(generated, out, form.at_rest(), t, "rest")
            out = np.zeros((d * len(form.noise), PARTICLES))
            generated.pass_("spread", *before, numbers.states[t], out)
            check_rows(generated, out, form.spread().ravel(), t, "spread")


def check_rows(generated, out, expressions, t, what, more=None):
    expected = evaluate(list(expressions), {**generated.numbers.values(t), **(more or {})})
    for k, (row, e) in enumerate(zip(out, expected, strict=True)):
        close(row, e, f"{what} {k} t={t}")


def test_simulation_and_prediction(case):
    program, numbers = case
    traced, rng = program.trace, np.random.default_rng(7)
    plain_proposal = bootstrap(traced, program.missing)
    for t in range(STEPS):
        generated = Generated(program, numbers, "simulate", t)
        role, draws = ("draw", plain_proposal.draw) if t else (
            "draw_initial", plain_proposal.initial_draw)  # fmt: skip
        check_draw(generated, role, draws, t, rng)
        check_observe(generated, observation_draws(traced), t, rng)
        generated = Generated(program, numbers, "predict", t)
        check_draw(generated, role, draws, t, rng)
        check_observe(generated, channel_draws(traced), t, rng)
        moments = np.full((4 * len(traced.observation_symbols), PARTICLES), -7.0)
        generated.pass_("moments", numbers.states[t], moments)
        assert not (moments == -7.0).any()
        check_moments(moments, traced, numbers, t)


def check_observe(generated, roots, t, rng):
    numbers = generated.numbers
    normals, uniforms, noise = noise_of(roots, rng)
    out = np.full((len(roots), PARTICLES), np.nan)
    generated.pass_("observe", numbers.states[t], out, normals, uniforms, None)
    for k, e in enumerate(evaluate(roots, {**numbers.values(t), **noise}, stand_in)):
        close(out[k], e, f"observe {k} t={t}")


def check_moments(moments, traced, numbers, t):
    k = 0
    for site in traced.observations.values():
        d, n = site.distribution, len(site.components)
        place = {s: i for i, s in enumerate(site.value.ravel())}
        first = [place[s] for s in site.components]
        for row, form in enumerate((d.mean(), d.variance())):
            flat = np.broadcast_to(np.asarray(form, dtype=object), site.shape).ravel()
            for j, i in enumerate(first):
                expected = evaluate(flat[i], numbers.values(t))
                close(moments[4 * (k + j) + row], expected, f"{site.name} moment {row}")
        for j in range(n):
            below, strictly = moments[4 * (k + j) + 2], moments[4 * (k + j) + 3]
            assert np.all((strictly <= below) | np.isnan(below))
            if d.discrete:
                assert np.all((below >= 0) & (below <= 1 + 1e-12))
        k += n


def test_log_joint(case):
    """The complete-data log density of one particle's trajectory."""
    program, numbers = case
    traced = program.trace
    trajectory = np.ascontiguousarray(numbers.states[:, :, 2])
    numbers_one = numbers.values
    total = np.zeros(8)
    plain(program.module.sums_log_joint)(
        numbers.theta, numbers.y, numbers.seen, numbers.u, STEPS, trajectory, total
    )

    def at(t, role):
        # one particle only: its own past, in place of everybody's
        values = {
            s: (v[2] if isinstance(v, np.ndarray) and v.shape == (PARTICLES,) else v)
            for s, v in numbers_one(t).items()
        }
        found = [
            e
            for e in terms(traced, role, program.missing)
            if not isinstance(e.site.distribution, Dirac)
        ]
        return sum(evaluate([e.guarded() for e in found], values), 0.0)

    expected = at(0, "initial")
    expected += sum(at(t, "transition") for t in range(1, STEPS))
    expected += sum(at(t, "observation") for t in range(STEPS))
    assert total[0] == pytest.approx(expected, rel=1e-10)
    if traced.parameters:
        plain(program.module.density_log_prior)(numbers.theta, total)
        assert total[0] == pytest.approx(at(0, "prior"), rel=1e-10)
