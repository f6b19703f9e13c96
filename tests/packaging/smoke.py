"""Run by the Python of an environment that ssmppl was installed into: does what a user's day has.

No pytest, and nothing of the source tree: this file alone is copied to where it runs.
"""

import importlib.metadata
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.cli.templates import TEMPLATES, skeleton
from ssmppl.results import arviz, save

nile = ssm.Model("local level")


@nile.prior
def nile_prior():
    return {
        "q": ssm.InverseGamma(2.0, scale=1500.0),
        "r": ssm.InverseGamma(2.0, scale=15000.0),
    }


@nile.initial
def nile_initial():
    return {"level": ssm.Normal(1000, sd=300)}


@nile.transition
def nile_transition(level, q):
    return {"level": ssm.Normal(level, variance=q)}


@nile.observation
def nile_observation(level, r):
    return {"flow": ssm.Normal(level, variance=r)}


varves = ssm.Model("ice varves")


@varves.prior
def varves_prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}


@varves.initial
def varves_initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@varves.transition
def varves_transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@varves.observation
def varves_observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}


def installed():
    """The package is the installed one, whole, and of one version."""
    folder = Path(ssm.__file__).parent
    assert folder.is_relative_to(sys.prefix), f"imported from {folder}"
    assert not any(Path(entry or ".").joinpath("pyproject.toml").exists() for entry in sys.path)
    assert (folder / "py.typed").is_file()
    assert importlib.metadata.version("ssmppl") == ssm.__version__
    assert all(len(datasets.load(name)) > 0 for name in datasets.names()), "no data sets"
    assert len(datasets.names()) >= 4
    for name in ssm.__all__:  # those that are imported when they are first asked for, too
        assert getattr(ssm, name) is not None


def command_line():
    """The command on the path, and its files."""
    script = Path(sysconfig.get_path("scripts")) / "ssmppl"

    def ssmppl(*arguments):
        ran = subprocess.run([script, *arguments], stdout=subprocess.PIPE, text=True, check=True)
        return ran.stdout

    assert ssmppl("--version").split()[-1] == ssm.__version__
    ssmppl("demo", "--draws", "40", "--output", "demo.nc")
    assert Path("demo.nc").stat().st_size
    assert Path("demo_pmmh.nc").stat().st_size
    for template in TEMPLATES:  # the text of a module, which a zipped or compiled one has not
        assert "ssm.Model" in skeleton(template, "flow")
    ssmppl("new", "flow")
    assert "200 rows, none missing" in ssmppl("explain", "flow.py", "flow.csv")


def sampling():
    """Draws by both kinds of samplers, near what is known; through a file and back."""
    flow = datasets.nile()
    first = ssm.sample(
        nile, {"flow": flow}, ssm.Gibbs(), draws=400, warmup=200, chains=2, seed=1, progress=False
    )
    second = ssm.sample(
        varves, {"y": datasets.ice_varves()}, ssm.PGAS(particles=20),
        draws=300, warmup=300, chains=2, seed=1, progress=False,
    )  # fmt: skip
    # Quadrature gives phi 0.950 with standard deviation 0.017; the level follows the flow.
    phi = float(second["posterior"]["phi"].mean())
    assert abs(phi - 0.950254) < 3 * 0.016627, phi
    level = first["posterior"]["level"].mean(("chain", "draw")).values
    assert np.corrcoef(level, flow)[0, 1] > 0.7
    return first, second


def through_a_file(idata):
    """A result is the same after it was saved, its table and its states included."""
    again = arviz().from_netcdf(save(idata, "draws.nc"))
    for name, values in idata["posterior"].data_vars.items():
        np.testing.assert_array_equal(values.values, again["posterior"][name].values)
    assert dict(again["posterior"].attrs) == dict(idata["posterior"].attrs)
    table = ssm.summary(idata)
    assert list(table.index) == ["q", "r"]
    assert np.isfinite(table.to_numpy()).all()
    np.testing.assert_array_equal(table, ssm.summary(again))


def plotting(idata):
    """A picture that is not blank."""
    import matplotlib.pyplot as plt

    axes = np.ravel(ssm.plot_states(idata))
    axes[0].figure.savefig("states.png")
    pixels = plt.imread("states.png")[..., :3]
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 10


if __name__ == "__main__":
    installed()
    command_line()
    gibbs, pgas = sampling()
    through_a_file(gibbs)
    plotting(pgas)
    print("smoke test passed")
