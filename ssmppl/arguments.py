"""Names of arguments that people bring from elsewhere, and what the argument is called here.

Of PyMC, Stan, NumPyro, TensorFlow Probability, SciPy, statsmodels, particles, pomp and MATLAB.
"""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from ssmppl.errors import ArgumentError
from ssmppl.status import call_of

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
     "draws iterations trajectories repeats steps"),
    ("maxiter maxit maxiterations nmif emiter", "iterations steps"),
    ("tol ftol xtol gtol rtol", "tolerance"),
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
    ("nsteps numsteps nrows h nahead periods nobs nsimulations nforecast", "steps horizon"),
    ("sampler algorithm algo kernel optimizer", "method"),
    ("targetaccept adaptdelta targetacceptprob", "target_acceptance"),
    ("essrmin essmin essthresh", "ess_threshold"),
    ("rwsd", "perturbation"),
    ("coolingfraction coolingfraction50", "cooling"),
    ("trace result results posterior", "idata"),
)  # fmt: skip
OF_MODELS = _aliases(
    ("covariates covariate covar covars exog controls u input", "inputs"),
    ("ts dt deltat sampletime sampling tsample step", "time_step"),
    ("unit units id group groups panel site subject", "experiment"),
)
# Of a distribution only what means the very same. What a name means in one distribution alone
# follows below, by its class; there, more than the name may have to be written.
OF_DISTRIBUTIONS = _aliases(
    ("sigma", "sd scale covariance"),
    ("std stddev stdev sd", "sd"),
    ("var sigma2 sigmasq variance", "variance"),
    ("cov covariancematrix covar covariance", "covariance variance"),
    ("scalematrix", "scale covariance"),
    ("tau prec precisionmatrix", "precision"),
    ("chol scaletril tril l", "cholesky"),
    ("mu location mean loc m", "mean loc"),
    ("lam lambda lmbda intensity", "rate"),
    ("nu degreesoffreedom dof", "df"),
    ("alpha concentration1", "a shape concentration"),
    ("beta concentration0", "b rate scale"),
    ("concentration k", "shape"),
    ("kappa", "concentration"),
    ("scale s", "sd"),
    ("prob probs probability pi theta psi", "p"),
    ("totalcount ntrials trials size", "n"),
    ("low min minval a left", "lower"),
    ("high max maxval b right", "upper"),
    ("w mixingprobs mix", "weights"),
    ("compdists distributions dists", "components"),
    ("dist distribution base", "law dist"),
)  # fmt: skip
_COUNTS = "dispersion=, of the variance mean + mean**2 / dispersion"
_LOGARITHM = "sd=, of the logarithm; where scale is SciPy's, exp(mean), write mean=np.log(scale)"
_SHAPE_OF_MOMENTS = "shape=mu**2 / sigma**2, rate=mu / sigma**2, of the mean mu and the sd sigma"
_INVERSE_OF_MOMENTS = (
    "shape=(mu / sigma)**2 + 2, scale=mu * ((mu / sigma)**2 + 1), of the mean mu and the sd sigma"
)
_BETA_OF_MEAN = "a=mu * kappa, b=(1 - mu) * kappa, of the mean mu and the size kappa"
OF_ONE_DISTRIBUTION: dict[str, dict[str, str]] = {
    "Beta": dict.fromkeys(("mu", "mean", "kappa", "phi", "nu"), _BETA_OF_MEAN),
    "BetaBinomial": dict.fromkeys(("mu", "mean", "kappa", "phi", "nu"), _BETA_OF_MEAN),
    "Dirichlet": dict.fromkeys(("a", "alphas"), "concentration="),
    "Skellam": {"mu1": "rate1=", "mu2": "rate2="},
    "Exponential": {
        **dict.fromkeys(("mu", "mean", "theta"), "scale="),
        "beta": "rate=, or scale= where beta is NumPy's, the mean",
    },
    "Gamma": {
        **dict.fromkeys(("mu", "mean", "sigma", "sd", "std"), _SHAPE_OF_MOMENTS),
        "a": "shape=", "theta": "scale=",
    },
    "InverseGamma": {
        **dict.fromkeys(("mu", "mean", "sigma", "sd", "std"), _INVERSE_OF_MOMENTS),
        "a": "shape=",
    },
    "InverseWishart": dict.fromkeys(("v", "psi", "s"), "scale="),
    "Laplace": {
        "b": "scale=",
        **dict.fromkeys(("sd", "std"), "scale=sd / np.sqrt(2)"),
    },
    "LogNormal": {"scale": _LOGARITHM, "s": "sd="},
    "MvNormal": {
        **dict.fromkeys(("sd", "std", "scale", "scalediag"), "covariance=np.diag(sd**2)"),
        "var": "covariance=", "variance": "covariance=", "scaletril": "cholesky=",
    },
    "NegativeBinomial": {
        **dict.fromkeys(("phi", "r", "size", "n", "totalcount", "theta", "k", "concentration"),
                        _COUNTS),
        "alpha": f"{_COUNTS}; statsmodels' alpha is 1 / dispersion",
        **dict.fromkeys(("p", "prob", "probs"),
                        "mean=n * (1 - p) / p, dispersion=n, of n failures and the probability p"),
    },
    "Poisson": dict.fromkeys(("mu", "mean"), "rate="),
    "StudentT": dict.fromkeys(("sd", "std"), "scale=sd * np.sqrt((df - 2) / df)"),
    "Uniform": {"a": "lower=", "b": "upper="},
    "Weibull": {
        **dict.fromkeys(("lam", "lambda", "sigma"), "scale="), "c": "shape=",
    },
    "Wishart": dict.fromkeys(("v", "s", "w"), "scale="),
}  # fmt: skip
ALIKE = 0.8  # of two spellings, by difflib, from which one is taken for a slip of the other
MOST_NAMED = 3  # methods or verbs that a message names
EXECUTOR = "executor=, a pool of concurrent.futures, as ThreadPoolExecutor(4)"


