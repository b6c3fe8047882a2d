"""Outputs appear whole or not at all; NPZ files are checked before they take memory."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from atmo_jit.errors import InputError, OutputError
from atmo_jit.files import atomic_outputs, check_output, read_npz

# --- output --------------------------------------------------------------------------------------------------------


def test_outputs_appear_when_all_are_complete(tmp_path):
    first, second = tmp_path / "a.exr", tmp_path / "a.png"
    with atomic_outputs(first, second) as (part, other):
        assert part.parent == tmp_path and (part.suffix, other.suffix) == (".exr", ".png")
        part.write_bytes(b"one")
        other.write_bytes(b"two")
        assert not first.exists() and not second.exists()
    assert (first.read_bytes(), second.read_bytes()) == (b"one", b"two")
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_existing_file_survives_a_failed_run(tmp_path, failure):
    target = tmp_path / "a.npz"
    target.write_bytes(b"old")
    with pytest.raises(failure), atomic_outputs(target, tmp_path / "b.npz") as (part, _):
        part.write_bytes(b"half")
        raise failure
    assert target.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.npz"]


def test_nothing_is_renamed_when_a_file_is_missing(tmp_path):
    names = tmp_path / "a.exr", tmp_path / "b.png"
    with pytest.raises(OutputError, match="No such file"), atomic_outputs(*names) as (_, other):
        other.unlink()
    assert os.listdir(tmp_path) == []


def test_a_replaced_file_keeps_its_permissions_and_its_link(tmp_path):
    target, link = tmp_path / "real.npz", tmp_path / "link.npz"
    target.write_bytes(b"old")
    target.chmod(0o640)
    link.symlink_to(target)
    with atomic_outputs(link) as (part,):
        part.write_bytes(b"new")
    assert link.is_symlink() and target.read_bytes() == b"new" and target.stat().st_mode & 0o777 == 0o640


def test_what_a_killed_process_left_is_removed_by_the_next_run(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from atmo_jit.files import atomic_outputs\n"
        "with atomic_outputs(Path(sys.argv[1])) as (part,):\n"
        "    part.write_bytes(b'half'); os.kill(os.getpid(), 9)"
    )
    target = tmp_path / "a.npz"
    subprocess.run([sys.executable, "-c", code, str(target)], check=False)
    assert len(os.listdir(tmp_path)) == 1 and not target.exists()
    with atomic_outputs(target) as (part,), atomic_outputs(tmp_path / "b.npz") as (other,):
        # The temporaries of living processes, this one's, stay.
        assert sorted(os.listdir(tmp_path)) == sorted([part.name, other.name])
        part.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"


def test_check_output_accepts_new_and_existing_files(tmp_path):
    assert check_output(tmp_path / "new.EXR", ".exr") == (tmp_path / "new.EXR").resolve()
    (tmp_path / "old.exr").touch()
    assert check_output(str(tmp_path / "old.exr"), ".exr") == (tmp_path / "old.exr").resolve()


def test_check_output_refuses_what_cannot_be_written(tmp_path):
    (tmp_path / "folder.npz").mkdir()
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "loop.npz").symlink_to(tmp_path / "loop.npz")
    for name in (
        "a.exr",
        "a",
        "",
        "folder.npz",
        "pipe.npz",
        "none/a.npz",
        "a\0b.npz",
        "x" * 300 + ".npz",
        "old.npz/a.npz",
    ):
        (tmp_path / "old.npz").touch()
        with pytest.raises(InputError) as caught:
            check_output(tmp_path / name, ".npz")
        assert str(caught.value).startswith("output ") and str(caught.value).isprintable()


# --- input ---------------------------------------------------------------------------------------------------------


def header(shape="(2,)", descr="'<f8'", length=None, version=(1, 0)):
    """The start of an array in NumPy's format, with any text for its parts."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    size = struct.pack("<H" if version == (1, 0) else "<I", len(text) if length is None else length)
    return b"\x93NUMPY" + bytes(version) + size + text


