"""Where ancestors cannot be sampled: the choice of the method, update rates and their warning."""

import warnings

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.chains.pgas import PGASState
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run import convergence
from ssmppl.inference.run.convergence import (
    PathMovement,
    movement,
    random_components,
    update_rate_attributes,
    watched_movement,
)
from ssmppl.inference.run.draws import ChainDraws
from ssmppl.inference.run.problem import pose
from ssmppl.inference.verbs.sample import _chosen
from tests.models import standard, wider


def town():
    """Deaths, births and a count of people that never forgets them."""
    model = ssm.Model("town")
    model.prior(lambda: {"birth": ssm.Gamma(4, rate=1), "seen": ssm.Beta(20, 5)})
    model.initial(lambda: {"n": ssm.Dirac(100.0), "born": ssm.Dirac(0.0), "died": ssm.Dirac(0.0)})
    model.transition(lambda n, born, died, birth: {
        "n": ssm.Dirac(n + born - died), "born": ssm.Poisson(birth),
        "died": ssm.Binomial(n + born - died, 0.05),
    })  # fmt: skip
    model.observation(lambda n, seen: {"y": ssm.Binomial(n, seen)})
    return model


def integrated(size=1):
    """A position that integrates a velocity, with so many numbers to be estimated."""
    model = ssm.Model("integrated")
    model.prior(lambda: {"q": ssm.Gamma(np.full(size, 2.0), rate=2.0)})
    model.initial(lambda: {"v": ssm.Normal(0, sd=1), "p": ssm.Dirac(0.0)})
    model.transition(lambda v, p, q: {
        "v": ssm.Normal(np.sin(v), sd=np.sum(q)), "p": ssm.Dirac(p + v)
    })  # fmt: skip
    model.observation(lambda p: {"y": ssm.Normal(p, sd=0.1)})
    return model


def chosen(model, data=None):
    plan = " ".join(str(ssm.explain(model, data)).split())
    return plan[plan.index("Default methods") :]


def test_pmmh_is_chosen_where_no_ancestor_can_be_sampled_and_parameters_are_few():
    assert "sample PMMH: the model has a deterministic state with infinite memory" in chosen(town())
    assert "parameters mix slowly" in chosen(town())
    assert "sample PMMH:" in chosen(integrated())  # of unknown length
    assert "sample PMMH:" in chosen(integrated(), {"y": np.zeros(101)})
    assert "more than 100 rows" in chosen(integrated(), [{"y": np.zeros(101)}, {"y": np.zeros(3)}])
    few = chosen(integrated(), {"y": np.zeros(100)})
    assert "sample PMMH: over twisted particle filters, where a pilot on the data finds" in few
    assert "else PGAS: the model is not" in few
    many = chosen(integrated(7))
    assert "else PGAS: the model has a deterministic state" in many
    assert "7 parameters are too many" in many
    moved = ssm.Model("moved by what is seen, from a start that is not known")
    moved.prior(lambda: {"a": ssm.Beta(2, 2)})
    moved.initial(lambda: {"h": ssm.Gamma(2, rate=2)})
    moved.transition(lambda h, y, a: {"h": ssm.Dirac(0.1 + 0.5 * h + a * y**2)})
    moved.observation(lambda h: {"y": ssm.Normal(0, variance=h)})
    assert "sample PMMH: the transition is noise-free" in chosen(moved)
    assert "with it as a parameter (h_first in @prior, ssm.Dirac(h_first) in @initial)" in chosen(
        moved
    )
    free = ssm.Model("free")
    free.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    free.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=1)})
    free.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    assert "sample PGAS: the model is not linear Gaussian" in chosen(free)


def test_sample_takes_what_explain_says_and_counts_free_parameters_only():
    def method(problem, **fixed):
        return _chosen(space_of(problem, fixed, {}), fixed)

    assert isinstance(method(pose(town(), {"y": np.full(4, 80.0)}))[0], ssm.PMMH)
    problem = pose(integrated(13), {"y": np.zeros(150)})  # too many for a pilot
    assert isinstance(method(problem)[0], ssm.PGAS)
    assert isinstance(method(problem, q=np.full(13, 0.2))[0], ssm.PMMH)


def test_a_pilot_decides_between_twisted_filters_and_pgas():
    """It refuses where the states are bimodal or the approximate posterior is ragged, and
    takes what is nearly Gaussian."""

    def chosen_for(model, truth):
        y = ssm.simulate(model, truth, steps=60, seed=1)["y"].values[0]
        space = space_of(pose(model, {"y": y.astype(float)}), {}, {})
        return _chosen(space, {})

    assert isinstance(chosen_for(wider.growth, None)[0], ssm.PGAS)
    overshooting = {"log_r": 2.8, "q": 0.1, "scale": 10.0, "dispersion": 20.0}
    assert isinstance(chosen_for(wider.ricker, overshooting)[0], ssm.PGAS)
    method, reason = chosen_for(standard.counts, None)
    assert isinstance(method, ssm.PMMH)
    assert "by a pilot" in reason


@pytest.mark.slow
def test_pgas_with_few_particles_warns_of_itself():
    y = ssm.simulate(town(), {"birth": 5.0, "seen": 0.8}, steps=100, seed=1)["y"].values[0]
    with pytest.warns(UserWarning, match="path degeneracy"):
        stuck = ssm.sample(
            town(), {"y": y}, ssm.PGAS(particles=4), draws=300, warmup=50, chains=2, seed=1,
            progress=False,
        )  # fmt: skip
    assert stuck["posterior"].attrs["trajectory_update_rate"] < 0.02


def made_up(paths):
    """Results of chains with these trajectories (chains, draws, T, D)."""
    return [ChainDraws({"path_0": p}, {}, {}, None) for p in paths]


