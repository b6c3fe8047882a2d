"""Outputs that cannot be written: one line, the old files stay, nothing temporary is left."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from subprocess import DEVNULL

import pytest

from atmo_jit.files import atomic_outputs
from bench.kills import OLD, works

pytestmark = pytest.mark.skipif(os.name != "posix", reason="permissions and limits of POSIX")

# The superuser may write everywhere by capabilities, which exec takes away when they are not in the bounding set.
UNPRIVILEGED = """
import ctypes, os, sys
CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, PR_CAPBSET_DROP = 1, 2, 24
if os.geteuid() == 0:
    for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
# Command lines from stdin; their statuses and what they said, and which files there are with which content.
COMMANDS = """
import contextlib, io, json, os, resource, sys
from pathlib import Path
from atmo_jit.cli import main
limit, found = int(sys.argv[1]), []
for arguments, folder in json.load(sys.stdin):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit >= 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    with contextlib.redirect_stderr(io.StringIO()) as said:
        status = main([*arguments, "--quiet"])
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    there = {path.name: path.read_bytes().decode("latin-1") for path in Path(folder).iterdir()}
    found.append((status, said.getvalue(), there))
json.dump(found, sys.stdout)
"""
# The folder $1 on a file system of its own, which what is in it fills.
FULL = """
set -e
cp -r "$1" "$1.copy"
mount -t tmpfs -o size=256k tmpfs "$1" || exit 77
cp -r "$1.copy/." "$1"
cat /dev/zero > "$1/filler" 2>/dev/null || true
shift
exec "$@"
"""
BECOMES = """
import sys
from pathlib import Path
from atmo_jit.errors import OutputError
from atmo_jit.files import atomic_outputs
try:
    with atomic_outputs(Path(sys.argv[1]) / "a.npz") as (part,):
        part.write_bytes(b"new")
        part.parent.chmod(0o555)
except OutputError as error:
    print(error)
"""
CANNOT = 77


def run(every, *prefix, limit=-1):
    """What each of the commands came to."""
    command = [*prefix, sys.executable, "-c", COMMANDS, str(limit)]
    tasks = json.dumps([(w.arguments, str(w.folder)) for w in every])
    done = subprocess.run(command, input=tasks, capture_output=True, text=True, timeout=300)
    if done.returncode == CANNOT:
        pytest.skip(f"cannot be had here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return zip(every, json.loads(done.stdout), strict=True)


@pytest.fixture
def unprivileged(tmp_path):
    """What to put before a command line for a user who may not write everywhere."""
    closed = tmp_path / "closed"
    closed.mkdir()
    closed.chmod(0o555)
    prefix = (sys.executable, "-c", UNPRIVILEGED)
    writes = [sys.executable, "-c", f"open({str(closed / 'x')!r}, 'w')"]
    if subprocess.run([*prefix, *writes], stderr=DEVNULL).returncode == 0:
        pytest.skip("this superuser cannot be kept from writing")
    return prefix


@pytest.fixture
def every(tmp_path):
    """Every command that writes, with old files where it will write."""
    (tmp_path / "all").mkdir()
    found = works(tmp_path / "all", ("sky", "render", "reference", "export", "fit", "bench"))
    for work in found:
        work.lay_old()
    return found


def test_a_folder_that_cannot_be_written(every, unprivileged):
    for work in every:
        work.folder.chmod(0o555)
    for work, (status, said, there) in run(every, *unprivileged):
        assert (status, said.count("\n")) == (2, 1), (work.name, said)
        assert said.startswith("atmo-jit: output ") and "cannot be written" in said and str(work.folder) in said
        assert there == dict.fromkeys(work.outputs, OLD.decode()), work.name


@pytest.mark.parametrize("last", [False, True])
def test_a_file_that_cannot_be_written(every, unprivileged, last):
    """The first of a command's outputs, or the last."""
    for work in every:
        (work.folder / work.outputs[-last]).chmod(0o444)
    for work, (status, said, there) in run(every, *unprivileged):
        assert (status, said.count("\n")) == (2, 1), (work.name, said)
        assert said.startswith("atmo-jit: output ") and work.outputs[-last] in said and "is write-protected" in said
        assert there == dict.fromkeys(work.outputs, OLD.decode()), work.name


@pytest.mark.parametrize(
    ("how", "count"),
    [("file system", 2), *(pytest.param(how, 6, marks=pytest.mark.slow) for how in ("file system", "limit"))],
)
def test_a_full_disk(every, how, count):
    """Of a file system that is full; and a limit to the size of files, for which nobody needs rights."""
    every = every[:count]
    folder = str(every[0].folder.parent)
    full = ("unshare", "--mount", "bash", "-c", FULL, "full", folder)
    for work, (status, said, there) in run(every, *full) if how == "file system" else run(every, limit=100):
        assert status == 1, (work.name, said)
        line = said.splitlines()[-1]
        assert line.startswith("atmo-jit: output ") and "cannot be written (" in line and str(work.folder) in line
        assert ("No space left" if how == "file system" else "File too large") in line
        assert there == dict.fromkeys(work.outputs, OLD.decode()), work.name


def test_a_folder_that_becomes_write_protected(tmp_path, unprivileged):
    """What cannot be taken away then, the next run does."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a.npz").write_bytes(OLD)
    done = subprocess.run([*unprivileged, sys.executable, "-c", BECOMES, str(folder)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "a.npz': cannot be written (Permission denied)" in done.stdout
    folder.chmod(0o755)
    assert (folder / "a.npz").read_bytes() == OLD
    with atomic_outputs(folder / "b.npz") as (part,):
        part.write_bytes(b"new")
    assert sorted(path.name for path in folder.iterdir()) == ["a.npz", "b.npz"]