@dataclass(frozen=True)
class _Verb:
    """Its arguments, the classes of its methods' settings, and what it is an attribute of."""

    own: list[str]
    methods: tuple[type, ...]
    place: str = "ssm"


# Filled by the decorators below; by name, in the order of import.
_VERBS: dict[str, _Verb] = {}
_SETTINGS: dict[type, list[str]] = {}


def called_here(name: str, own: Sequence[str], aliases: Aliases) -> str:
    """The one of the arguments `own` that `name` means elsewhere; empty where none does."""
    for meant in aliases.get(_plain(name), ()):
        if meant in own and meant != name:
            return meant
    return ""


def distribution_hint(name: str, own: Sequence[str], distribution: str) -> str:
    """What to write for an argument that a distribution does not have."""
    special = OF_ONE_DISTRIBUTION.get(distribution, {}).get(_plain(name))
    if special:
        return f"write {special}"
    return _renamed(name, own, OF_DISTRIBUTIONS) or _own_arguments(distribution, own)


def _plain(name: str) -> str:
    return name.lower().replace("_", "")


def _renamed(name: str, own: Sequence[str], aliases: Aliases) -> str:
    """What to write for an argument of another name here, or misspelt; empty where it is none."""
    meant = called_here(name, own, aliases)
    if not meant:
        meant = next(iter(difflib.get_close_matches(name.lower(), own, 1, ALIKE)), "")
    if meant == "executor":
        return f"write {EXECUTOR}"
    return f"write {meant}=" if meant else ""


def _own_arguments(callable_: str, own: Sequence[str]) -> str:
    return f"the arguments of {callable_} are {', '.join(own)}" if own else (
        f"{callable_} has no arguments"
    )  # fmt: skip


def _verb_hint(name: str, own: Sequence[str], verb: str) -> str:
    """What to write for an argument that a verb does not have: its name here, the setting of a
    method that it is, or the verbs that have it."""
    methods = _VERBS[verb].methods
    exact = [f"ssm.{m.__name__}({name}=...)" for m in methods if name in _SETTINGS.get(m, ())]
    if exact:
        return f"it is a setting of the method: write method={_either(exact)}"
    if found := _renamed(name, own, OF_VERBS):
        return found
    meant = {m: called_here(name, _SETTINGS.get(m, ()), OF_VERBS) for m in methods}
    settings = [f"ssm.{m.__name__}({s}=...)" for m, s in meant.items() if s]
    if settings:
        return f"it is a setting of the method: write method={_either(settings)}"
    return _of_other_verbs(name) + _own_arguments(verb, own)


