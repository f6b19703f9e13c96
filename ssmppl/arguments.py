"""Names of arguments that people bring from elsewhere, and what the argument is called here.

Of PyMC, Stan, NumPyro, TensorFlow Probability, SciPy, statsmodels, particles, pomp and MATLAB.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from ssmppl.errors import ArgumentError, listing

Function = TypeVar("Function", bound=Callable[..., Any])
Kind = TypeVar("Kind", bound=type)

Aliases = dict[str, tuple[str, ...]]


def _aliases(*rows: tuple[str, str]) -> Aliases:
    """Of rows: names, and the arguments of that meaning."""
    return {name: tuple(meant.split()) for names, meant in rows for name in names.split()}


# Lower case and without underscores -> arguments of that meaning, of which a callable has one.
OF_VERBS = _aliases(
    ("tune burn burnin nburn numwarmup nwarmup warm iterwarmup nadapt", "warmup"),
    ("numsamples nsamples samples niter iter iters iterations itersampling ndraws numdraws nmcmc",
     "draws iterations trajectories repeats"),
    ("size nsim reps", "draws iterations trajectories repeats"),
    ("numchains nchains chain", "chains"),
    ("thinning thinby", "thin"),
    ("randomseed randomstate rng rngkey rngseed prngkey key", "seed"),
    ("cores njobs nproc workers parallel pool numcores parallelchains", "executor"),
    ("progressbar verbose disp quiet showprogress", "progress"),
    ("initvals init inits initparams startparams x0 p0 initial", "start"),
    ("nparticles numparticles np n", "particles steps"),
    ("params theta coef par", "parameters"),
    ("observed observations obs y endog df", "data"),
    ("exog covariates covars controls", "inputs"),
    ("nsteps numsteps nrows h nahead periods", "steps horizon"),
    ("sampler algorithm algo kernel optimizer", "method"),
    ("targetaccept adaptdelta targetacceptprob", "target_acceptance"),
    ("essrmin essmin essthresh", "ess_threshold"),
    ("trace result results posterior", "idata"),
)  # fmt: skip
OF_DISTRIBUTIONS = _aliases(
    ("sigma std stddev stdev sd", "sd scale covariance"),
    ("var sigma2 sigmasq variance", "variance covariance"),
    ("cov covariancematrix covar covariance scalematrix", "covariance variance scale"),
    ("tau prec precisionmatrix", "precision"),
    ("chol scaletril tril l", "cholesky"),
    ("mu location mean loc m", "mean loc rate"),
    ("lam lambda lmbda intensity", "rate"),
    ("nu degreesoffreedom dof", "df"),
    ("alpha concentration1", "a shape dispersion concentration"),
    ("beta concentration0", "b rate scale"),
    ("phi r overdispersion", "dispersion"),
    ("concentration k", "shape dispersion"),
    ("kappa", "concentration"),
    ("scale s", "sd"),
    ("prob probs probability pi theta psi", "p scale"),
    ("totalcount ntrials trials size", "n"),
    ("low min minval a left", "lower"),
    ("high max maxval b right", "upper"),
    ("w mixingprobs mix", "weights"),
    ("compdists distributions dists", "components"),
    ("dist distribution base", "law dist"),
)


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
        unknown = next((n for n in kwargs if n not in own), "")
        if unknown:
            raise ArgumentError(
                f"{name} has no argument {unknown!r}", fix=hint(unknown, own, name, OF_VERBS)
            ) from None
        called = ", ".join(_written(p) for p in signature.parameters.values())
        raise ArgumentError(f"{name}: {error}", fix=f"write {name}({called})") from None


def _written(parameter: inspect.Parameter) -> str:
    needed = parameter.default is parameter.empty
    return parameter.name if needed else f"{parameter.name}=..."
