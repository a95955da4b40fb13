"""The command that measures the point tracker says which of its options will not do."""

import pytest

from envs.errors import UsageError
from planning.tracking_error import Config


@pytest.mark.parametrize("options", [{"episodes": 0}, {"steps": 0}, {"seed": -1}])
def test_bad_options_are_named(options):
    ((name, value),) = options.items()
    with pytest.raises(UsageError, match=f"--{name} is {value}; give"):
        Config(**options)
