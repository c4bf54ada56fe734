"""Files that several packages deal with: the cache folder, checksums, and writing a file in one step."""

import errno
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

#: What the system says when there is no room: the disk, the quota, the limit of a file's size.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Long work is written to a file at least this often, so that an interruption loses less than 30 s.
CHECKPOINT_SECONDS = 20.0


class Checkpoints:
    """Says when work is to be written again: when so many seconds have passed since it was last due."""

    def __init__(self, seconds: float = CHECKPOINT_SECONDS) -> None:
        self._seconds, self._last = seconds, time.monotonic()

    def due(self) -> bool:
        """Whether it is time; if so, the time starts again."""
        if time.monotonic() - self._last < self._seconds:
            return False
        self._last = time.monotonic()
        return True


def cache_folder(name: str) -> Path:
    """``$XDG_CACHE_HOME/active6d/NAME``, by default in ``~/.cache``; it need not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "active6d" / name


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def refuse_special(path: Path) -> None:
    """Refuse a pipe or a device: reading one can wait for ever.

    Raises:
        ValueError: the path is of one.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ValueError(f"{path.name} is a pipe or a device, not a file")


def make_folder(path: Path) -> None:
    """Make a folder, and those that it is in, unless it is there.

    Raises:
        OSError: it cannot be made; the message says what to do.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _no_folder(path, error) from error


def _no_folder(path: Path, error: OSError) -> OSError:
    inside = path.is_relative_to(cache_folder(""))
    advice = "set XDG_CACHE_HOME to another folder" if inside else "choose another folder"
    return OSError(f"{path} cannot be written ({error.strerror}); {advice}")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield the path of an unfinished file; it gets the name ``path`` when the block ends without an error.

    A reader never sees half of the file, and processes may write the same one at the same time. The unfinished file
    has the same name in a temporary folder beside ``path``, because some writers choose the format by the ending.

    Raises:
        OSError: the file cannot be written.
    """
    make_folder(path.parent)
    try:
        temporary = TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise _no_folder(path.parent, error) from error
    with temporary as folder:
        unfinished = Path(folder) / path.name
        with naming(path):
            unfinished.touch()
            usual = unfinished.stat().st_mode
            unfinished.unlink()
            yield unfinished
            unfinished.chmod(usual)  # some writers let nobody else read what they write
        os.replace(unfinished, path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name ``path`` in the error of what is written in the block when there is no room: the system does not.

    Raises:
        OSError: there is no room; the message says what to do.
    """
    try:
        yield
    except Exception as error:
        if reason := _full(error):
            message = f"{path} cannot be written ({reason}); free some space, or choose another folder"
            raise OSError(message) from error
        raise


def append_line(path: Path, line: str) -> None:
    """Write one more line, which is on disk before this returns.

    Raises:
        OSError: the file cannot be written.
    """
    with naming(path), path.open("a") as file:
        file.write(f"{line}\n")


def _full(error: Exception) -> str:
    """The system's words if an error means that there is no room, else nothing. Some libraries keep only its words."""
    if isinstance(error, OSError):
        return os.strerror(error.errno) if error.errno in _FULL else ""
    return next((os.strerror(number) for number in _FULL if os.strerror(number) in str(error)), "")


def write_file(path: Path, content: str | bytes) -> None:
    """Write a whole file in one step, folders included.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_file(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
