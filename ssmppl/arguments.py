"""Names of arguments that people bring from elsewhere, and what the argument is called here.

Of PyMC, Stan, NumPyro, TensorFlow Probability, SciPy, statsmodels, particles, pomp and MATLAB.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from ssmppl.errors import ArgumentError, listing

Function = TypeVar("Function", bound=Callable[..., Any])
Kind = TypeVar("Kind", bound=type)

Aliases = dict[str, tuple[str, ...]]

# Lower case and without underscores -> arguments of that meaning, of which a callable has one.
OF_VERBS: Aliases = {
    **dict.fromkeys(
        ("tune", "burn", "burnin", "nburn", "numwarmup", "nwarmup", "warm", "iterwarmup", "nadapt"),
        ("warmup",),
    ),
    **dict.fromkeys(
        (
            "numsamples",
            "nsamples",
            "samples",
            "niter",
            "iter",
            "iters",
            "iterations",
            "itersampling",
            "ndraws",
            "numdraws",
            "nmcmc",
            "size",
            "nsim",
            "reps",
        ),
        ("draws", "iterations", "trajectories", "repeats"),
    ),
    **dict.fromkeys(("numchains", "nchains", "chain"), ("chains",)),
    **dict.fromkeys(("thinning", "thinby"), ("thin",)),
    **dict.fromkeys(
        ("randomseed", "randomstate", "rng", "rngkey", "rngseed", "prngkey", "key"), ("seed",)
    ),
    **dict.fromkeys(
        ("cores", "njobs", "nproc", "workers", "parallel", "pool", "numcores", "parallelchains"),
        ("executor",),
    ),
    **dict.fromkeys(("progressbar", "verbose", "disp", "quiet", "showprogress"), ("progress",)),
    **dict.fromkeys(
        ("initvals", "init", "inits", "initparams", "startparams", "x0", "p0", "initial"),
        ("start",),
    ),
    **dict.fromkeys(("nparticles", "numparticles", "np", "n"), ("particles", "steps")),
    **dict.fromkeys(("params", "theta", "coef", "par"), ("parameters",)),
    **dict.fromkeys(("observed", "observations", "obs", "y", "endog", "df"), ("data",)),
    **dict.fromkeys(("exog", "covariates", "covars", "controls"), ("inputs",)),
    **dict.fromkeys(
        ("nsteps", "numsteps", "nrows", "h", "nahead", "periods"), ("steps", "horizon")
    ),
    **dict.fromkeys(("sampler", "algorithm", "algo", "kernel", "optimizer"), ("method",)),
    **dict.fromkeys(("targetaccept", "adaptdelta", "targetacceptprob"), ("target_acceptance",)),
    **dict.fromkeys(("essrmin", "essmin", "essthresh"), ("ess_threshold",)),
    **dict.fromkeys(("trace", "result", "results", "posterior"), ("idata",)),
}
OF_DISTRIBUTIONS: Aliases = {
    **dict.fromkeys(("sigma", "std", "stddev", "stdev", "sd"), ("sd", "scale", "covariance")),
    **dict.fromkeys(("var", "sigma2", "sigmasq", "variance"), ("variance", "covariance")),
    **dict.fromkeys(
        ("cov", "covariancematrix", "covar", "covariance", "scalematrix"),
        ("covariance", "variance", "scale"),
    ),
    **dict.fromkeys(("tau", "prec", "precisionmatrix"), ("precision",)),
    **dict.fromkeys(("chol", "scaletril", "tril", "l"), ("cholesky",)),
    **dict.fromkeys(("mu", "location", "mean", "loc", "m"), ("mean", "loc", "rate")),
    **dict.fromkeys(("lam", "lambda", "lmbda", "intensity"), ("rate",)),
    **dict.fromkeys(("nu", "degreesoffreedom", "dof"), ("df",)),
    **dict.fromkeys(("alpha", "concentration1"), ("a", "shape", "dispersion", "concentration")),
    **dict.fromkeys(("beta", "concentration0"), ("b", "rate", "scale")),
    **dict.fromkeys(("phi", "r", "overdispersion"), ("dispersion",)),
    **dict.fromkeys(("concentration", "k"), ("shape", "dispersion")),
    "kappa": ("concentration",),
    **dict.fromkeys(("scale", "s"), ("sd",)),
    **dict.fromkeys(("prob", "probs", "probability", "pi", "theta", "psi"), ("p", "scale")),
    **dict.fromkeys(("totalcount", "ntrials", "trials", "size"), ("n",)),
    **dict.fromkeys(("low", "min", "minval", "a", "left"), ("lower",)),
    **dict.fromkeys(("high", "max", "maxval", "b", "right"), ("upper",)),
    **dict.fromkeys(("w", "mixingprobs", "mix"), ("weights",)),
    **dict.fromkeys(("compdists", "distributions", "dists"), ("components",)),
    **dict.fromkeys(("dist", "distribution", "base"), ("law", "dist")),
}


def called_here(name: str, own: Sequence[str], aliases: Aliases) -> str:
    """The one of the arguments `own` that `name` means elsewhere; empty where none does."""
    for meant in aliases.get(name.lower().replace("_", ""), ()):
        if meant in own and meant != name:
            return meant
    return ""


def hint(name: str, own: Sequence[str], callable_: str, aliases: Aliases) -> str:
    """What to write for an argument that a callable does not have."""
    meant = called_here(name, own, aliases)
    if meant:
        return f"write {meant}="
    return f"the arguments of {callable_} are {listing(name, own)}"


def checked(function: Function) -> Function:
    """The function, with an ArgumentError in place of Python's TypeError where it is called with an
    argument that it does not have, or without one that it needs."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        _check(signature, function.__name__, args, kwargs)
        return function(*args, **kwargs)

    return called  # type: ignore[return-value]


def checked_settings(kind: Kind) -> Kind:
    """A class of settings whose arguments are checked likewise."""
    plain: Callable[..., None] = kind.__init__  # type: ignore[misc]
    signature = inspect.signature(kind)

    @functools.wraps(plain)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        _check(signature, kind.__name__, args, kwargs)
        plain(self, *args, **kwargs)

    kind.__init__ = init  # type: ignore[misc]
    return kind


def _check(
    signature: inspect.Signature, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> None:
    try:
        signature.bind(*args, **kwargs)
    except TypeError as error:
        own = list(signature.parameters)
        unknown = _unknown(kwargs, own)
        if unknown:
            raise ArgumentError(
                f"{name} has no argument {unknown!r}", fix=hint(unknown, own, name, OF_VERBS)
            ) from None
        called = ", ".join(_written(p) for p in signature.parameters.values())
        raise ArgumentError(f"{name}: {error}", fix=f"write {name}({called})") from None


def _unknown(given: Iterable[str], own: Sequence[str]) -> str:
    return next((n for n in given if n not in own), "")


def _written(parameter: inspect.Parameter) -> str:
    needed = parameter.default is parameter.empty
    return parameter.name if needed else f"{parameter.name}=..."
