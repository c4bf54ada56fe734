"""NumPy archives from strangers: what their headers announce is checked before any array is allocated."""

import math
import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from active6d_core.files import refuse_special

#: Bytes of all arrays of an archive together, uncompressed.
MOST_BYTES = 2**29
_MOST_MEMBERS = 100


def read_archive(path: Path, most_bytes: int = MOST_BYTES) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file, without pickled data.

    Args:
        path: of the file.
        most_bytes: of all arrays together.

    Raises:
        ValueError: the file is damaged, holds objects, is too large, or an array is larger than its part of the file.
        OSError: the file cannot be read.
    """
    refuse_special(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > _MOST_MEMBERS or sum(member.file_size for member in members) > most_bytes:
                raise ValueError(f"holds more than {_MOST_MEMBERS} arrays or {most_bytes >> 20} MB")
            for member in members:
                _check_member(archive, member)
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except OSError:
        raise
    # Damaged archives fail with many kinds of errors.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


def read_array(path: Path, most_bytes: int = MOST_BYTES) -> np.ndarray:
    """The array of an ``.npy`` file, without pickled data.

    Raises:
        ValueError: the file is damaged, holds objects or is too large.
        OSError: the file cannot be read.
    """
    refuse_special(path)
    if path.stat().st_size > most_bytes:
        raise ValueError(f"has more than {most_bytes >> 20} MB")
    try:
        # A mapped file must be as long as its header says.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except OSError:
        raise
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


def _check_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    with archive.open(member) as file:
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read_header(file)
        left = member.file_size - file.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != left or min(shape, default=0) < 0:
        raise ValueError(f"'{member.filename}' announces {shape} of {dtype}, which is not what it holds")
