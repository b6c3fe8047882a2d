"""Files in and out that neither surprise nor destroy.

Out: :func:`check_output` refuses a name that cannot be written before any work is done; :func:`atomic_outputs` lets
the work go to temporary names in the same folder and renames them when all are complete, so that an existing file
survives a failed run. In: :func:`read_npz` reads numeric arrays and checks names, kinds and sizes before it
allocates.
"""

from __future__ import annotations

import os
import re
import secrets
import socket
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import IO

import numpy as np
from numpy.lib import format as npy

from .errors import InputError, OutputError, shown
from .interrupts import uninterrupted

# Larger archives are more likely a mistake or an attack than a list of views (this holds 26 million of them).
NPZ_LIMIT = 2**31
NPZ_MEMBERS = 1000
HEADER_LIMIT = 10_000
KINDS = "biuf"

_TEMPORARY = re.compile(r"\.atmo-jit-(?P<host>[0-9a-f]{8})-(?P<process>\d+)-[0-9a-f]{8}(\.\w*)?")


def is_file(path: Path) -> bool:
    """Whether there is a file of that name; there is none of a name that the file system refuses (too long, a null
    character)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_output(path: str | os.PathLike[str], suffix: str) -> Path:
    """``path`` as the name of a file that can be written, its links resolved.

    Raises InputError when it does not end in ``suffix`` (in any case), is something other than a file, is write-
    protected, or its folder does not exist or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise InputError(f"output {shown(str(path), 200)}: the name must end in {suffix}")
    try:
        target = path.resolve()
        exists = _exists(target)
        folder_exists = target.parent.is_dir()
    except (OSError, ValueError, RuntimeError) as error:  # too long a name, a null character, a loop of links
        raise InputError(f"output {shown(str(path), 200)}: {_reason(error)}") from None
    if exists and not target.is_file():
        raise InputError(f"output {shown(str(path), 200)}: is not a file; give the name of a new or an existing file")
    if not folder_exists:
        raise InputError(f"output {shown(str(path), 200)}: there is no folder {shown(str(target.parent), 200)}")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(
            f"output {shown(str(path), 200)}: the folder {shown(str(target.parent), 200)} cannot be written"
        )
    _check_writable(target)
    return target


def _exists(path: Path) -> bool:
    """Whether there is something; raises what Path.exists hides from Python 3.14 on: names too long, loops of links."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def check_folder(path: str | os.PathLike[str]) -> Path:
    """``path`` as the name of a folder that can be written to, or made. Raises InputError otherwise."""
    path = Path(path)
    try:
        nearest = path.resolve()
        while not _exists(nearest):
            nearest = nearest.parent
        is_folder = nearest.is_dir()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"output {shown(str(path), 200)}: {_reason(error)}") from None
    if not is_folder:
        raise InputError(f"output {shown(str(path), 200)}: {shown(str(nearest), 200)} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"output {shown(str(path), 200)}: the folder {shown(str(nearest), 200)} cannot be written")
    return path


@contextmanager
def atomic_outputs(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Temporary files (empty, with the same suffixes) that become ``paths`` at the end of the block.

    Whatever ends the block early, an exception or an interrupt, removes them and leaves ``paths`` as they were.
    Temporaries of processes that were killed on this machine are removed on the way.

    Raises InputError where one of ``paths`` is write-protected, OutputError where one cannot be written (whatever
    OSError ends the block counts as that).
    """
    targets = [Path(path).resolve() for path in paths]
    for target in targets:
        _check_writable(target)
    for folder in {target.parent for target in targets}:
        _remove_stale(folder)
    parts: list[Path] = []
    try:
        with uninterrupted():
            for target in targets:
                parts.append(_create(target))
        yield tuple(parts)
        for part in parts:
            _sync(part)
        with uninterrupted():  # all of them or none
            for part, target in zip(parts, targets, strict=True):
                os.replace(part, target)
        for folder in {target.parent for target in targets}:
            _sync(folder)
    except OSError as error:
        others = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        name = shown(str(paths[0]), 200)
        raise OutputError(f"output {name}{others}: cannot be written ({_reason(error)})") from error
    finally:
        with uninterrupted():
            for part in parts:
                with suppress(OSError):  # renamed already, or gone with its folder
                    part.unlink(missing_ok=True)


