import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
if str(HERE) not in sys.path:  # spawned workers inherit it and find `standin`
    sys.path.insert(0, str(HERE))


@pytest.fixture(scope="session")
def collected(tmp_path_factory):
    """A dataset of four episodes with ground truth, by one worker; not to be changed."""
    from commands import call, options

    folder = tmp_path_factory.mktemp("collected") / "data"
    code, _, err = call("collect-rollouts", options(folder, **{"ground-truth": True}))
    assert code == 0, err
    return folder
