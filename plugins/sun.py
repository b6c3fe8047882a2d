"""Light and ground for the air of :mod:`.medium`: the sun at the top of the atmosphere, and reflectances per
wavelength.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .exposed import array, host, number
from .lookup import texture
from .wavelengths import Wavelengths

FAR = 1e10  # scene units: farther than any scene


class PerWavelength:
    """A texture with one value for each wavelength of an atmosphere, the same everywhere. ``use`` it before anything
    else.
    """

    def __init__(self, props: Any) -> None:
        mi.Texture.__init__(self, props)

    def use(self, values: np.ndarray, wavelengths: Wavelengths) -> None:
        """Set the values [W] and which of them belongs to a path."""
        self.wavelengths = wavelengths
        self._values = array(values)
        self.parameters_changed()

    def traverse(self, callback: Any) -> None:
        callback.put("value", self._values, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(self._values)
        self._fixed = self.wavelengths.fixed(self._values)

    def eval(self, si: Any, active: Any = True) -> Any:
        fixed = None if dr.grad_enabled(self._values) else self._fixed
        return self.wavelengths.read(self._values, fixed, self.wavelengths.choose(si))

    def eval_1(self, si: Any, active: Any = True) -> Any:
        return dr.mean(self.eval(si, active))

    def mean(self) -> Any:
        return mi.Float(float(host(self._values).mean()))

    def max(self) -> float:
        return float(host(self._values).max())

    def spectral_resolution(self) -> float:
        return 1.0

    def is_spatially_varying(self) -> bool:
        return False

    def to_string(self) -> str:
        return f"PerWavelength[{self._values}]"


class Sun:
    """Parallel or nearly parallel light from far away. ``shine`` before anything else.

    The disc is seen by whatever leaves the scene towards it; with radius 0 it is not seen and its light is exactly
    parallel."""

    def __init__(self, props: Any) -> None:
        mi.Emitter.__init__(self, props)
        self.m_needs_sample_3 = False

    def shine(
        self, direction: np.ndarray, radius_deg: float, colours: np.ndarray, wavelengths: Wavelengths, nm: np.ndarray
    ) -> None:
        """Set direction (towards the sun, unit vector), angular radius (degrees) and light.

        colours: irradiance across the direction, [C, U]: for each of the wavelengths in use, the C channels of the
        variant; in spectral variants the values at the C wavelengths ``nm``, which are equidistant."""
        self._parallel = radius_deg == 0.0
        shape = mi.EmitterFlags.DeltaDirection if self._parallel else mi.EmitterFlags.SpatiallyVarying
        self.m_flags = mi.EmitterFlags.Infinite | shape
        self.sun_vector = np.asarray(direction, dtype=np.float64)
        self._direction = mi.Vector3f(*(float(v) for v in direction))
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(self._direction)
        sine = math.sin(math.radians(radius_deg))
        self._sine, self._cone = number(sine), number(max(math.pi * sine * sine, 1e-30))
        self._reach = number((2.0 * math.sin(0.5 * math.radians(radius_deg))) ** 2)
        self._wavelengths, self._spectrum = wavelengths, None
        if mi.is_spectral:
            self._first, self._step, self._count = float(nm[0]), float(nm[1] - nm[0]), len(nm)
            self._spectra = [texture(column[:, None]) for column in colours.T]
        else:
            self._channels = [array(row) for row in colours]

    def _irradiance(self, it: Any) -> Any:
        """Irradiance across the sun's direction for the path that an interaction belongs to."""
        row = self._wavelengths.row(it)
        if not mi.is_spectral:
            jit = dr.is_jit_v(mi.Float)
            return mi.UnpolarizedSpectrum(
                *(dr.gather(mi.Float, c, row) if jit else c[int(row)] for c in self._channels)
            )
        result = mi.UnpolarizedSpectrum(0.0)
        for i in range(len(result)):
            at = (it.wavelengths[i] - self._first + 0.5 * self._step) / (self._step * self._count)
            for u, spectrum in enumerate(self._spectra):
                result[i] = dr.select(row == u, spectrum.eval(at)[0], result[i])
        return result

    def eval(self, si: Any, active: Any = True) -> Any:
        return self._seen(-si.wi, si)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return mi.depolarizer(self._irradiance(it)) if self._parallel else self._seen(ds.d, it)

    def _seen(self, d: Any, it: Any) -> Any:
        inside = self._inside(d)
        return mi.depolarizer(dr.select(inside, self._irradiance(it) / self._cone, 0.0))

    def _inside(self, d: Any) -> Any:
        return (dr.squared_norm(d - self._direction) <= self._reach) if not self._parallel else d.x != d.x

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return dr.select(self._inside(ds.d), 1.0 / self._cone, 0.0)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        offset = mi.warp.square_to_uniform_disk_concentric(sample) * self._sine
        # A uniform disc across the direction is uniform over the cone to 1e-5.
        local = mi.Vector3f(offset.x, offset.y, dr.safe_sqrt(1.0 - dr.squared_norm(offset)))
        d = self._direction if self._parallel else mi.Frame3f(self._direction).to_world(local)
        ds = mi.DirectionSample3f()
        ds.d, ds.n, ds.dist, ds.p = d, -d, FAR, dr.fma(d, FAR, it.p)
        ds.uv, ds.time, ds.delta = sample, it.time, self._parallel
        ds.pdf = mi.Float(1.0) if self._parallel else 1.0 / self._cone
        ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
        return ds, mi.depolarizer(self._irradiance(it))

    def sample_position(self, time: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        if not dr.is_jit_v(mi.Float):
            raise NotImplementedError("an emitter at infinity has no positions")
        return dr.zeros(mi.PositionSample3f), mi.Float(dr.nan)

    def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        raise NotImplementedError("the reference's sun is not for particle tracing")

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return f"Sun[direction = {self._direction}]"
