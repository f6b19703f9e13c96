"""An epidemic in a school, of which only some cases are reported: SEIR in whole persons and days.

Every day, out of S susceptible, E exposed and I infectious persons, some are infected, some fall
ill, and some recover: three binomial variables. A state may not look at the new value of another
one, so the flows of a day are states themselves, and the next day starts by carrying them out.
"""

import numpy as np

import ssmppl as ssm

POPULATION = 800

epidemic = ssm.Model("SEIR")


@epidemic.prior
def prior():
    return {
        "beta": ssm.LogNormal(np.log(0.6), sd=0.5),  # infectious contacts a day
        "fall_ill": ssm.Beta(20, 40),  # probability a day; about three days from exposed to ill
        "recover": ssm.Beta(20, 60),  # probability a day; about four days infectious
        "rho": ssm.Beta(2, 2),  # share of the cases that are reported
    }


@epidemic.initial
def initial():
    return {
        "S": ssm.Dirac(POPULATION - 5),
        "E": ssm.Dirac(5),
        "I": ssm.Dirac(0),
        "infected": ssm.Dirac(0),
        "onsets": ssm.Dirac(0),
        "recovered": ssm.Dirac(0),
    }


@epidemic.transition
def transition(S, E, I, infected, onsets, recovered, beta, fall_ill, recover):
    s, e, i = S - infected, E + infected - onsets, I + onsets - recovered
    return {
        "S": ssm.Dirac(s),
        "E": ssm.Dirac(e),
        "I": ssm.Dirac(i),
        "infected": ssm.Binomial(s, 1 - np.exp(-beta * i / POPULATION)),
        "onsets": ssm.Binomial(e, fall_ill),
        "recovered": ssm.Binomial(i, recover),
    }


@epidemic.observation
def observation(onsets, rho):
    return {"reported": ssm.Binomial(onsets, rho)}
