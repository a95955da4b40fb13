"""For several processes that run the tests at a time: each keeps to one thread, and the longest files come first."""

import os

import hypothesis
import pytest

hypothesis.settings.register_profile("no deadline", deadline=None)  # a busy machine is no failure
hypothesis.settings.load_profile("no deadline")

LONGEST = ("test_shipped_model.py", "test_tune_cluster.py", "test_tune.py", "test_ddp.py")
"""Files of few tests that take minutes: begun last, they would keep one process busy while others had nothing to do."""

if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # before PyTorch is imported; programs that tests start have it, too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; all else as it was."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
