"""Tables of a changing atmosphere, filled block by block: what is looked at first.

A camera in the air under one sun reads two altitudes and two suns of the scattering tables, a hundredth of their
texels. Those are solved and baked within a frame or two; the rest follows, and every texel is one that ``atmo-jit
export`` would write.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from typing import Any

import drjit as dr
import numpy as np

from .. import __version__
from .._fields import Range, number
from ..atmosphere import Atmosphere
from ..backend import doubles
from ..bake.client import IRRADIANCE, SCATTERING, TRANSMITTANCE, Block, columns_up, transmittance_up, view_rows
from ..bake.error import compare
from ..errors import InputError, shown
from ..export.colour import Channels, channels
from ..export.family import client_tables, table_error
from ..export.lookup import ClientTables
from ..export.parameters import aerosol
from ..export.shaders import glsl
from ..mapping import Bruneton, texels
from ..solved import Sky
from ..spectrum import SpectralBasis
from .controls import MU_S_MIN, changed, check, controls

VIEWS, OFF_HORIZON_DEG = 500, 0.5  # of the error estimate for one observer and sun
ALTITUDES, SUNS = SCATTERING[0], SCATTERING[3]
# What the page shows first; angles in degrees, azimuths clockwise from north.
START = {
    "altitude_m": 500.0,
    "sun_zenith_deg": 75.0,
    "sun_azimuth_deg": 180.0,
    "yaw_deg": 170.0,
    "pitch_deg": 12.0,
    "fov_deg": 70.0,
    "stops": 0.0,
}


class Live:
    """The tables of an atmosphere and of what the viewer's controls make of it.

    Raises InputError for an atmosphere whose picture would be wrong in these tables.
    """

    def __init__(self, air: Atmosphere, name: str, tolerance: float = 0.01) -> None:
        if not 0.0 < tolerance < 1.0:
            raise InputError(f"tolerance: is {tolerance!r}; must be a number between 0 and 1")
        self.air, self.name, self.tolerance = air, name, tolerance
        self.to = Bruneton(air.bottom_radius_m, air.top_radius_m, MU_S_MIN)
        nm = air.wavelengths_nm
        self.kind = "samples" if len(nm) == 3 and nm[0] > nm[1] > nm[2] else "spectral"
        self.warnings = check(air)
        self._last: _Tables | None = None
        self._parameters: Any = None

    def describe(self) -> dict[str, Any]:
        """All that the page needs before it has tables."""
        colours = channels(self.air, self.kind)
        matrix = SpectralBasis.of(self.air).srgb_matrix if self.kind == "samples" else np.eye(3)
        return {
            "name": self.name,
            "version": __version__,
            "start": START,
            "controls": controls(self.air),
            "bottom_radius_m": self.air.bottom_radius_m,
            "thickness_m": self.air.thickness_m,
            "sun_angular_radius_deg": self.air.sun_angular_radius_deg,
            "solar": colours.solar.tolist(),
            "to_srgb": matrix.tolist(),
            "altitudes_m": self.to.transmittance_inverse(texels(ALTITUDES), np.zeros(ALTITUDES))[0].tolist(),
            "suns_deg": np.degrees(np.arccos(self.to.sun_inverse(texels(SUNS)))).tolist(),
            "transmittance": TRANSMITTANCE,
            "irradiance": IRRADIANCE,
            "scattering": SCATTERING,
            "warnings": self.warnings,
        }

    def lookup(self) -> str:
        """The look-up of these tables in GLSL, as it is exported; g is a uniform, ``mie_g``."""
        return "#define ATM_MIE_G mie_g\n" + glsl(self.to, 0.0, SCATTERING)

    def atmosphere(self, parameters: Any) -> Atmosphere:
        """The atmosphere with the controls at ``parameters``."""
        return changed(self.air, parameters)

    def warm(self) -> None:
        """Solve what the page shows first, with a sun more on either side, before it asks."""
        altitudes, suns = self._tables({}).cells(START["altitude_m"], np.radians(START["sun_zenith_deg"]))
        self._tables({}).fill((altitudes, slice(max(suns.start - 1, 0), min(suns.stop + 1, SUNS))))

    def texels(self, parameters: Any, altitudes: Any, suns: Any) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Description and float32 arrays of one block: transmittance [64, 256, 3], irradiance [16, 64, 3],
        transmittance to the ground of the rows that end there [altitudes, rows / 2, 3]; scattering and single_mie [A,
        rows, angles, S, 3], with A and S the ranges ``altitudes`` and ``suns``, [first, end]."""
        block = (_range(altitudes, "altitudes", ALTITUDES), _range(suns, "suns", SUNS))
        tables = self._tables(parameters)
        tables.fill(block)
        about = {
            "altitudes": [block[0].start, block[0].stop],
            "suns": [block[1].start, block[1].stop],
            "g": tables.one.g,
            "ground_albedo": _albedo(tables.air, tables.colours).tolist(),
            "solve_s": tables.solve_s,
            "bake_s": tables.bake_s,
            "warnings": self.warnings,
        }
        found = tables.found
        arrays = [found.transmittance, found.irradiance, tables.to_ground]
        arrays += [found.scattering[block[0], :, :, block[1]], found.single_mie[block[0], :, :, block[1]]]
        return about, arrays

    def error(self, parameters: Any, altitude_m: Any, sun_zenith_deg: Any) -> dict[str, Any]:
        """Errors of radiance in the tables against the solution: ``view``, of one observer and sun, and ``whole``, by
        the sun's height; None where texels are still missing."""
        altitude = number(altitude_m, "altitude_m", Range(0))
        sun = np.radians(number(sun_zenith_deg, "sun_zenith_deg", Range(0, 180)))
        return self._tables(parameters).error(altitude, sun)

    def _tables(self, parameters: Any) -> _Tables:
        if self._last is None or self._parameters != parameters:
            air = changed(self.air, parameters)
            spare = self._last.found if self._last else None
            self._last = None  # its arrays are written over
            self._last, self._parameters = _Tables(air, self.kind, self.tolerance, spare), parameters
        return self._last


