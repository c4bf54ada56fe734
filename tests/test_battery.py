"""A sample of the reliability battery: one minute of its attacks, without a failure; and what it says of memory."""

import numpy as np
import pytest
from battery.runner import ATTACKS, SLOW, main, run
from battery.trials import Level


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", sorted(ATTACKS.keys() - SLOW))
def test_a_sample_of_the_battery_fails_nowhere(name):
    trials, failures, _ = run(ATTACKS[name], 60.0 / len(ATTACKS), seed=0)
    assert trials > 0
    assert failures == []


@pytest.mark.parametrize(("growth", "fails"), [(0.0, False), (0.01, True)])
def test_memory_that_grows_is_told_from_memory_that_does_not(growth, fails):
    rng, level = np.random.default_rng(0), Level(warm_up=10)
    for trial in range(310):
        level.add(600.0 + 50 * min(trial, 10) + growth * trial + rng.normal(0, 0.1))
    slope, half = level.slope()
    assert abs(slope - 1000 * growth) < half < 1.0
    assert bool(level.verdict().failure) == fails
    assert level.verdict().note.startswith(f"memory: {slope:+.1f} kB per trial")


def test_few_trials_say_nothing_of_memory():
    level = Level(warm_up=10, least=50)
    for trial in range(59):
        level.add(float(trial))
    assert not level.verdict().failure


def test_attacks_are_chosen_by_name_and_repeated_so_often(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["battery", "--attacks", "stamps,messages", "--trials", "3"])
    assert main() == 0
    rows = [line.split("|")[1:4] for line in capsys.readouterr().out.splitlines()[2:]]
    assert [[cell.strip() for cell in row] for row in rows if row] == [["stamps", "3", "0"], ["messages", "3", "0"]]
    monkeypatch.setattr("sys.argv", ["battery", "--attacks", "stamp"])
    with pytest.raises(SystemExit):
        main()
    assert "--attacks stamp: there are stamps, messages" in capsys.readouterr().err
