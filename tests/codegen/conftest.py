import pytest


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory):
    """Generated modules of these tests go to a folder of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SSMPPL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