def archive(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


def test_arrays_come_back_in_native_order(tmp_path):
    arrays = {
        "real": np.linspace(0, 1, 5),
        "swapped": np.arange(6, dtype=">i4").reshape(2, 3),
        "single": np.float32([1.5]),
        "flags": np.array([True, False]),
        "number": np.array(3.0),
        "none": np.zeros((0, 4)),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        read = read_npz(tmp_path / "a.npz")
        assert list(read) == list(arrays)
        for name, array in arrays.items():
            assert np.array_equal(read[name], array) and read[name].dtype.isnative


def refusal(path, **limits):
    with pytest.raises(InputError) as caught:
        read_npz(path, **limits)
    assert str(caught.value).isprintable()
    assert str(caught.value).startswith(repr(str(path)))
    return str(caught.value)


def test_files_that_are_no_npz(tmp_path):
    (tmp_path / "text").write_text("altitude_m")
    (tmp_path / "empty").touch()
    np.save(tmp_path / "a.npy", np.zeros(3))
    for name in ("text", "empty", "a.npy"):
        assert "is not an NPZ file" in refusal(tmp_path / name)
    assert "No such file" in refusal(tmp_path / "none.npz")
    assert "Is a directory" in refusal(tmp_path)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as file:
        file.writestr("readme.txt", "hello")
    assert "is not an NPZ file (it holds 'readme.txt')" in refusal(tmp_path / "other.zip")


@pytest.mark.skipif(os.name != "posix", reason="devices and pipes of POSIX")
def test_what_has_no_end_is_not_read(tmp_path):
    """zipfile looks for the end of a device in all of it, and a pipe waits for someone who writes."""
    os.mkfifo(tmp_path / "pipe.npz")
    for path in ("/dev/zero", tmp_path / "pipe.npz"):
        assert refusal(path).endswith("is not a file")


def test_damaged_files(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=np.random.default_rng(1).random(1000))
    whole = (tmp_path / "a.npz").read_bytes()
    for damage in (whole[:-30], whole[: len(whole) // 2], whole[:300] + b"\0" * 50 + whole[350:]):
        (tmp_path / "b.npz").write_bytes(damage)
        refusal(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("array", "what"),
    [
        (np.array([{}], dtype=object), "Python objects"),
        (np.array(["a"]), "text"),
        (np.array([b"a"]), "text"),
        (np.array([1j]), "complex numbers"),
        (np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]), "values of type"),
        (np.array(["2020-01-01"], dtype="M8[D]"), "values of type"),
    ],
)
def test_arrays_that_are_no_numbers(tmp_path, array, what):
    np.savez(tmp_path / "a.npz", good=np.zeros(2), bad=array)
    assert f"array 'bad' holds {what}" in refusal(tmp_path / "a.npz")


def test_objects_are_refused_whatever_kinds_are_asked_for(tmp_path):
    np.savez(tmp_path / "a.npz", bad=np.array([{}], dtype=object), text=np.array("x"))
    assert "Python objects" in refusal(tmp_path / "a.npz", kinds="UO")


@pytest.mark.parametrize(
    "content",
    [
        header(shape="(10**12,)") + b"\0" * 16,
        header(shape="(1000000000000,)") + b"\0" * 16,
        header(shape="(2,)") + b"\0" * 15,
        header(shape="(2,)") + b"\0" * 17,
        header(shape="(-2,)") + b"\0" * 16,
        header(shape="(-1, -2)") + b"\0" * 16,
        header(shape="2") + b"\0" * 16,
        header(shape="(2.0,)") + b"\0" * 16,
        header(descr="'|V9'") + b"\0" * 16,
        header(descr="'nonsense'") + b"\0" * 16,
        header(descr="('<f8', (1000000000,))") + b"\0" * 16,
        header(descr="__import__('os')") + b"\0" * 16,
        header(shape="(" * 3000) + b"\0" * 16,
        header(length=60000) + b"\0" * 70000,
        header(length=2**31, version=(2, 0)) + b"\0" * 16,
        header(version=(9, 9)) + b"\0" * 16,
        b"",
        b"\x93NUMPY",
        b"NUMPY" * 10,
    ],
)
def test_headers_that_lie(tmp_path, content):
    assert "array 'x' " in refusal(archive(tmp_path / "a.npz", x=content))


def test_sizes_are_bounded_before_memory_is_taken(tmp_path):
    bomb = io.BytesIO()
    np.save(bomb, np.zeros(10**6))
    path = archive(tmp_path / "a.npz", x=bomb.getvalue())
    assert path.stat().st_size < 10**5
    assert len(read_npz(path)["x"]) == 10**6
    assert "would take more than 100000 bytes" in refusal(path, limit=10**5)
    assert "the file is larger than 100 bytes" in refusal(path, limit=100)
    many = archive(tmp_path / "b.npz", **{f"x{i}": b"" for i in range(1001)})
    assert "holds 1001 arrays" in refusal(many)


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")  # zipfile's, while the test writes such a file
def test_an_array_that_is_there_twice(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        for _ in range(2):
            file.writestr("x.npy", header() + b"\0" * 16)
    assert "array 'x' is there twice" in refusal(tmp_path / "a.npz")
