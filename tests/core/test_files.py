import errno
import os
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from active6d_core.array_archive import read_archive, read_array
from active6d_core.files import Checkpoints, append_line, atomic_file, cache_folder, make_folder, sha256_of, write_file
from active6d_core.images import read_color, read_depth
from active6d_core.structured_text import read_json, read_yaml


def test_the_cache_follows_the_xdg_variable(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("banks") == tmp_path / "active6d" / "banks"
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # as good as unset, says the specification
    assert cache_folder("banks") == Path.home() / ".cache" / "active6d" / "banks"


def test_sha256_is_the_published_one(tmp_path):
    (tmp_path / "weights").write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert sha256_of(tmp_path / "weights") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "result.npz"
    write_file(path, "before")

    def write_half():
        with atomic_file(path) as unfinished:
            unfinished.write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        write_half()
    assert path.read_text() == "before"
    with atomic_file(path) as unfinished:
        assert unfinished.suffix == ".npz"  # numpy appends it to other names
        unfinished.write_text("after")
        assert path.read_text() == "before"
    assert path.read_text() == "after"
    assert [item.name for item in path.parent.iterdir()] == ["result.npz"]


def test_a_file_never_replaces_a_folder(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_file(tmp_path / "folder", b"text")
    assert [item.name for item in tmp_path.iterdir()] == ["folder"]


def test_everybody_may_read_a_written_file(tmp_path):
    write_file(tmp_path / "picture.png", b"\x89PNG")
    (tmp_path / "plain").touch()
    assert (tmp_path / "picture.png").read_bytes() == b"\x89PNG"
    assert (tmp_path / "picture.png").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_everybody_may_read_what_a_library_writes_for_its_user_alone(tmp_path):
    with atomic_file(tmp_path / "weights.safetensors") as unfinished:
        save_file({"a": np.zeros(2)}, unfinished)
    (tmp_path / "plain").touch()
    assert (tmp_path / "weights.safetensors").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_cache_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    words = r"file/active6d/banks cannot be written \(Not a directory\); set XDG_CACHE_HOME"
    with pytest.raises(OSError, match=words):
        write_file(cache_folder("banks") / "a.npz", "")
    with pytest.raises(OSError, match=words):
        make_folder(cache_folder("banks"))
    with pytest.raises(OSError, match=r"cannot be written.*choose another folder"):
        write_file(tmp_path / "file" / "a", "")


@pytest.mark.timeout(20)
@pytest.mark.parametrize("read", [read_yaml, read_json, read_archive, read_array, read_color, read_depth])
def test_a_pipe_is_refused_instead_of_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe is a pipe or a device"):
        read(tmp_path / "pipe")


def test_a_checkpoint_is_due_when_its_time_has_passed(monkeypatch):
    now = 100.0
    monkeypatch.setattr("active6d_core.files.time.monotonic", lambda: now)
    checkpoints = Checkpoints(20.0)
    assert not checkpoints.due()
    now = 121.0
    assert checkpoints.due()
    assert not checkpoints.due()


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), RuntimeError(f"I/O: {os.strerror(errno.ENOSPC)}")]
)
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, error):
    path = tmp_path / "weights"

    def write():
        with atomic_file(path):
            raise error

    with pytest.raises(OSError, match=f"{path} cannot be written .No space left on device.; free some space, or"):
        write()
    assert not list(tmp_path.iterdir())


def test_a_line_that_finds_no_room_names_the_file():
    with pytest.raises(OSError, match="/dev/full cannot be written"):
        append_line(Path("/dev/full"), "text")
