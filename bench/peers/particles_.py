"""The package `particles` (N. Chopin)."""

from __future__ import annotations

import time
from functools import cache

import numpy as np
import particles
from particles import distributions as law
from particles import kalman, mcmc
from particles import state_space_models as models

from ssmppl.datasets import ice_varves

from .chains import Chains, draw_parameters
from .tasks import FFBSI_DRAWS, LGSS, PHI, TAU, Task, Work, lgss_series, linear_model, stopwatch

NAME, PACKAGES = "particles", ("particles",)
ITERATIONS, DRAWS = 5, 1_000


class Varves(models.StateSpaceModel):
    default_params = {"phi": PHI, "tau": TAU}  # noqa: RUF012

    def PX0(self):
        return law.Normal(scale=1 / np.sqrt((1 - self.phi**2) * self.tau))

    def PX(self, t, xp):
        return law.Normal(loc=self.phi * xp, scale=1 / np.sqrt(self.tau))

    def PY(self, t, xp, x):
        return law.Gamma(a=6.25, b=0.256 * np.exp(-x))

    def upper_bound_log_pt(self, t):
        return -0.5 * np.log(2 * np.pi / self.tau)


class Linear(models.StateSpaceModel):
    def PX0(self):
        return law.Normal(scale=1.0)

    def PX(self, t, xp):
        return law.Normal(loc=LGSS["phi"] * xp, scale=np.sqrt(LGSS["q"]))

    def PY(self, t, xp, x):
        return law.Normal(loc=x, scale=np.sqrt(LGSS["r"]))

    def proposal0(self, data):
        return self._locally_optimal(0.0, 1.0, data[0])

    def proposal(self, t, xp, data):
        return self._locally_optimal(LGSS["phi"] * xp, LGSS["q"], data[t])

    @staticmethod
    def _locally_optimal(mean, variance, y):
        gain = variance / (variance + LGSS["r"])
        return law.Normal(loc=mean + gain * (y - mean), scale=np.sqrt(gain * LGSS["r"]))


@cache
def _pgas(n: int) -> Chains:
    """The package's conditional SMC and backward sampling, with the Gibbs step by hand."""
    y, rng = ice_varves(), np.random.default_rng(1)

    def run() -> tuple[float, np.ndarray]:
        path, phi, tau, draws = list(np.log(0.256 / 6.25 * y)), PHI, TAU, np.empty((DRAWS, 2))
        start = time.perf_counter()
        for i in range(DRAWS):
            of = models.Bootstrap(ssm=Varves(phi=phi, tau=tau), data=y)
            smc = mcmc.CSMC(fk=of, N=n, xstar=path)
            smc.run()
            path = list(np.ravel(smc.hist.backward_sampling(1)))
            phi, tau = draw_parameters(rng, np.array(path), phi)
            draws[i] = phi, tau
        return time.perf_counter() - start, draws

    return Chains(run)


def prepare(task: Task) -> Work | None:
    y = ice_varves()
    if task.kind in ("bootstrap", "guided"):
        if task.kind == "bootstrap":
            feynman_kac = models.Bootstrap(ssm=Varves(), data=y)
        else:
            feynman_kac = models.GuidedPF(ssm=Linear(), data=lgss_series())
        run = stopwatch(
            lambda: particles.SMC(
                fk=feynman_kac, N=task.n, resampling="systematic", ESSrmin=1.0
            ).run()
        )
    elif task.kind == "pmmh":

        def chain() -> None:
            """Random walk Metropolis over the package's filter, the flat parts of the prior left
            out: `mcmc.PMMH` of particles 0.3 itself fails under NumPy 2."""
            rng, theta, log_z = np.random.default_rng(1), np.array([PHI, TAU]), -np.inf
            for _ in range(ITERATIONS):
                phi, tau = theta + rng.normal(size=2) * (0.01, np.sqrt(10.0))
                if abs(phi) >= 1 or tau <= 0:
                    continue
                smc = particles.SMC(
                    fk=models.Bootstrap(ssm=Varves(phi=phi, tau=tau), data=y), N=task.n,
                    resampling="systematic", ESSrmin=1.0,
                )  # fmt: skip
                smc.run()
                new = smc.logLt - 0.99 * np.log(tau) - 0.01 * tau
                if np.log(rng.uniform()) < new - log_z:
                    theta, log_z = np.array([phi, tau]), new

        timed = stopwatch(chain)
        run = lambda: timed() / ITERATIONS  # noqa: E731
    elif task.kind == "csmc":
        feynman_kac = models.Bootstrap(ssm=Varves(), data=y)
        reference = list(np.log(0.256 / 6.25 * y))

        def sweep() -> None:
            smc = mcmc.CSMC(fk=feynman_kac, N=task.n, xstar=reference)
            smc.run()
            smc.hist.backward_sampling(1)

        run = stopwatch(sweep)
    elif task.kind.startswith("pgas-"):
        return _pgas(task.n).work(task.kind.removeprefix("pgas-"))
    elif task.kind in ("ffbsi", "ffbsi-rejection"):
        feynman_kac, by_rejection = models.Bootstrap(ssm=Varves(), data=y), "-" in task.kind

        def smooth() -> None:
            smc = particles.SMC(
                fk=feynman_kac, N=task.n, resampling="systematic", ESSrmin=1.0, store_history=True
            )
            smc.run()
            smc.hist.backward_sampling(FFBSI_DRAWS, linear_cost=by_rejection)

        run = stopwatch(smooth)
    elif task.kind == "kalman":
        m, data = linear_model(task.n)
        model = kalman.MVLinearGauss(
            F=m["a"], G=m["c"], covX=m["q"], covY=m["r"], mu0=m["m"], cov0=m["p"]
        )
        run = stopwatch(lambda: kalman.Kalman(ssm=model, data=list(data)).filter())
    else:
        return None
    run()
    return run
