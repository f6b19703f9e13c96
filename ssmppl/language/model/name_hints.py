"""Names that this language does not have, and what to write for them: those of Stan, PyMC, NumPyro,
brms, SciPy, TensorFlow Probability and pomp, and misspellings.
"""

from __future__ import annotations

from collections.abc import Iterable

_NORMAL = "ssm.Normal(mean, sd=)"
_VECTOR = "ssm.MvNormal(mean, covariance=)"
_NEGATIVE = "ssm.NegativeBinomial(mean, dispersion=)"
_ZEROS = "ssm.ZeroInflated(ssm.{0}, p), p the probability of a structural zero"
_HURDLE = "ssm.ZeroInflated(ssm.Truncated(ssm.{0}, lower=1), p), p the probability of zero"
_MIXTURE = "ssm.Mixture(weights, [ssm.Normal(mean, sd=), ...])"
_OWN = "a distribution of your own, by @ssm.distribution with its log density and sampler"
_POINT = "ssm.Dirac(value) for a state, or a line of Python in the distribution that needs it"
# lower case and without underscores -> what is written here
HINTS: dict[str, str] = {
    **dict.fromkeys(["gauss", "gaussian", "norm"], _NORMAL),
    **dict.fromkeys(
        ["multivariatenormal", "multinormal", "multivariatenormalfulltensor", "mvn"], _VECTOR
    ),
    **dict.fromkeys(["multivariategaussian", "mvgaussian", "gaussianmultivariate"], _VECTOR),
    **dict.fromkeys(
        ["gammapoisson", "negativebinomial2", "negbinomial2", "negbinomial", "nbinom", "negbin"],
        _NEGATIVE,
    ),
    "geometric": "ssm.NegativeBinomial(mean, dispersion=1), failures before a success: mean "
    "(1 - p) / p",
    **dict.fromkeys(["zeroinflatedpoisson", "zip"], _ZEROS.format("Poisson(rate)")),
    **dict.fromkeys(
        ["zeroinflatednegativebinomial", "zinb", "zeroinflatednegativebinomial2"],
        _ZEROS.format("NegativeBinomial(mean, dispersion=)"),
    ),
    "zeroinflatedbinomial": _ZEROS.format("Binomial(n, p)"),
    "zeroinflateddistribution": _ZEROS.format("Poisson(rate)"),
    "hurdlepoisson": _HURDLE.format("Poisson(rate)"),
    "hurdlenegativebinomial": _HURDLE.format("NegativeBinomial(mean, dispersion=)"),
    **dict.fromkeys(
        ["normalmixture", "mixturesamefamily", "mixturegeneral", "gaussianmixture"], _MIXTURE
    ),
    "dirichletmultinomial": "ssm.BetaBinomial(left, a[k], np.sum(a[k + 1:])) for each category but "
    "the last, where `left`, the trials that no earlier category has, is an input",
    **dict.fromkeys(["chisquared", "chisquare", "chi2"], "ssm.Gamma(df / 2, rate=1 / 2)"),
    "erlang": "ssm.Gamma(shape, rate=)",
    "rayleigh": "ssm.Weibull(2, scale=np.sqrt(2) * sigma)",
    **dict.fromkeys(
        ["halfstudentt", "halft"], "ssm.Truncated(ssm.StudentT(df, 0, scale=), lower=0)"
    ),
    **dict.fromkeys(
        ["truncatednormal", "truncnorm"],
        "ssm.Truncated(ssm.Normal(mean, sd=), lower=, upper=)",
    ),
    **dict.fromkeys(["invgamma", "inversegamma2"], "ssm.InverseGamma(shape, scale=)"),
    **dict.fromkeys(["lognorm"], "ssm.LogNormal(mean, sd=), both of the logarithm"),
    **dict.fromkeys(["doubleexponential"], "ssm.Laplace(loc, scale=)"),
    **dict.fromkeys(["t", "student", "studentst"], "ssm.StudentT(df, loc, scale=)"),
    **dict.fromkeys(["delta", "deterministic", "constant", "degenerate"], _POINT),
    "discreteuniform": "ssm.Categorical(np.full(n, 1 / n)), whose values begin at 0",
    "loguniform": "ssm.Uniform(lower, upper) for the logarithm as the parameter, and np.exp of it "
    "where it acts",
    "filter": "ssm.particle_filter(model, data, parameters), or ssm.kalman_filter for linear "
    "Gaussian models",
    **dict.fromkeys(["mcmc", "nuts"], "ssm.sample(model, data)"),
    "fit": "ssm.sample(model, data) for a posterior, ssm.maximize(model, data) for an estimate",
    **dict.fromkeys(["mle", "optimize", "optimise"], "ssm.maximize(model, data)"),
    # statsmodels
    **dict.fromkeys(
        ["unobservedcomponents", "structts", "bsts"],
        "ssm.structural: level, trend, seasonal, cycle, ... written into an ssm.Model, and "
        "ssm.structural.observe",
    ),
    **dict.fromkeys(
        ["sarimax", "arima", "arma", "autoreg"],
        "ssm.structural.autoregression, or the companion form as a transition with ssm.Dirac for "
        "what is observed of it",
    ),
    **dict.fromkeys(
        ["mlemodel", "dynamicfactor", "dynamicfactormq", "varmax"],
        "the model as functions of an ssm.Model, and ssm.maximize(model, data)",
    ),
    **dict.fromkeys(
        ["loglike", "llf"], "ssm.log_likelihood(model, data, parameters)"
    ),
    # MATLAB's System Identification Toolbox
    **dict.fromkeys(
        ["pem", "greyest", "nlgreyest", "ssest", "estimate"], "ssm.maximize(model, data)"
    ),
    **dict.fromkeys(["idgrey", "idnlgrey", "idss"], 'ssm.Model("name", inputs=("u",))'),
    "iddata": "ssm.maximize(model, data) with data a DataFrame or a dictionary of arrays; several "
    "experiments are a dictionary of these",
    **dict.fromkeys(
        ["sim", "compare"], "ssm.simulate(model, estimate, inputs=...), a free run"
    ),
    "resid": "ssm.kalman_filter(model, data, estimate), of which `y_pit` tests the residuals",
    "present": "print(ssm.maximize(model, data))",
    # pomp
    **dict.fromkeys(["pfilter", "bpfilter"], "ssm.particle_filter(model, data, parameters)"),
    "pmcmc": "ssm.sample(model, data, ssm.PMMH())",
    "loglik": "ssm.log_likelihood(model, data, parameters)",
    "logmeanexp": "np.logaddexp.reduce(found) - np.log(len(found)) of what ssm.log_likelihood "
    "gives",
    "coef": "ssm.maximize(model, data).parameters",
    "panelpomp": 'ssm.Model("name", experiment="unit"), and @model.prior(per="experiment") for '
    "parameters of each unit",
    **dict.fromkeys(
        ["eulermultinom", "reulermultinom", "deulermultinom"],
        "ssm.EulerMultinomial(n, rates, dt), of which other transition functions read the counts "
        "as NAME_next",
    ),
    **dict.fromkeys(["rmultinom", "dmultinom"], "ssm.Multinomial(n, p)"),
    **dict.fromkeys(["vonmisesfisher"], "ssm.VonMises(mean, concentration=) for an angle"),
    **dict.fromkeys(
        ["skewstudentt", "inversegaussian", "wald", "kumaraswamy",
         "asymmetriclaplace", "exgaussian", "exmodnormal", "genextreme", "generalizedpareto"],
        _OWN,
    ),
    **dict.fromkeys(["paretoi", "powerlaw"], "ssm.Pareto(shape, scale=), from scale on"),
    **dict.fromkeys(["sech2", "logisticdistribution"], "ssm.Logistic(loc, scale=)"),
    "gumbel": "loc - scale * np.log(e), with e from ssm.Exponential(rate=1), where it acts; or "
    + _OWN,
    **dict.fromkeys(
        ["multivariatestudentt", "mvt", "multivariatet", "multistudentt", "multivariatestudent"],
        "ssm.MvStudentT(df, loc, scale=), scale a matrix",
    ),
    **dict.fromkeys(
        ["lkjcorr", "lkjcholesky", "lkjcholeskycov", "lkjcorrcholesky"],
        "ssm.LKJ(dim, eta), a correlation matrix R, and covariance=sd[:, None] * R * sd[None, :] "
        "where it acts",
    ),
    **dict.fromkeys(
        ["orderedvector", "positiveordered", "orderedtransform", "order"],
        "ssm.Ordered(law), as ssm.Ordered(ssm.Normal(np.zeros(3), sd=5))",
    ),
    **dict.fromkeys(["simplex", "stickbreaking"], "ssm.Dirichlet(concentration), shares of sum 1"),
    **dict.fromkeys(
        ["softmaxnormal", "logitnormalmultivariate", "additivelogisticnormal"],
        "ssm.LogisticNormal(mean, covariance=), shares of sum 1",
    ),
    "factor": "ssm.Potential(log_density) in @observation",
    **dict.fromkeys(
        ["tobit", "clipped", "detectionlimit", "leftcensored", "rightcensored"],
        "ssm.Censored(dist, lower=, upper=)",
    ),
    "interval": _OWN + ", the probability of each interval among its values",
}  # fmt: skip
MISSPELT = 4  # letters to one of which is wrong, left out, too many, or swapped with the next


def name_hint(name: str, known: Iterable[str]) -> str:
    """What to write for a name that is none of `known`; empty where nothing comes near."""
    plain = name.lower().replace("_", "")
    if plain in HINTS:
        return f"write {HINTS[plain]}"
    spelled = {k.lower().replace("_", ""): k for k in known}
    allowed = max(len(plain) // MISSPELT, 1) if len(plain) > 2 else 0
    slips = {k: _slips(plain, k) for k in spelled if abs(len(k) - len(plain)) <= allowed}
    near = min(slips, key=lambda k: slips[k], default="")
    return f"write ssm.{spelled[near]}" if near and slips[near] <= allowed else ""


def _slips(a: str, b: str) -> int:
    """Letters that are wrong, left out, too many or swapped: the distance of optimal string
    alignment (G. V. Bard, "Spelling-error tolerant, order-independent pass-phrases", 2007)."""
    before, row = list[int](), list(range(len(b) + 1))
    for i, x in enumerate(a, start=1):
        before, last, row = row, before, [i]
        for j, y in enumerate(b, start=1):
            found = min(before[j] + 1, row[j - 1] + 1, before[j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                found = min(found, last[j - 2] + 1)
            row.append(found)
    return row[-1]
