"""Stochastic volatility with leverage: a fall of the price raises the volatility of the days after.

Daily returns y_t in percent, with log variance x_t. Shocks to the return and to the next log
variance have the correlation rho = psi / sqrt(psi^2 + omega): the transition names y_t. The
parameters are those in which the updates are conjugate: E. Jacquier, N. G. Polson and P. E. Rossi,
"Bayesian analysis of stochastic volatility models with fat-tails and correlated errors", *Journal
of Econometrics* 122 (2004).
"""

import numpy as np

import ssmppl as ssm

volatility = ssm.Model("stochastic volatility")


@volatility.prior
def prior():
    return {
        "drift": ssm.Normal(0, sd=0.2),
        "alpha": ssm.Normal(0, sd=1),
        "phi": ssm.Truncated(ssm.Normal(0.95, sd=0.1), lower=-1, upper=1),
        "psi": ssm.Normal(0, sd=0.5),
        "omega": ssm.InverseGamma(2.5, scale=0.05),
    }


@volatility.initial
def initial():
    return {"x": ssm.Normal(0, sd=2)}


@volatility.transition
def transition(x, y, drift, alpha, phi, psi, omega):
    shock = (y - drift) * np.exp(-x / 2)  # of the return, in its standard deviations
    return {"x": ssm.Normal(alpha + phi * x + psi * shock, variance=omega)}


@volatility.observation
def observation(x, drift):
    return {"y": ssm.Normal(drift, sd=np.exp(x / 2))}
