"""The models of Schön et al. (2015), and the local level model of the Nile."""

from __future__ import annotations

import ssmppl as ssm
from ssmppl.demo import varves

__all__ = ["lgss", "nile_diffuse", "nile_vague", "varves"]


def lgss(c: float) -> ssm.Model:
    """The linear Gaussian model: gain c is 0.5 in the main text, 1 in the appendix."""
    model = ssm.Model(f"lgss, gain {c:g}")

    @model.prior
    def prior():
        return {"theta": ssm.Gamma(0.01, rate=0.01)}

    @model.initial
    def initial(theta):
        return {"x": ssm.Normal(0, precision=0.51 * theta)}

    @model.transition
    def transition(x, theta):
        return {"x": ssm.Normal(0.7 * x, precision=theta)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(c * x, variance=0.1)}

    return model


def _nile(label: str, first: ssm.Normal | ssm.Flat) -> ssm.Model:
    model = ssm.Model(f"nile, {label} start")

    @model.prior
    def prior():
        return {"r": ssm.HalfFlat(), "q": ssm.HalfFlat()}

    @model.initial
    def initial():
        return {"level": first}

    @model.transition
    def transition(level, q):
        return {"level": ssm.Normal(level, variance=q)}

    @model.observation
    def observation(level, r):
        return {"y": ssm.Normal(level, variance=r)}

    return model


nile_vague = _nile("vague", ssm.Normal(0, variance=1e7))
nile_diffuse = _nile("diffuse", ssm.Flat())
