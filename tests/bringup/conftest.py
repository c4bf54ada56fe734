"""Banks that the tests of several commands share."""

import pytest
from synthetic_bank import synthetic_bank

from active6d_agent.bank import bank_path


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    """A folder with synthetic banks of the mug, one for every split."""
    folder = tmp_path_factory.mktemp("banks")
    made = synthetic_bank("mug", scenes=2, objects=6)
    for split in ("train", "val", "test"):
        made.save(bank_path(folder, "mug", split))
    return folder
