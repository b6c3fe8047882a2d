"""The native layout is the solution itself."""

from __future__ import annotations

import json

import numpy as np
import pytest

from atmo_jit.backend import doubles
from atmo_jit.errors import InputError
from atmo_jit.export import Options, export, read
from atmo_jit.export.native import FILE, files
from atmo_jit.grid import Grid
from atmo_jit.solved import Sky
from bench.worlds import WORLDS


def light(sky):
    rng = np.random.default_rng(0)
    altitude, sun = rng.uniform(0, 1.2 * sky.atmosphere.thickness_m, 300), rng.uniform(0, 1.8, 300)
    angles = rng.uniform(0, np.pi, (2, 300))
    found = sky.rays(*map(doubles, (altitude, sun, *angles)))
    return np.stack([v.numpy() for v in (*found.radiance, *found.transmittance)])


@pytest.mark.parametrize("world", ["earth", "two aerosols, five wavelengths"])
def test_a_loaded_solution_gives_the_same_radiance(tmp_path, world):
    solved = Sky(WORLDS.get(world, world))
    made = files(solved)
    assert made.error == {}  # nothing was rounded
    export(solved.atmosphere, "native", tmp_path)
    Grid._known.clear()  # as in another process
    loaded = read(tmp_path)
    assert np.array_equal(light(loaded), light(solved))


def test_orders_and_tolerance_come_along(tmp_path):
    export("earth", "native", tmp_path, Options(orders=1, tolerance=0.03))
    loaded = read(tmp_path)
    assert (loaded.orders, loaded.tolerance) == (1, 0.03)
    np.savez(tmp_path / FILE, **{"0.moments": np.zeros(3, np.float32)})
    with pytest.raises(InputError, match="does not fit"):
        read(tmp_path)


def test_a_table_of_columns_with_no_size(tmp_path):
    """77:1304 of bench.hostile: an IndexError."""
    export("earth", "native", tmp_path, Options(orders=1, tolerance=0.03))
    page = tmp_path / "params.json"
    parameters = json.loads(page.read_text(encoding="utf-8"))
    parameters["resolution"]["columns"] = []
    page.write_text(json.dumps(parameters), encoding="utf-8")
    with pytest.raises(InputError, match="does not fit its params.json"):
        read(tmp_path)
