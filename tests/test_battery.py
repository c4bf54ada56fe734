"""A sample of the reliability battery: one minute of its attacks, without a failure."""

import pytest
from battery import ATTACKS, SLOW, run


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", sorted(ATTACKS.keys() - SLOW))
def test_a_sample_of_the_battery_fails_nowhere(name):
    trials, failures = run(ATTACKS[name], 60.0 / len(ATTACKS), seed=0)
    assert trials > 0
    assert failures == []
