import pytest

from tests.cli.shared import PLANE, WALK, run, write


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory with two model files."""
    monkeypatch.chdir(tmp_path)
    write("walk.py", WALK)
    write("plane.py", PLANE)
    return tmp_path


@pytest.fixture
def series(folder):
    """Data of the first of them."""
    run("simulate", "walk.py", "--steps", 20, "-p", "q=0.3", "--seed", 1, "-o", "sim.csv")
    return folder / "sim.csv"


@pytest.fixture(scope="session")
def posterior(tmp_path_factory):
    """A folder with a model, data and posterior draws."""
    folder = tmp_path_factory.mktemp("posterior")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write("walk.py", WALK)
        run("simulate", "walk.py", "--steps", 12, "-p", "q=0.3", "--seed", 1, "-o", "sim.csv")
        run("sample", "walk.py", "sim.csv", "--draws", 40, "--warmup", 20, "--chains", 2,
            "--seed", 2, "-o", "post.nc")  # fmt: skip
    return folder
