"""Every variant of the installed Mitsuba renders, or says why not."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

mi = pytest.importorskip("mitsuba")

# Scenes, in every variant after the other and back again, in one process; what each came to.
CODE = """
import contextlib, io, json, sys
import numpy as np
from atmo_jit.cli import main
from atmo_jit.image import read_planes
names, out, found = json.loads(sys.argv[1]), sys.argv[2] + "/a.exr", []
for name, *more in json.loads(sys.argv[3]):
    for variant in [*names, *names[-2::-1]]:
        small = ["--width", "8", "--height", "4", "--spp", "4", "--quiet"]
        with contextlib.redirect_stderr(io.StringIO()) as said:
            status = main(["render", name, *more, "--variant", variant, *small, "--out", out])
        planes = read_planes(out) if status == 0 else {}
        found.append((variant, status, said.getvalue(), {k: float(np.mean(v)) for k, v in planes.items()}))
json.dump(found, sys.stdout)
"""


def rendered(tmp_path, variants, *scenes):
    command = [sys.executable, "-c", CODE, json.dumps(variants), str(tmp_path), json.dumps(scenes)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return json.loads(done.stdout)


def check(found):
    for variant, status, said, means in found:
        if status == 0:
            assert set(means) == ({"Y"} if "mono" in variant else {"R", "G", "B"})
            assert all(0.0 < mean < float("inf") for mean in means.values()), (variant, means)
            assert all(line.startswith("atmo-jit: warning: ") for line in said.splitlines())
        else:
            assert status == 2 and said.startswith("atmo-jit: ") and said.count("\n") == 1, (variant, said)
    return {variant for variant, status, *_ in found if status == 0}


def test_some_variants_one_after_the_other(tmp_path):
    found = rendered(tmp_path, ["llvm_ad_rgb", "scalar_spectral", "llvm_ad_mono_polarized", "scalar_rgb"], ["noon"])
    assert len(check(found)) == 4
    there, back = found[:4], found[:2:-1]
    for one, other in zip(there, back, strict=True):
        assert one[0] == other[0] and one[3] == pytest.approx(other[3], rel=1e-5)


@pytest.mark.slow
def test_every_variant(tmp_path):
    """Of CPUs the emitter and the path-traced air in all, the integrator `atmosphere_path` where its page says; of
    NVIDIA's GPUs where there is one."""
    variants = list(mi.variants())
    scenes = ["noon"], ["valley"], ["sunset", "--reference"]
    found = rendered(tmp_path, variants, *scenes)
    size = len(found) // len(scenes)
    emitter, path, reference = (check(found[i * size : (i + 1) * size]) for i in range(len(scenes)))
    cpu = {variant for variant in variants if not variant.startswith("cuda")}
    assert emitter >= cpu and reference >= cpu
    assert path >= {v for v in cpu if v.startswith("llvm") and "polarized" not in v}
    for variant, status, said, _ in found:
        if status:
            assert "does not start here" in said if variant.startswith("cuda") else "variant: found " in said
