"""Files of tables: raw texels, OpenEXR, TIFF, NumPy and JSON, each written, read back and compared.

A :class:`File` knows how to write and how to read itself; :func:`write_all` writes all of them under temporary names,
reads them back, and renames them only when every one holds what was meant.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..backend import floats, types
from ..errors import InputError
from ..files import atomic_outputs, write_npz
from ..image import write_planes

CHANNELS = ("R", "G", "B", "A")


@dataclass(frozen=True)
class File:
    """``name`` in the folder; ``write(path)``; ``read(path)`` must give back ``content``."""

    name: str
    content: Any
    write: Callable[[Path], None]
    read: Callable[[Path], Any]


def write_all(folder: Path, files: Sequence[File]) -> int:
    """Write files into ``folder`` (made if it is not there), verified before they get their names; bytes written.

    Raises OSError when a file does not read back as it was meant; files that were there before then stay.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_outputs(*(folder / file.name for file in files)) as parts:
        with ThreadPoolExecutor() as pool:  # compression leaves Python's lock to others
            for _ in pool.map(_write_and_check, files, parts):
                pass
        return sum(part.stat().st_size for part in parts)


def _write_and_check(file: File, part: Path) -> None:
    file.write(part)
    if not _same(file.content, file.read(part)):
        raise OSError(f"{file.name}: does not read back as it was written")


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_same(v, b[k]) for k, v in a.items())
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    return a == b


def raw(name: str, texels: np.ndarray) -> File:
    """Little-endian texels without a header, row 0 first."""
    little = np.ascontiguousarray(texels, dtype=texels.dtype.newbyteorder("<"))

    def read(path: Path) -> np.ndarray:
        return read_raw(path, texels.dtype, texels.shape)

    return File(name, texels, lambda path: path.write_bytes(memoryview(little).cast("B")), read)


def read_raw(path: Path, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Raw texels of a known shape. Raises InputError when the file has another size."""
    dtype = np.dtype(dtype)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{str(path)!r}: cannot be read ({error.strerror})") from None
    expected = int(np.prod(shape)) * dtype.itemsize
    if len(content) != expected:
        raise InputError(f"{str(path)!r}: has {len(content)} bytes; a table of {shape} texels has {expected}")
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype).reshape(shape)


def exr(name: str, texels: np.ndarray, header: dict[str, Any], *, flipped: bool = False) -> File:
    """Texels [rows, columns, channels] or, slices stacked, [slices, rows, columns, channels] as a scanline OpenEXR with
    ZIP. ``flipped``: last row first. Header values are text or numbers."""
    image = texels.reshape(-1, *texels.shape[-2:])
    image = image[::-1] if flipped else image

    def write(path: Path) -> None:
        import OpenEXR

        planes = {c: np.ascontiguousarray(image[..., i]) for i, c in enumerate(CHANNELS[: image.shape[-1]])}
        fixed = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        write_planes(path, {**fixed, **header}, planes)

    return File(name, image, write, read_exr)


def read_exr(path: Path) -> np.ndarray:
    """The channels of an OpenEXR [rows, columns, channels] in the order R, G, B, A."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = file.channels()
        return np.stack([planes[c].pixels for c in CHANNELS if c in planes], axis=-1)


def exr_header(path: Path) -> dict[str, Any]:
    """The header of an OpenEXR."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header())


def tiff(name: str, texels: np.ndarray, metadata: dict[str, Any]) -> File:
    """Texels [rows, columns, 3] or, one page each, [slices, rows, columns, 3] as float32 RGB TIFF."""
    pages = texels.astype(np.float32)

    def write(path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, pages, photometric="rgb", description=json.dumps(metadata), metadata=None)

    def read(path: Path) -> np.ndarray:
        import tifffile

        return tifffile.imread(path)

    return File(name, pages, write, read)


def npy(name: str, texels: np.ndarray) -> File:
    """A NumPy array."""

    def write(path: Path) -> None:
        with open(path, "wb") as file:
            np.save(file, texels)

    return File(name, texels, write, lambda path: np.load(path, allow_pickle=False))


def npz(name: str, arrays: dict[str, np.ndarray]) -> File:
    """Several NumPy arrays."""

    def write(path: Path) -> None:
        write_npz(path, arrays)

    def read(path: Path) -> dict[str, np.ndarray]:
        with np.load(path, allow_pickle=False) as held:
            return {key: held[key] for key in held.files}

    return File(name, arrays, write, read)


def document(name: str, content: dict[str, Any]) -> File:
    """A JSON object. Numbers that JSON does not have (NaN) are refused."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    return source(name, text)


def source(name: str, content: str) -> File:
    """Plain text."""
    return File(
        name,
        content,
        lambda path: path.write_text(content, encoding="utf-8"),
        lambda path: path.read_text(encoding="utf-8"),
    )


# Below its smallest normal number, whose bits these are, half precision loses digits.
LARGEST_HALF, SMALLEST_HALF, SMALLEST_NORMAL = 65504.0, 6.1e-5, 0x0400


def halved(name: str, values: np.ndarray, warnings: list[str]) -> np.ndarray:
    """Values rounded to the nearest half. Raises InputError beyond its range; adds to ``warnings`` how many positive
    values lose digits below its smallest normal number."""
    largest = float(np.max(values, initial=0.0))
    if not largest <= LARGEST_HALF:
        raise InputError(
            f"{name}: its largest value is {largest:.3g}; half precision holds up to {LARGEST_HALF:g} (scale "
            "solar_irradiance down)"
        )
    # By the processor: NumPy takes a hundred times as long for small values.
    half = types().Float16(floats(values)).numpy().reshape(values.shape)
    bits = half.view(np.uint16)
    small = np.count_nonzero(bits < SMALLEST_NORMAL) - np.count_nonzero(values == 0.0)
    small /= max(np.count_nonzero(bits), 1)
    if small > 1e-3:
        warnings.append(
            f"{name}: {100.0 * small:.1f} % of its positive values are below {SMALLEST_HALF:g}, where half precision "
            "loses digits (deep twilight, short rays)"
        )
    return half
