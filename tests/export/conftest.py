"""One export of the Earth that tests of clients share."""

from __future__ import annotations

import pytest

from atmo_jit.export import export


@pytest.fixture(scope="package")
def takram(tmp_path_factory):
    """The report of an export of the Earth in the layout takram."""
    return export("earth", "takram", tmp_path_factory.mktemp("takram"))


@pytest.fixture(scope="package")
def earth_sky():
    """The solved Earth."""
    from atmo_jit.solved import Sky

    return Sky("earth")
