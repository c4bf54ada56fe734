"""Training views are rendered once, one file for each pile."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from active6d_tools import training_data
from active6d_tools.threads import single_threaded


@pytest.fixture
def rendered(monkeypatch):
    """Arguments of every rendering, in threads and without the physics."""
    calls = []

    def render(*arguments):
        path = arguments[-1]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        calls.append(arguments)

    monkeypatch.setattr(training_data, "render_training", render)
    monkeypatch.setattr(training_data, "render_validation", render)
    monkeypatch.setattr(training_data, "worker_pool", ThreadPoolExecutor)
    return calls


def test_only_missing_files_are_rendered(rendered, tmp_path):
    progress = []
    first = training_data.FIRST_SEED
    shards = training_data.render_missing("mug", tmp_path, 2, 5, 1, lambda *done: progress.append(done))
    assert [path.relative_to(tmp_path).as_posix() for path in shards["training"]] == [
        f"training-5/{first}.npz",
        f"training-5/{first + 1}.npz",
    ]
    for split in training_data.VALIDATION_SPLITS:
        assert [path.relative_to(tmp_path).as_posix() for path in shards[split]] == [
            f"{split}/{index}.npz" for index in range(training_data.SPLITS[split])
        ]
    total = 2 + sum(training_data.SPLITS[split] for split in training_data.VALIDATION_SPLITS)
    assert progress == [(done, total) for done in range(total + 1)]
    assert ("mug", first, 5, shards["training"][0]) in rendered
    assert ("mug", "val", 0, shards["val"][0]) in rendered
    shards["training"][1].unlink()
    rendered.clear()
    assert training_data.render_missing("mug", tmp_path, 2, 5, 1) == shards
    assert rendered == [("mug", first + 1, 5, shards["training"][1])]


def test_a_rendered_pile_is_read_as_training_views(tmp_path):
    from active6d_perception.estimators.dense.training.samples import read_shard

    path = tmp_path / "deep" / "1.npz"
    training_data.render_training("bunny", training_data.FIRST_SEED, 1, path)
    (view,) = read_shard(path)
    assert len(view.T_camera_object) == len(view.visible_fraction) > 0
    assert view.visible_fraction.max() > 0.5
    assert set(view.instance[view.instance >= 0].tolist()) <= set(range(len(view.T_camera_object)))


@pytest.mark.parametrize("name", ["OMP_NUM_THREADS", "NUMBA_NUM_THREADS"])
@pytest.mark.parametrize("before", [None, "4"])
def test_the_number_of_threads_is_restored(monkeypatch, name, before):
    import os

    monkeypatch.delenv(name, raising=False)
    if before is not None:
        monkeypatch.setenv(name, before)
    with single_threaded():
        assert os.environ[name] == "1"
    assert os.environ.get(name) == before
