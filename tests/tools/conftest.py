"""Banks that the tests of several commands share."""

import pytest
from synthetic_bank import synthetic_bank

from active6d_agent.bank.scene_bank import bank_path


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    """A folder with synthetic banks of the mug, one for every split and one more with other noise."""
    folder = tmp_path_factory.mktemp("banks")
    made = synthetic_bank("mug", scenes=2, objects=6)
    for split in ("train", "val", "test"):
        made.save(bank_path(folder, "mug", split))
    synthetic_bank("mug", scenes=2, objects=6, noise=1).save(bank_path(folder, "mug", "test", seed=1))
    return folder
