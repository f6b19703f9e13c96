"""Coarse discretisation of a step with a guard: left out by itself, and nothing with it."""

import numpy as np

import ssmppl as ssm
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.screening.screen import ScreenDesign
from ssmppl.inference.run.problem import missing_of, pose


def population(guarded):
    """Susceptible people that are used up, and cannot be fewer than one."""
    model = ssm.Model("epidemic")
    model.prior(lambda: {"beta": ssm.LogNormal(-4.0, sd=0.5), "q": ssm.LogNormal(-1.0, sd=0.5)})
    model.initial(lambda: {"l": ssm.Normal(0.0, sd=1.0), "s": ssm.Normal(130.0, sd=40.0)})

    @model.transition
    def transition(l, s, beta, q):
        left = s + 1.0 - np.exp(l)
        left = np.maximum(left, 1.0) if guarded else left
        return {"l": ssm.Normal(l + 0.1 * beta * left, sd=q), "s": ssm.Normal(left, sd=0.1)}

    model.observation(lambda l: {"y": ssm.Normal(l, sd=0.1)})
    return model


def test_a_derivative_that_jumps_is_no_increment():
    y = np.random.default_rng(1).normal(size=60)
    for guarded in (False, True):
        problem = pose(population(guarded), {"y": y})
        states = np.random.default_rng(2).normal(size=(60, 2)) + [0.0, 130.0]
        scales = Scales.of(problem.trace, states, y[:, None], np.zeros((60, 0)), 60)
        found, refused = offers(problem.trace, scales, ("coarse discretisation",))
        assert bool(found) is not guarded
        assert any("jumps" in r.reason for r in refused) is guarded
        names = ("coarse discretisation", "constant load", "cubic stiffness")
        missing = missing_of(problem.experiments)
        design = ScreenDesign(problem.trace, scales, missing, (), Settings(), names)
        assert "beta" in {repr(s) for s in design.columns.nuisance}
        assert {"constant load", "cubic stiffness"} <= {
            c.effect.name for c in design.candidates if c.equation == "s"
        }
