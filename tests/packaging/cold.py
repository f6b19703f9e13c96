"""Run by the Python of an environment that a wheel with machine code was installed into, with an
empty cache: first log-likelihoods take the shared kernels from the wheel, and give the same numbers
as what is compiled here.

No pytest, and nothing of the source tree: this file alone is copied to where it runs.
"""

import json
import os
import subprocess
import sys
import tempfile

FIRST = """
import json, sys, time
began = time.perf_counter(), time.process_time()
import numpy as np
import ssmppl as ssm
from ssmppl import datasets
from ssmppl.codegen.store import folder, shipped
if sys.argv[1] == "without":
    shipped.FOLDER = shipped.FOLDER / "none"
varves = ssm.Model("ice varves")
varves.prior(lambda: {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)})
varves.initial(lambda phi, tau: {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)})
varves.transition(lambda x, phi, tau: {"x": ssm.Normal(phi * x, precision=tau)})
varves.observation(lambda x: {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))})
nile = ssm.Model("local level")
variance = ssm.InverseGamma(2.0, scale=5000.0)
nile.prior(lambda: {"q": variance, "r": variance})
nile.initial(lambda: {"level": ssm.Normal(1000, sd=300)})
nile.transition(lambda level, q: {"level": ssm.Normal(level, variance=q)})
nile.observation(lambda level, r: {"flow": ssm.Normal(level, variance=r)})
data, at = {"y": datasets.ice_varves()}, {"phi": 0.95, "tau": 50.0}
linear, where = {"flow": datasets.nile()}, {"q": 1500.0, "r": 15000.0}
if sys.argv[2] == "nonlinear":
    found = [ssm.log_likelihood(varves, data, at, proposal="bootstrap", seed=1)]
else:
    found = [ssm.log_likelihood(nile, linear, where)]
seconds = time.perf_counter() - began[0], time.process_time() - began[1]
compiled = sorted(p.name for p in folder.cache_folder().iterdir() if p.suffix in (".nbc", ".ll"))
print(json.dumps([[float(f[0]).hex() for f in found], seconds, shipped.taken, compiled]))
"""


def first(how, kind):
    """In a process of its own: (numbers, seconds on the clock and of the processor, names of what
    was taken from the wheel, of what was compiled)."""
    with tempfile.TemporaryDirectory() as cache:
        env = os.environ | {"SSMPPL_CACHE": cache}
        command = [sys.executable, "-c", FIRST, how, kind]
        ran = subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(ran.stdout)


if __name__ == "__main__":
    first("with", "linear")  # Python compiles the package itself
    for kind in ("nonlinear", "linear"):
        numbers, (clock, processor), taken, compiled = first("with", kind)
        assert taken, "nothing was taken from the wheel"
        assert not compiled, compiled
        expected, (slow, slow_processor), nothing, _ = first("without", kind)
        assert not nothing
        assert numbers == expected, (numbers, expected)
        print(
            f"{kind}: {len(taken)} kernels from the wheel, first log-likelihood with all imports "
            f"after {clock:.2f} s ({processor:.2f} of the processor), "
            f"without the wheel's code {slow:.2f} s ({slow_processor:.2f})"
        )