class _Tables:
    """The solved sky of one atmosphere, and those blocks of its tables that were asked for."""

    def __init__(self, air: Atmosphere, kind: str, tolerance: float, spare: ClientTables | None) -> None:
        self.air, self.colours, self.one, self.tolerance = air, channels(air, kind), aerosol(air), tolerance
        self._sky: Sky | None = None
        self._suns = slice(0, 0)
        self.solve_s = 0.0
        self.to = Bruneton(air.bottom_radius_m, air.top_radius_m, MU_S_MIN)
        self.known = np.zeros((ALTITUDES, SUNS), dtype=bool)
        self.to_ground: np.ndarray | None = None
        self.found: ClientTables | None = None
        self._spare = spare
        self.bake_s = 0.0
        self._whole: dict[str, Any] | None = None

    def solved(self, suns: slice) -> Sky:
        """The sky under these suns: what is asked for first is solved for no others, in a third of the time, and
        whatever comes after that for all."""
        if self._sky is None or suns.start < self._suns.start or suns.stop > self._suns.stop:
            start = time.perf_counter()
            if self._sky is not None:
                suns = slice(0, SUNS)
            angles = np.arccos(self.to.sun_inverse(texels(SUNS)))[suns]
            limits = None if suns == slice(0, SUNS) else (float(angles[-1]), float(angles[0]))
            self._sky, self._suns = Sky(self.air, tolerance=self.tolerance, suns=limits), suns
            self.solve_s = time.perf_counter() - start
        return self._sky

    def fill(self, block: Block) -> None:
        """Bake a block, unless all of it is there; ``bake_s``: seconds that the last one took."""
        if self.known[block].all():
            return
        sky, start = self.solved(block[1]), time.perf_counter()
        part = client_tables(sky, self.colours, self.one, MU_S_MIN, SCATTERING, block)
        flat = [v.astype(np.float32) for v in (part.transmittance, part.irradiance)]
        if self.found is None:
            # To touch new memory takes as long as to solve.
            if self._spare is None:
                whole = [np.zeros((*SCATTERING, 3), dtype=np.float32) for _ in range(2)]
            else:
                whole = [self._spare.scattering, self._spare.single_mie]
            self.found = ClientTables(self.to, self.one.g, *flat, *whole)
            self.to_ground = self._transmittance_to_ground(sky)
        self.found.transmittance, self.found.irradiance = flat
        self.found.scattering[block[0], :, :, block[1]] = part.scattering
        self.found.single_mie[block[0], :, :, block[1]] = part.single_mie
        self.known[block] = True
        self.bake_s = time.perf_counter() - start

    def _transmittance_to_ground(self, sky: Sky) -> np.ndarray:
        """[altitude, row, 3] of the view rays that end there: what the air holds from the ground up along such a ray,
        less what it holds from its origin up."""
        h, mu, ground = view_rows(self.to, *SCATTERING[:2])
        h, mu = np.broadcast_arrays(h[:, None], mu[:, ground])
        sine = np.sqrt((1.0 - mu) * (1.0 + mu)) * (1.0 + h / self.to.bottom)
        there = np.sqrt(np.maximum((1.0 - sine) * (1.0 + sine), 0.0))
        through = []
        for band in sky.bands:

            def columns(optics: Any = band.optics) -> list[Any]:
                whole = columns_up(optics, np.zeros(h.size), there.ravel())
                above = columns_up(optics, h.ravel(), -mu.ravel())
                return [dr.maximum(w - a, 0.0) for w, a in zip(whole, above, strict=True)]

            kept = band.field.grid.kept("columns to the ground", columns)
            through += transmittance_up(band.optics, h.ravel(), mu.ravel(), kept)
        values = np.stack(through, axis=-1).reshape(*h.shape, -1)
        return self.colours.transmittance(values, self.air.solar_irradiance)

    def error(self, altitude: float, sun: float) -> dict[str, Any]:
        if self._whole is None and self.known.all():
            self._whole = table_error(self.found, self.solved(slice(0, SUNS)), self.colours)
        cells = self.cells(altitude, sun)
        view = self._view_error(self.solved(cells[1]), altitude, sun) if self.known[cells].all() else None
        return {"view": view, "whole": self._whole}

    def cells(self, altitude: float, sun: float) -> Block:
        """Altitudes and suns (rad) that a view reads: from space those of all places where rays may enter the air."""
        top = self.air.top_radius_m
        place = self.to.transmittance(min(altitude, self.air.thickness_m), 1.0)[0]
        i = np.clip(place * (ALTITUDES - 1), 0, ALTITUDES - 1)
        reach = np.arccos(min(top / (self.air.bottom_radius_m + altitude), 1.0))
        suns = np.clip([sun + reach, sun - reach], 0.0, np.pi)
        low, high = np.clip(self.to.sun(np.cos(suns)) * (SUNS - 1), 0, SUNS - 1)
        return slice(int(i), int(np.ceil(i)) + 1), slice(int(low), int(np.ceil(high)) + 1)

    def _view_error(self, sky: Sky, altitude: float, sun: float) -> dict[str, Any]:
        rng = np.random.default_rng(0)
        bottom = self.air.bottom_radius_m
        edge = float(np.pi - np.arcsin(bottom / (bottom + altitude)))
        # From outside only what meets the air counts.
        rim = float(np.pi - np.arcsin(min(self.air.top_radius_m / (bottom + altitude), 1.0)))
        low = rim if altitude > self.air.thickness_m else 0.0
        view = np.arccos(rng.uniform(-1.0, np.cos(low), VIEWS))
        azimuth = rng.uniform(0.0, np.pi, VIEWS)
        off = min(np.radians(OFF_HORIZON_DEG), 0.1 * (edge - low))
        view, azimuth = (v[np.abs(view - edge) > off] for v in (view, azimuth))
        rays = [np.full(view.shape, altitude), np.full(view.shape, sun), view, azimuth]
        light = sky.rays(*map(doubles, rays), ground=False).radiance
        exact = self.colours.radiance(np.stack([v.numpy() for v in light], axis=-1))
        where = {"viewZenithDeg": np.degrees(view), "azimuthDeg": np.degrees(azimuth)}
        return asdict(compare(self.found.rays(*rays).T, exact.T, where))


