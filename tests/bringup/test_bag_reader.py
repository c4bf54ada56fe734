"""A bag read back gives the numbers that were recorded; anything else gives one clear line."""

import shutil
import struct

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from rclpy.serialization import serialize_message
from stub_episode import StubEpisode

from active6d_bringup.bags.mcap_file import McapFile
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
        np.testing.assert_allclose(read.T_world_camera, sent.T_world_corrected, atol=1e-12)
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
    record = read_episode(write_bag(tmp_path / "bag", StubEpisode().messages()[:22]))
    assert record.end_reason is None
    assert [step.objects is None for step in record.steps] == [False, True]
    assert record.steps[1].hypotheses is None


def test_a_bag_without_topics_of_later_versions_is_read(tmp_path):
    later = ("objects/unexplained", "objects/camera_poses")
    messages = [item for item in StubEpisode().messages() if item[0] not in later]
    record = read_episode(write_bag(tmp_path / "bag", messages))
    assert len(record.steps) == 3
    for step in record.steps:
        assert step.unexplained is None
        assert len(step.objects)
        np.testing.assert_array_equal(step.T_world_camera, step.view.T_world_camera)


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


def test_a_recording_without_metadata_is_read_and_says_so(tmp_path):
    folder = write_bag(tmp_path / "bag", StubEpisode().messages())
    (folder / "metadata.yaml").unlink()
    record = read_episode(folder)
    assert len(record.steps) == 3
    assert record.damage == ("there is no metadata.yaml: the recording was killed, or its file was moved",)


@pytest.mark.parametrize("ended", [True, False])
def test_the_file_of_a_bag_is_read_as_the_bag(tmp_path, ended):
    folder = write_bag(tmp_path / "bag", StubEpisode(seed=5, moves=2).messages())
    file, whole = folder / "bag.mcap", read_episode(folder)
    if not ended:
        file.write_bytes(file.read_bytes()[:-8])
    record = read_episode(file)
    assert record.info == whole.info
    assert record.end_reason == whole.end_reason
    np.testing.assert_array_equal(record.ground_truth, whole.ground_truth)
    assert [len(step.objects) for step in record.steps] == [len(step.objects) for step in whole.steps]
    assert all(step.hypotheses is not None for step in record.steps)
    assert bool(record.damage) != ended


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A bag, and where its chunks end."""
    folder = write_bag(tmp_path_factory.mktemp("whole") / "bag", StubEpisode().messages())
    with (folder / "bag.mcap").open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    return folder, sorted(chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks)


def damage_of(folder):
    """What reading a bag says of its damage, whether it can be read or not."""
    try:
        return read_episode(folder).damage
    except BagError as error:
        return (str(error),)


@pytest.mark.parametrize("share", [*np.linspace(0, 0.999, 40)])
def test_whole_chunks_of_a_cut_file_are_read_and_the_rest_is_reported(tmp_path, whole, share):
    original, ends = whole
    folder = shutil.copytree(original, tmp_path / "bag")
    data = (folder / "bag.mcap").read_bytes()
    keep = int(len(data) * share)
    (folder / "bag.mcap").write_bytes(data[:keep])
    file = McapFile(folder / "bag.mcap")
    assert len(list(file.messages())) == sum(end <= keep for end in ends)
    assert file.damage
    assert file.damage[0] in "; ".join(damage_of(folder))


@pytest.mark.parametrize("seed", range(40))
def test_a_flipped_byte_is_reported(tmp_path, whole, seed):
    rng = np.random.default_rng(seed)
    folder = shutil.copytree(whole[0], tmp_path / "bag")
    path = folder / ("metadata.yaml" if seed % 8 == 0 else "bag.mcap")
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
    path.write_bytes(data)
    assert damage_of(folder)


@pytest.mark.parametrize("byte", range(8))
def test_an_index_that_is_said_to_be_beyond_the_end_is_reported(tmp_path, whole, byte):
    folder = shutil.copytree(whole[0], tmp_path / "bag")
    data = bytearray((folder / "bag.mcap").read_bytes())
    data[len(data) - 8 - 20 + byte] ^= 0xF0  # the footer's first number, before a second, a checksum and the magic
    (folder / "bag.mcap").write_bytes(data)
    assert damage_of(folder)


def test_a_whole_bag_has_no_damage(whole):
    assert read_episode(whole[0]).damage == ()


def test_damage_all_over_is_an_error_or_reported(tmp_path, whole):
    rng = np.random.default_rng(0)
    for trial in range(20):
        folder = shutil.copytree(whole[0], tmp_path / str(trial))
        path = folder / "bag.mcap"
        data = bytearray(path.read_bytes())
        for position in rng.integers(0, len(data), 40):
            data[position] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        assert damage_of(folder)


def test_a_chunk_that_would_fill_the_memory_is_left_out(tmp_path):
    folder = write_bag(tmp_path / "bag", StubEpisode().messages())
    bomb = zstandard.ZstdCompressor().compress(bytes(2**29))
    with (folder / "bomb.mcap").open("wb") as stream:
        stream.write(b"\x89MCAP0\r\n")
        chunk = struct.pack("<QQQII", 0, 0, 2**29, 0, 4) + b"zstd" + struct.pack("<Q", len(bomb)) + bomb
        stream.write(b"\x06" + struct.pack("<Q", len(chunk)) + chunk)
    file = McapFile(folder / "bomb.mcap")
    assert list(file.messages()) == []
    assert file.damage[0] == "bomb.mcap chunk 1 is damaged and left out"


def test_the_camera_is_found_by_type_and_missed_by_name(tmp_path):
    names = {**NAMES, "camera/pose": "/somewhere/else"}
    assert len(read_episode(write_bag(tmp_path / "a", StubEpisode().messages(), names)).steps) == 3
    with pytest.raises(BagError, match="no camera_info in it"):
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
