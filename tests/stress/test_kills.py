"""Commands that are stopped at random moments leave the old file or the new one."""

from __future__ import annotations

import os

import pytest

from bench.kills import kill

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")


@pytest.mark.slow
def test_outputs_survive():
    found, wrong = kill(20, seed=3, names=("sky", "render", "reference", "export", "fit"))
    assert wrong == [] and sum(count for (*_, status), count in found.items() if status != "kept") == 20
