"""Run by the Python of an environment that ssmppl was installed into: makes the archives of machine
code that a wheel carries (`ssmppl/codegen/store/shipped.py`), one for each target there.

    python machine_code.py FOLDER [MODELS]

First models of many kinds are fitted, with every verb that a first session is likely to have, and
what they ask of the compiler is written down: the text of each kernel that all models share, and
the types that it is called with. Then all of it is compiled for each target, in a process for which
Numba's processor is that target, and not this machine: the code is not run here, so that the
machine need not be of that level itself.

MODELS are the numbers of some of the models, for a smaller archive; all if none are given.

No pytest, and nothing of the source tree: this file alone is copied to where it runs.
"""

import contextlib
import importlib
import inspect
import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

SHARED = ("for functions that are called by their addresses", "the same for all models")
FEW = {"draws": 4, "warmup": 4, "chains": 1, "seed": 1, "progress": False}


def models():
    """Models with data: each of another kind, as its kernels are."""
    import ssmppl as ssm

    rng = np.random.default_rng(1)
    walk = np.cumsum(rng.normal(size=60))
    gaps = np.where(np.arange(60) % 7 == 3, np.nan, walk + rng.normal(size=60))

    varves = ssm.Model("varves")
    varves.prior(lambda: {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(2.0, rate=0.1)})
    varves.initial(lambda phi, tau: {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)})
    varves.transition(lambda x, phi, tau: {"x": ssm.Normal(phi * x, precision=tau)})
    varves.observation(lambda x: {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))})
    yield varves, {"y": 25 * rng.gamma(6.25, 1 / 6.25, size=60)}, {"phi": 0.9, "tau": 20.0}

    level = ssm.Model("level")
    level.prior(
        lambda: {"q": ssm.InverseGamma(2.0, scale=1.0), "r": ssm.InverseGamma(2.0, scale=1.0)}
    )
    level.initial(lambda: {"x": ssm.Normal(0, sd=3)})
    level.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    level.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})
    yield level, {"y": gaps}, {"q": 1.0, "r": 1.0}

    heavy = ssm.Model("heavy tails")
    heavy.prior(lambda: {"q": ssm.HalfNormal(sd=1.0), "r": ssm.HalfNormal(sd=1.0)})
    heavy.initial(lambda: {"x": ssm.Normal(0, sd=3)})
    heavy.transition(lambda x, q: {"x": ssm.Normal(x + 0.1 * np.sin(x), sd=q)})
    heavy.observation(lambda x, r: {"y": ssm.StudentT(4.0, x, scale=r)})
    yield heavy, {"y": gaps}, {"q": 1.0, "r": 1.0}

    counts = ssm.Model("counts", inputs=("u",))
    counts.prior(lambda: {"b": ssm.Normal(0, sd=1.0), "q": ssm.HalfNormal(sd=1.0)})
    counts.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    counts.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    counts.observation(lambda x, b, u: {"y": ssm.Poisson(np.exp(x + b * u))})
    data = {"y": rng.poisson(np.exp(walk / 8)).astype(float), "u": rng.normal(size=60)}
    yield counts, data, {"b": 0.1, "q": 0.2}

    flat = ssm.Model("flat")
    flat.prior(lambda: {"q": ssm.HalfNormal(sd=1.0), "r": ssm.HalfNormal(sd=1.0)})
    flat.initial(lambda: {"x": ssm.Flat()})
    flat.transition(lambda x, q: {"x": ssm.Normal(x, sd=q)})
    flat.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    yield flat, {"y": gaps}, {"q": 1.0, "r": 1.0}

    regimes = ssm.Model("regimes")
    regimes.prior(lambda: {"p": ssm.Beta(8, 2), "m": ssm.Normal(0, sd=3)})
    regimes.initial(lambda: {"s": ssm.Bernoulli(0.5)})
    regimes.transition(lambda s, p: {"s": ssm.Bernoulli(s * p + (1 - s) * (1 - p))})
    regimes.observation(lambda s, m: {"y": ssm.Normal(m * s, sd=1.0)})
    yield regimes, {"y": walk}, {"p": 0.8, "m": 1.0}