def _albedo(air: Atmosphere, colours: Channels) -> np.ndarray:
    return colours.transmittance(air.ground_albedo, air.solar_irradiance)


def _range(value: Any, name: str, count: int) -> slice:
    numbers = value if isinstance(value, list) and len(value) == 2 else [None, None]
    if not all(type(v) is int for v in numbers) or not 0 <= numbers[0] < numbers[1] <= count:
        raise InputError(f"{name}: found {shown(value)}; allowed: [first, end] with 0 <= first < end <= {count}")
    return slice(*numbers)


def framed(about: dict[str, Any], arrays: list[np.ndarray]) -> bytes:
    """A JSON object and arrays as bytes: length of the JSON (uint32), the JSON padded with blanks to four bytes, then
    the arrays in little-endian float32."""
    text = json.dumps(about).encode()
    text += b" " * (-len(text) % 4)
    parts = [np.ascontiguousarray(v, dtype="<f4").tobytes() for v in arrays]
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def unframed(body: bytes) -> tuple[Any, np.ndarray]:
    """The JSON value and the numbers of :func:`framed`. Raises InputError for other bytes."""
    length = int.from_bytes(body[:4], "little")
    if len(body) < 4 + length or length % 4 or len(body) % 4:
        raise InputError("request: is not a JSON object with numbers behind it")
    try:
        return json.loads(body[4 : 4 + length]), np.frombuffer(body[4 + length :], "<f4")
    except (ValueError, RecursionError) as error:
        raise InputError(f"request: is not JSON ({error})") from None
