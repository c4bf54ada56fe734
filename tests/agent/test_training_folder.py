"""A training that is there is neither replaced nor changed unless that is asked for."""

import pytest

from active6d_agent.policies.attention.ppo import train_ppo
from active6d_agent.policies.training_folder import begin_training
from active6d_agent.policies.view_attention.dagger import train_dagger


@pytest.fixture
def begun(tmp_path):
    """A folder with the files of a training."""
    for name in ("latest.json", "curve.jsonl", "best.safetensors"):
        (tmp_path / name).write_text(name)
    return tmp_path


@pytest.mark.parametrize("train", [train_dagger, train_ppo])
def test_a_begun_training_is_refused_before_anything_is_touched(begun, train):
    with pytest.raises(ValueError, match="continue it with --resume, replace it with --again"):
        next(train(None, None, begun))
    for name in ("latest.json", "curve.jsonl", "best.safetensors"):
        assert (begun / name).read_text() == name


def test_what_is_replaced_cannot_be_resumed_and_what_is_resumed_stays(begun):
    begin_training(begun, resume=True)
    assert len(list(begun.iterdir())) == 3
    begin_training(begun, again=True)
    assert [path.name for path in begun.iterdir()] == ["best.safetensors"], "it stays until there is a better one"
    begin_training(begun)
    begin_training(begun / "new")
    assert (begun / "new").is_dir()