def use(model, data, at):
    """What a first session has; what a kind of model cannot do, it does without."""
    import ssmppl as ssm

    ssm.explain(model, data)  # a mistake in the model itself ends the build

    def tried(verb, *args, **options):
        with contextlib.suppress(ssm.errors.SSMError):
            return verb(model, *args, **options)

    for proposal in ("bootstrap", "guided", "auxiliary", "twisted", "auto"):
        tried(ssm.log_likelihood, data, at, proposal=proposal, seed=1)
    tried(ssm.log_likelihood, data, at)
    tried(ssm.maximize, data, seed=1)
    for method in (ssm.PMMH(), ssm.PGAS(), ssm.PGAS(interweave="auto"), ssm.Gibbs(), None):
        drawn = tried(ssm.sample, data, *([] if method is None else [method]), **FEW)
        if drawn is not None and method is None:
            tried(ssm.forecast, drawn, steps=3, data=data, seed=1)
    tried(ssm.smooth, data, at, seed=1)
    tried(ssm.particle_filter, data, at, seed=1)
    tried(ssm.kalman_filter, data, at)
    tried(ssm.simulate, at, steps=20, seed=1)


def record(chosen):
    """The texts of the shared modules, in order, and the calls: (module, function, types)."""
    from ssmppl.codegen.store import folder

    texts, calls, names = {}, {}, {}
    load, look_up = folder.load, folder.Kept.load_overload

    def loaded(name, text):
        module = load(name, text)
        names[module.__name__.partition(".")[2]] = name
        if any(words in text[:300] for words in SHARED):
            texts[(name, text)] = None
        return module

    def looked_up(self, signature, target):
        calls[(self.shipped_name(signature), self._stem)] = signature
        return look_up(self, signature, target)

    folder.load, folder.Kept.load_overload = loaded, looked_up
    for k, (model, data, at) in enumerate(models()):
        if k in chosen or not chosen:
            print(f"    {model.name}", flush=True)
            use(model, data, at)
    return list(texts), [(stem, signature) for (_, stem), signature in calls.items()]


def compile_all(texts, calls, path):
    """Compile what was asked for, for Numba's processor, into an archive."""
    from numba.core.errors import TypingError

    from ssmppl.codegen.native.library import function_ir
    from ssmppl.codegen.native.translate import Untranslatable
    from ssmppl.codegen.store import folder, shipped
    from ssmppl.expressions.operations import KERNELS

    entries = {}

    def save(self, signature, compiled):
        if not compiled.library.has_dynamic_globals:
            entries[self.shipped_name(signature)] = folder.dumps(compiled._reduce())
        keep(self, signature, compiled)

    keep, folder.Kept.save_overload = folder.Kept.save_overload, save
    functions = {}
    for name, text in texts:
        module = folder.load(name, text)
        for value in vars(module).values():
            if isinstance(getattr(value, "_cache", None), folder.Kept):
                functions[value._cache._stem] = value
    for stem, signature in calls:
        if stem in functions:
            functions[stem].compile(signature)
    for name, home in KERNELS.items():
        module = importlib.import_module(f"ssmppl.codegen.kernels.math.{home}")
        function = getattr(module, name)
        parameters = list(inspect.signature(getattr(function, "py_func", function)).parameters)
        draws = parameters[:1] in (["rng"], ["state"])
        arity = len(parameters) - draws
        with contextlib.suppress(Untranslatable, TypingError):  # of tuples or whole numbers
            entries[f"lib_{name}_{arity}.ll"] = function_ir(name, arity, draws).encode()
    shipped.write(path, entries, folder.kernels_digest())
    print(
        f"    {path.name}: {len(entries)} entries, {path.stat().st_size / 1e6:.2f} MB", flush=True
    )


def main():
    out, chosen = Path(sys.argv[1]), [int(k) for k in sys.argv[2:]]
    if out.suffix:  # of one target, in a process of its own
        compile_all(*pickle.load(sys.stdin.buffer), out)
        return
    from ssmppl.codegen.store import shipped

    asked = pickle.dumps(record(chosen))
    for target, (processor, features) in shipped.TARGETS.items():
        with tempfile.TemporaryDirectory() as cache:
            env = os.environ | {"SSMPPL_CACHE": cache, "NUMBA_CPU_NAME": processor}
            env["NUMBA_CPU_FEATURES"] = features
            command = [sys.executable, __file__, str(out / f"{target}{shipped.SUFFIX}")]
            subprocess.run(command, input=asked, env=env, check=True)


if __name__ == "__main__":
    main()
