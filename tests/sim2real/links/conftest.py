"""Virtual cell of each family."""

import pytest

from tests.sim2real.cells import restored


@pytest.fixture(params=["cb3", "e-series"])
def cell(request, started_cb3, started_e_series):
    """Cell of each family."""
    return restored(started_cb3 if request.param == "cb3" else started_e_series)
