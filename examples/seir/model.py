"""An epidemic in a school, of which only some cases are reported: SEIR in whole persons and days.

Every day, out of S susceptible, E exposed and I infectious persons, some are infected, some fall
ill, and some recover: three binomial variables, the flows. They are drawn first, and the
compartments are then what they were with the flows taken out and put in.
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
        "onsets": ssm.Dirac(0),
    }


@epidemic.transition
def flows(S, E, I, beta, fall_ill, recover):
    return {
        "infected": ssm.Binomial(S, 1 - np.exp(-beta * I / POPULATION)),
        "onsets": ssm.Binomial(E, fall_ill),
        "recovered": ssm.Binomial(I, recover),
    }


@epidemic.transition
def compartments(S, E, I, infected_next, onsets_next, recovered_next):
    return {
        "S": ssm.Dirac(S - infected_next),
        "E": ssm.Dirac(E + infected_next - onsets_next),
        "I": ssm.Dirac(I + onsets_next - recovered_next),
    }


@epidemic.observation
def observation(onsets, rho):
    return {"reported": ssm.Binomial(onsets, rho)}
