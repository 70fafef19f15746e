"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Speed is a benchmark, never a timed test. In CI the same examples every time; by hand new ones.
settings.register_profile("fusion", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("fusion")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data beside the checkout (or $FUSION_SHARED_DATA); skips where there is none."""
    folder = Path(os.environ.get("FUSION_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found: {folder} (set FUSION_SHARED_DATA)")
    return folder