def _setting_hint(name: str, own: Sequence[str], kind: type) -> str:
    """What to write for a setting that a method does not have: its name here, the argument of the
    verb that it is, or the methods that have it."""
    verbs = {n: v for n, v in _VERBS.items() if kind in v.methods}
    for verb, it in verbs.items():
        if name in it.own:
            call = f"ssm.{verb}(model, data, ssm.{kind.__name__}(...), {name}=...)"
            return f"it is an argument of {verb}: write {call}"
    if found := _renamed(name, own, OF_VERBS):
        return found
    for verb, it in verbs.items():
        if meant := called_here(name, it.own, OF_VERBS):
            call = f"ssm.{verb}(model, data, ssm.{kind.__name__}(...), {meant}=...)"
            return f"it is an argument of {verb}: write {call}"
    siblings = dict.fromkeys(m for v in verbs.values() for m in v.methods)
    others = [
        f"ssm.{m.__name__}" for m in siblings
        if name in _SETTINGS.get(m, ()) or called_here(name, _SETTINGS.get(m, ()), OF_VERBS)
    ]  # fmt: skip
    of_others = f"it is a setting of {_either(others, 'and')}; " if others else ""
    return of_others + _own_arguments(kind.__name__, own)


def _place(function: Function) -> str:
    """Of a verb: `ssm`, or the module below it that is asked for it."""
    part = function.__module__.partition("ssmppl.")[2].partition(".")[0]
    return f"ssm.{part}" if part in ("structural", "simulators") else "ssm"


def _of_other_verbs(name: str) -> str:
    meant = {n: name if name in v.own else called_here(name, v.own, OF_VERBS)
             for n, v in _VERBS.items()}  # fmt: skip
    having = [f"{_VERBS[n].place}.{n}" for n, m in meant.items() if m]
    return f"it is an argument of {_either(having, 'and')}; " if having else ""


def _either(options: Sequence[str], word: str = "or") -> str:
    """The first few in words, and that there are more."""
    shown = [*options[:MOST_NAMED], *(["others"] if len(options) > MOST_NAMED else [])]
    return f" {word} ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))


def checked_with(methods: Iterable[type]) -> Callable[[Function], Function]:
    """Decorator of a verb: an ArgumentError in place of Python's TypeError where it is called with
    an argument that it does not have, or without one that it needs. What it waits for is told under
    its name (`status.py`), unless it is called with `progress=False`.

    methods : the classes of its methods' settings.
    """

    def decorate(function: Function) -> Function:
        signature, name = inspect.signature(function), function.__name__
        _VERBS[name] = _Verb(list(signature.parameters), tuple(methods), _place(function))

        counts = "progress" in signature.parameters

        @functools.wraps(function)
        def called(*args: Any, **kwargs: Any) -> Any:
            _check(signature, name, args, kwargs, _verb_hint, name)
            model = getattr(args[0] if args else kwargs.get("model"), "name", "")
            with call_of(name, str(model), bool(kwargs.get("progress", True)), counts):
                return function(*args, **kwargs)

        return called  # type: ignore[return-value]

    return decorate


def checked(function: Function) -> Function:
    """The same for a verb without methods."""
    return checked_with(())(function)


def checked_settings(kind: Kind) -> Kind:
    """A class of settings whose arguments are checked likewise."""
    _SETTINGS[kind] = list(inspect.signature(kind).parameters)
    return _checking(kind, _setting_hint)


def checked_model(kind: Kind) -> Kind:
    """The class of models, whose arguments are checked likewise."""
    return _checking(kind, _model_hint)


def _model_hint(name: str, own: Sequence[str], kind: type) -> str:
    return _renamed(name, own, OF_MODELS) or _own_arguments(kind.__name__, own)


def _checking(kind: Kind, hint: Callable[[str, Sequence[str], Any], str]) -> Kind:
    plain: Callable[..., None] = kind.__init__  # type: ignore[misc]
    signature = inspect.signature(kind)

    @functools.wraps(plain)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        _check(signature, kind.__name__, args, kwargs, hint, kind)
        plain(self, *args, **kwargs)

    kind.__init__ = init  # type: ignore[misc]
    return kind


def _check(
    signature: inspect.Signature, name: str, args: tuple[Any, ...], kwargs: dict[str, Any],
    hint: Callable[[str, Sequence[str], Any], str], whose: Any,
) -> None:  # fmt: skip
    try:
        signature.bind(*args, **kwargs)
    except TypeError as error:
        own = list(signature.parameters)
        unknown = next((n for n in kwargs if n not in own), "")
        if unknown:
            raise ArgumentError(
                f"{name} has no argument {unknown!r}", fix=hint(unknown, own, whose)
            ) from None
        called = ", ".join(_written(p) for p in signature.parameters.values())
        raise ArgumentError(f"{name}: {error}", fix=f"write {name}({called})") from None


def _written(parameter: inspect.Parameter) -> str:
    needed = parameter.default is parameter.empty
    return parameter.name if needed else f"{parameter.name}=..."