def write_npz(path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> None:
    """Arrays as an NPZ file, over what is there.

    `numpy.savez` does the same, but some versions leave the archive open where the disk is full; it then complains when
    Python clears it away.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                npy.write_array(stream, np.asarray(array), allow_pickle=False)


def read_npz(path: str | os.PathLike[str], *, kinds: str = KINDS, limit: int = NPZ_LIMIT) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file, by name, in native byte order.

    kinds: the NumPy kind letters that are allowed (booleans, integers and reals by default; never Python objects).
    limit: bytes that the file, and all its arrays unpacked, may take. Raises InputError, one line naming the file and
    the array, for anything else; sizes are checked before memory is taken.
    """
    name = shown(str(path), 200)
    try:
        mode = os.stat(path).st_mode  # before it is opened: a pipe would wait, and the end of a device be looked for
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise InputError(f"{name}: is not a file")
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_size > limit:
                raise InputError(f"{name}: the file is larger than {limit} bytes")
            with zipfile.ZipFile(file) as archive:
                return _read_members(archive, name, kinds, limit)
    except zipfile.BadZipFile as error:
        raise InputError(f"{name}: is not an NPZ file ({_reason(error)})") from None
    except (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, zlib.error, struct.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{name}: cannot be read ({_reason(error)})") from None


def _read_members(archive: zipfile.ZipFile, name: str, kinds: str, limit: int) -> dict[str, np.ndarray]:
    members = archive.infolist()
    if len(members) > NPZ_MEMBERS:
        raise InputError(f"{name}: holds {len(members)} arrays; at most {NPZ_MEMBERS} are read")
    if sum(member.file_size for member in members) > limit:
        raise InputError(f"{name}: the unpacked arrays would take more than {limit} bytes")
    arrays: dict[str, np.ndarray] = {}
    for member in members:
        label, suffix = os.path.splitext(member.filename)
        if suffix != ".npy":
            raise InputError(f"{name}: is not an NPZ file (it holds {shown(member.filename)})")
        if label in arrays:
            raise InputError(f"{name}: array {shown(label)} is there twice")
        with archive.open(member) as stream:
            _check_header(stream, member.file_size, f"{name}: array {shown(label)}", kinds)
        with archive.open(member) as stream:
            array = npy.read_array(stream, allow_pickle=False, max_header_size=HEADER_LIMIT)
        arrays[label] = array.astype(array.dtype.newbyteorder("="), copy=False)
    return arrays


def _check_header(stream: IO[bytes], size: int, label: str, kinds: str) -> None:
    """Refuse an array whose kind is not in ``kinds`` or whose shape does not fit the ``size`` bytes of its member."""
    start = stream.read(12)
    version = tuple(start[6:8])
    if start[:6] != b"\x93NUMPY" or version not in ((1, 0), (2, 0)) or len(start) < 12:
        raise InputError(f"{label} is not in NumPy's format, version 1 or 2")
    before = 10 if version == (1, 0) else 12
    length = int.from_bytes(start[8:before], "little")
    if length > HEADER_LIMIT:
        raise InputError(f"{label} has a header of {length} bytes; at most {HEADER_LIMIT} are read")
    replay = _Replay(start[8:] + stream.read(length))
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    try:
        shape, _, dtype = read(replay, max_header_size=HEADER_LIMIT)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError, TokenError) as error:
        raise InputError(f"{label} has a header that makes no sense ({_reason(error)})") from None
    if dtype.hasobject or dtype.kind not in kinds:
        raise InputError(f"{label} holds {_kind(dtype)}; must be numbers")
    count = 1
    for extent in shape:
        if extent < 0:
            raise InputError(f"{label} has the shape {shown(shape)}")
        count *= extent
    if count * dtype.itemsize != size - before - length:
        raise InputError(f"{label} has the shape {shown(shape)}, which does not fit its {size - before - length} bytes")


class _Replay:
    """The bytes of a header as a stream."""

    def __init__(self, content: bytes) -> None:
        self.content, self.position = content, 0

    def read(self, count: int) -> bytes:
        part = self.content[self.position : self.position + count]
        self.position += len(part)
        return part


def _kind(dtype: np.dtype) -> str:
    names = {"b": "true/false values", "c": "complex numbers", "U": "text", "S": "text", "O": "Python objects"}
    return names.get(dtype.kind, f"values of type {shown(str(dtype))}")


def _check_writable(target: Path) -> None:
    """A new name in place of a write-protected file would be allowed, but not what its owner meant."""
    if target.exists() and not os.access(target, os.W_OK):
        raise InputError(f"output {shown(str(target), 200)}: is write-protected; must be a new or a writable file")


def _create(target: Path) -> Path:
    """A new empty file beside ``target``, with the permissions that it has or that a new file gets."""
    part = target.parent / f".atmo-jit-{_host()}-{os.getpid()}-{secrets.token_hex(4)}{target.suffix}"
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    with suppress(OSError):  # a new file, or a file system without permissions
        os.chmod(part, stat.S_IMODE(target.stat().st_mode))
    return part


def _sync(path: Path) -> None:
    """Have the file or folder on the disk before anything refers to it, where the file system can promise that."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder on Windows
        return
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_stale(folder: Path) -> None:
    """Remove temporaries in ``folder`` that this machine's dead processes left."""
    if os.name != "posix":  # elsewhere a signal 0 is not a harmless question
        return
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            match = _TEMPORARY.fullmatch(entry.name)
            if match and match["host"] == _host() and not _alive(int(match["process"])):
                os.unlink(entry.path)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _host() -> str:
    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return shown(str(error), 200).strip("'\"")
