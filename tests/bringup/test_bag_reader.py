"""A bag read back gives the numbers that were recorded; anything else gives one clear line."""

import shutil

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from stub_episode import StubEpisode

from active6d_bringup.bags.reader import BagError, read_episode, read_episodes
from active6d_bringup.bags.writer import EpisodeWriter
from active6d_core.ros.topics import CONTRACT

NAMES = {topic.name: topic.name if topic.name.startswith("/") else f"/{topic.name}" for topic in CONTRACT}


def write_bag(folder, messages, names=NAMES):
    writer = EpisodeWriter(folder, names)
    for index, (topic, message) in enumerate(messages):
        writer.write(topic, serialize_message(message), 10**18 + index)
    writer.close()
    return folder


def assert_table(read, expected, skip=()):
    for name, values in vars(expected).items():
        if name not in skip:
            np.testing.assert_allclose(getattr(read, name), values, atol=2e-6, err_msg=name)


def test_episode_is_read_back(tmp_path):
    episode = StubEpisode(seed=5, moves=2)
    record = read_episode(write_bag(tmp_path / "bag", episode.messages()))
    assert (record.object, record.scene, record.seed, record.policy) == ("mug", "mug/seed/3", 3, "random")
    assert record.end_reason == "budget of 2 moves spent"
    np.testing.assert_allclose(record.ground_truth, episode.ground_truth, atol=1e-12)
    assert len(record.steps) == 3
    for read, sent in zip(record.steps, episode.steps, strict=True):
        assert read.stamp == sent.view.stamp
        assert read.view.camera == sent.view.camera
        np.testing.assert_array_equal(read.view.color, sent.view.color)
        np.testing.assert_array_equal(read.view.depth, sent.view.depth)
        np.testing.assert_allclose(read.view.T_world_camera, sent.view.T_world_camera, atol=1e-12)
        np.testing.assert_array_equal(read.hypotheses.segmentation, sent.hypotheses.segmentation)
        assert_table(read.hypotheses, sent.hypotheses)
        assert_table(read.objects, sent.objects)
        np.testing.assert_allclose(read.unexplained, sent.unexplained, atol=1e-7)
        assert read.latency_ms == {"pose_estimator": 12.5}
    for read, sent in zip(record.steps[:-1], episode.steps[:-1], strict=True):
        np.testing.assert_allclose(read.goal, sent.goal, atol=1e-12)
        np.testing.assert_allclose(read.attention, sent.attention, atol=1e-7)
        assert read.attended == sent.attended
    assert record.steps[-1].goal is None
    np.testing.assert_allclose(record.positions, [s.view.T_world_camera[:3, 3] for s in episode.steps], atol=1e-12)


def test_two_episodes_in_one_bag(tmp_path):
    messages = StubEpisode(1, moves=1).messages() + StubEpisode(2, moves=2, first=9_000_000_000).messages()
    first, second = read_episodes(write_bag(tmp_path / "bag", messages))
    assert ([step.stamp for step in first.steps], len(second.steps)) == ([1_000_000_000, 1_500_000_000], 3)
    np.testing.assert_allclose(first.ground_truth, StubEpisode(1, moves=1).ground_truth, atol=1e-12)
    np.testing.assert_allclose(second.ground_truth, StubEpisode(2, moves=2).ground_truth, atol=1e-12)


def test_namespace_and_frame_are_the_bags_own(tmp_path):
    episode = StubEpisode(world="cell_7")
    names = {topic: name if topic.startswith("/") else f"/robot/left{name}" for topic, name in NAMES.items()}
    record = read_episode(write_bag(tmp_path / "bag", episode.messages(), names))
    assert record.world_frame == "cell_7"
    assert len(record.steps[0].objects) == len(episode.steps[0].objects)


def test_recording_cut_off_in_the_middle_keeps_its_views(tmp_path):
    record = read_episode(write_bag(tmp_path / "bag", StubEpisode().messages()[:21]))
    assert record.end_reason is None
    assert [step.objects is None for step in record.steps] == [False, True]
    assert record.steps[1].hypotheses is None


def test_a_bag_of_before_the_unexplained_surface_is_read(tmp_path):
    messages = [item for item in StubEpisode().messages() if item[0] != "objects/unexplained"]
    record = read_episode(write_bag(tmp_path / "bag", messages))
    assert len(record.steps) == 3
    assert all(step.unexplained is None and len(step.objects) for step in record.steps)


def test_camera_alone_is_an_episode(tmp_path):
    messages = [item for item in StubEpisode().messages() if item[0].startswith("camera/")]
    record = read_episode(write_bag(tmp_path / "bag", messages))
    assert (len(record.steps), record.ground_truth, record.object, record.seed) == (3, None, None, None)


def test_missing_and_foreign_folders(tmp_path):
    with pytest.raises(BagError, match="no such folder"):
        read_episode(tmp_path / "nowhere")
    with pytest.raises(BagError, match="not a bag"):
        read_episode(tmp_path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(BagError):
        read_episode(tmp_path)


def test_killed_recording_says_how_to_recover(tmp_path):
    folder = write_bag(tmp_path / "bag", StubEpisode().messages())
    (folder / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="mcap recover"):
        read_episode(folder)


@pytest.mark.parametrize("keep", [0, 40, 0.5, 0.99])
def test_truncated_file(tmp_path, keep):
    folder = write_bag(tmp_path / "bag", StubEpisode().messages())
    path = next(folder.glob("*.mcap"))
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(len(data) * keep)])
    with pytest.raises(BagError, match=str(folder)):
        read_episode(folder)


def test_damaged_file_is_a_bag_error_whatever_breaks(tmp_path):
    original = write_bag(tmp_path / "bag", StubEpisode().messages())
    rng = np.random.default_rng(0)
    for trial in range(30):
        folder = shutil.copytree(original, tmp_path / str(trial))
        path = folder / "bag.mcap"
        data = bytearray(path.read_bytes())
        for position in rng.integers(0, len(data), 40):
            data[position] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        with pytest.raises(BagError):
            read_episode(folder)


def test_bag_without_a_camera_is_foreign(tmp_path):
    names = {**NAMES, "camera/pose": "/somewhere/else"}
    with pytest.raises(BagError, match="not an episode"):
        read_episode(write_bag(tmp_path / "a", StubEpisode().messages(), names))
    with pytest.raises(BagError, match="no complete view"):
        read_episode(write_bag(tmp_path / "b", StubEpisode().messages()[:4]))


def test_wrong_type_on_a_topic_of_the_contract(tmp_path):
    names = {**NAMES, "hypotheses": "/objects/poses", "objects/poses": "/hypotheses"}
    with pytest.raises(BagError, match="expected"):
        read_episode(write_bag(tmp_path / "bag", StubEpisode().messages(), names))


def test_bad_numbers_name_the_bag(tmp_path):
    messages = StubEpisode().messages()
    next(message for topic, message in messages if topic == "camera/pose").pose.orientation.w = 7.0
    with pytest.raises(BagError, match="quaternion"):
        read_episode(write_bag(tmp_path / "bag", messages))
