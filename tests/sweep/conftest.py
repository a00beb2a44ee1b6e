"""Reference of the tests of killed sweeps."""

import pytest
from disturbed import DEADLY, SLOW, finish, start

from r2h_batch.runs.store import load_run


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """Digest of all rows by method, from runs that nothing happened to."""
    tmp_path = tmp_path_factory.mktemp("undisturbed")
    digests = {}
    for method in (SLOW, DEADLY):
        out = tmp_path / method.partition(":")[2]
        code, _, error = finish(start(tmp_path, out, method, FAKE_DEADLY="-1", FAKE_SECONDS="0"))
        assert code == 0, error
        digests[method] = load_run(out).digest(method)
    return digests
