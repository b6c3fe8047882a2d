"""Bad files in place of good ones: truncated, bit-flipped, with other numbers, shapes and kinds, blown up."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from random import Random
from typing import Any

import numpy as np

HUGE = (10**400, 1e308, -1, 0, float("nan"), float("inf"), True, None, "x", [], {}, [[1]], "../../../../etc/passwd")
NAMES = ("../escape", "/etc/passwd", "a\0b", "$(touch pwned)", "x" * 5000)


class Pickled:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark: str) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (self.mark, "w")


def damaged(rng: Random, name: str, good: bytes, mark: str) -> bytes:
    """A bad file in place of a good one of that ``name``; ``mark``: what a Python object in it would leave."""
    kind = rng.randrange(5)
    if kind == 0:
        return good[: rng.randrange(len(good))]
    if kind == 1:
        raw = bytearray(good)
        for _ in range(rng.choice((1, 3, 20))):
            raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)
        return bytes(raw)
    if kind == 2:
        return rng.choice((b"", b"\0" * 1000, b"\xff" * 100, good * 2, b"[" * 100_000, b"\xef\xbb\xbf" + good))
    if name.endswith(".npz"):
        return hostile_npz(rng, good, mark)
    if name.endswith(".exr"):
        return _hostile_exr(rng, good)
    if name.endswith(".json"):
        return _hostile_json(rng, json.loads(good)).encode()
    bad = rng.choice(("1e999", "-1", "nan", "0x10", "[[", '"' * 7, "9" * 5000, "'''", "\0", "=1+1", "", "../../etc"))
    value = rng.choice(list(re.finditer(rb"(?<=[ \",])[\w.+-]+(?=[ \",\n])", good)))
    return good[: value.start()] + bad.encode() + good[value.end() :]


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def hostile_npz(rng: Random, good: bytes, mark: str) -> bytes:
    with np.load(io.BytesIO(good)) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(sorted(arrays))
    kind = rng.randrange(6)
    if kind == 0:
        arrays[name] = np.array([Pickled(mark)], dtype=object)
    elif kind == 1:
        arrays[name] = rng.choice([arrays[name][..., None], np.zeros((0,)), np.zeros(7), np.zeros((2, 3, 4))])
    elif kind == 2:
        arrays[name] = rng.choice([np.array(["a"]), np.array([1j]), np.full(6, np.nan), np.full(6, 1e300), np.ones(6)])
    elif kind == 3:
        arrays["extra"] = np.zeros(3)
    elif kind == 4:
        del arrays[name]
    else:  # a bomb: 16 GiB of zeros that pack into little, announced by a header
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                header, {"descr": "<f8", "fortran_order": False, "shape": (rng.choice((1 << 31, 10**14)),)}
            )
            archive.writestr(f"{name}.npy", header.getvalue() + b"\0" * (1 << 22))
        return stream.getvalue()
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _hostile_json(rng: Random, tree: Any) -> str:
    """JSON with one value, key or shape changed, somewhere."""
    node, parents = tree, []
    while isinstance(node, (dict, list)) and node and (not parents or rng.random() < 0.8):
        key = rng.choice(sorted(node)) if isinstance(node, dict) else rng.randrange(len(node))
        parents.append((node, key))
        node = node[key]
    holder, key = rng.choice(parents)
    change = rng.randrange(4)
    if change == 0 and isinstance(holder, dict):
        del holder[key]
    elif change == 1 and isinstance(holder, dict):
        holder[rng.choice(("__class__", "", "type", "metadata", "path"))] = rng.choice((*HUGE, *NAMES))
    elif change == 2:
        holder[key] = [holder[key]] * rng.choice((2, 10_000))
    else:
        holder[key] = rng.choice((*HUGE, *NAMES))
    return json.dumps(tree)


def _hostile_exr(rng: Random, good: bytes) -> bytes:
    """OpenEXR with another window, of any size, or with other types or names of its channels."""
    if rng.random() < 0.7:
        start = good.index(b"dataWindow\0box2i\0") + 22
        corner = rng.choice(((20_000, 200_000), (2**30, 7), (2**31 - 1, 2**31 - 1), (0, 0), (-5, 3), (31, 7)))
        return good[:start] + struct.pack("<4i", 0, 0, *corner) + good[start + 16 :]
    start = good.index(b"channels\0chlist\0") + 21
    other = rng.choice((b"Y", b"A", b"\xff", b"B"))
    return good[:start] + other + good[start + 1 :]
