"""Homes that are missing or write-protected, few file descriptors, and several commands that write one output."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from atmo_jit.files import read_npz
from atmo_jit.image import read_planes

pytestmark = pytest.mark.skipif(os.name != "posix", reason="permissions and limits of POSIX")

VIEWS = {"altitude_m": 0.0, "sun_zenith_deg": 60.0, "view_zenith_deg": 45.0, "azimuth_deg": 90.0}
# The command line with at most so many open files.
FEW_FILES = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (12, 12))
from atmo_jit.cli import main
sys.exit(main(sys.argv[1:]))
"""
# The superuser may write everywhere by capabilities, which exec takes away when they are not in the bounding set.
UNPRIVILEGED = """
import ctypes, os, sys
if os.geteuid() == 0:
    for capability in (1, 2):
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
COMMAND = [sys.executable, "-m", "atmo_jit"]


@pytest.mark.parametrize("where", ["no home, few files", "home that cannot be written, no temporary folder"])
def test_a_sky_needs_no_home(where, tmp_path):
    """Kernels are not kept then, of which Dr.Jit has its own line."""
    np.savez(tmp_path / "views.npz", **{name: np.full(3, value) for name, value in VIEWS.items()})
    environment = {name: value for name, value in os.environ.items() if name not in ("HOME", "DRJIT_CACHE_DIR")}
    command = [sys.executable, "-c", FEW_FILES]
    if where.startswith("home"):
        (tmp_path / "home").mkdir(mode=0o555)
        environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "none")}
        command = [sys.executable, "-c", UNPRIVILEGED, *COMMAND]
    arguments = ["sky", "--atmosphere", "earth", "--views", "views.npz", "--out", "o.npz", "--quiet"]
    done = subprocess.run(
        [*command, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert all(line.startswith("jit_init(): ") for line in done.stderr.splitlines()), done.stderr
    assert read_npz(tmp_path / "o.npz", kinds="biufU")["radiance"].min() > 0.0


def test_several_renders_write_one_picture(tmp_path):
    """Each leaves its own, whole; what stays is that of one of them."""
    sizes = ("8", "12", "16")
    running = [
        subprocess.Popen(
            [*COMMAND, "render", "ball", "--out", "a.exr", "--width", width, "--spp", "4", "--quiet"],
            cwd=tmp_path,
            stderr=subprocess.PIPE,
            text=True,
        )
        for width in sizes
    ]
    assert [process.communicate(timeout=300)[1] for process in running] == [""] * len(sizes)
    assert [process.returncode for process in running] == [0] * len(sizes)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png"]
    (width,) = {plane.shape[1] for plane in read_planes(tmp_path / "a.exr").values()}
    assert str(width) in sizes