def stuck_draws(steps, until, columns, rng):
    """Four chains of which the first rows stand still, apart from each other."""
    paths = rng.normal(size=(4, 100, steps, columns))
    paths[:, :, :until] = paths[:, :1, :until]
    return paths


def watched(paths, waiting=3):
    """What is left of them where draws leave trajectories out, after a warmup that does not count;
    (chains, draws, T, D)."""
    out = []
    for chain in paths:
        watch = PathMovement(waiting)
        for path in [*np.full_like(chain[:waiting], 9.0), *chain]:
            watch = watch.after([path])
        out.append(watch)
    return out


def made_up_without_paths(paths):
    states = [PGASState(*[None] * 4, path_movement=w) for w in watched(paths)]
    return [ChainDraws({"theta": np.zeros((len(p), 1))}, {}, {}, s)
            for p, s in zip(paths, states, strict=True)]  # fmt: skip


@pytest.mark.parametrize("chains", [1, 3])
def test_what_was_watched_is_what_the_draws_would_have_told(chains):
    rng = np.random.default_rng(4)
    paths = np.floor(rng.normal(size=(chains, 101, 4, 2)) * 2.0)
    paths[:, :, 1], paths[1:, :60, 2], paths[-1:, :, 3, 1] = 3.1, 7.0, 8.5
    rate, ever, apart = watched_movement(watched(paths), 0)
    expected = movement(paths)
    np.testing.assert_array_equal(rate, expected[0])
    np.testing.assert_array_equal(ever, expected[1])
    np.testing.assert_allclose(apart, expected[2], rtol=1e-12)


def test_rows_that_stand_still_are_told_without_draws_of_them():
    problem = pose(integrated(), {"y": np.zeros(9)})
    paths = stuck_draws(9, 3, 2, np.random.default_rng(1))
    with pytest.warns(UserWarning, match="3 rows from 1 to 3 "):
        expected = update_rate_attributes(problem, made_up(paths))
    with pytest.warns(UserWarning, match="3 rows from 1 to 3 "):
        assert update_rate_attributes(problem, made_up_without_paths(paths)) == expected
    assert update_rate_attributes(problem, made_up_without_paths(paths[:, :1])) == {}


def test_rows_that_stand_still_are_told_with_a_warning():
    problem = pose(integrated(), {"y": np.zeros(9)})
    paths = stuck_draws(9, 3, 2, np.random.default_rng(1))
    paths[:, 0:1, 2, 0] += 1.0  # the third row moves once in 99 times
    with pytest.warns(UserWarning, match="3 rows from 1 to 3 "):
        attrs = update_rate_attributes(problem, made_up(paths))
    assert attrs["trajectory_update_rate"] == 0.0
    assert "ssm.PMMH" in attrs["trajectory_warning"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free = update_rate_attributes(
            problem, made_up(stuck_draws(9, 0, 2, np.random.default_rng(1)))
        )
        assert free == {"trajectory_update_rate": 1.0}


def test_discrete_states_count_where_chains_differ():
    problem = pose(town(), {"y": np.full(6, 80.0)})
    free, discrete = random_components(problem, 6)
    assert not free[0].any()
    names = [s.data[1] for s in problem.trace.state_symbols]
    for k, name in enumerate(names):
        assert np.all(free[1:, k] == (name != "n"))
        assert np.all(discrete[1:, k] == (name != "n"))
    rng = np.random.default_rng(2)
    paths = rng.poisson(4.0, size=(4, 100, 6, 3)).astype(float)
    paths[:, :, 1] = 2.0  # the data determine it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert 0.5 < update_rate_attributes(problem, made_up(paths))["trajectory_update_rate"] < 1.0
    paths[2:, :, 1] = 3.0
    with pytest.warns(UserWarning, match="1 rows from 2 to 2 "):
        update_rate_attributes(problem, made_up(paths))


def test_r_hat_of_still_and_of_moving_chains():
    rng = np.random.default_rng(3)
    paths = rng.normal(size=(3, 200, 1, 3))
    paths[:, :, 0, 1] = 1.0
    paths[:, :, 0, 2] = np.arange(3)[:, None]
    found = movement(paths)[2][0]
    assert 1.0 <= found[0] < 1.05
    assert found[1] == 1.0
    assert found[2] == np.inf


def test_states_that_overflow_are_no_warning_of_numpys():
    paths = np.random.default_rng(3).normal(size=(3, 50, 2, 2))
    paths[1, 20:, 0, 0], paths[:, :, 1, 1] = np.inf, 1e200
    paths[:, ::2, 1, 1] = -1e300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rate, _, apart = movement(paths)
    assert apart[0, 0] == 1.0
    assert rate[0, 1] == 1.0


@pytest.mark.parametrize("size", [1, 1000, 5000])
def test_draws_that_are_read_in_pieces_count_as_whole_ones(monkeypatch, size):
    rng = np.random.default_rng(4)
    paths = np.floor(rng.normal(size=(3, 101, 4, 2)) * 2.0)
    paths[:, :, 1], paths[1:, :60, 2] = 3.1, 7.0
    monkeypatch.setattr(convergence, "PIECE", size)
    rate, ever, apart = movement(paths)
    np.testing.assert_array_equal(rate, np.mean(paths[:, 1:] != paths[:, :-1], axis=(0, 1)))
    np.testing.assert_array_equal(ever, (paths != paths[:1, :1]).any(axis=(0, 1)))
    within, between = paths.var(axis=1, ddof=1).mean(axis=0), paths.mean(axis=1).var(axis=0, ddof=1)
    moved = ever & (between > 0)
    assert moved.sum() == 6
    np.testing.assert_allclose(apart[moved], np.sqrt(1 + between / within)[moved], rtol=1e-12)
    np.testing.assert_array_equal(apart[1], 1.0)
