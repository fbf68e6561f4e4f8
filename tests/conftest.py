"""What holds for all tests: without a C compiler, those that need one are skipped, and say so."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from typing import Any

import pytest

from flowgraph import MissingDependencyError

COMPILER = shutil.which(os.environ.get("CC") or "cc")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, Any, Any]:
    try:
        return (yield)
    except MissingDependencyError as error:
        if COMPILER is None and "C compiler" in str(error):
            pytest.skip("needs a C compiler")
        raise
