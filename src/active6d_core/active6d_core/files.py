"""Files that several packages deal with: the cache folder, checksums, and writing a file in one step."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


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


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield the path of an unfinished file; it gets the name ``path`` when the block ends without an error.

    A reader never sees half of the file, and processes may write the same one at the same time. The unfinished file
    has the same name in a temporary folder beside ``path``, because some writers choose the format by the ending.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        inside = path.is_relative_to(cache_folder(""))
        advice = "set XDG_CACHE_HOME to another folder" if inside else "choose another folder"
        raise OSError(f"{path.parent} cannot be written ({error.strerror}); {advice}") from error
    with temporary as folder:
        unfinished = Path(folder) / path.name
        yield unfinished
        os.replace(unfinished, path)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a whole file in one step, folders included.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_file(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
