"""The sensors ``fisheye`` and ``latlong``: pictures of the whole sky, which Mitsuba's own sensors cannot take.

Both see from one point, give the mean radiance over each pixel, and are not connected to light by particle tracing.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.errors import AtmosphereError, shown

from . import settings


class _Directions:
    """What the two sensors share. ``_direction(u, v, proportion)`` gives the local direction of a place in the
    picture (u from left to right and v from top to bottom, both 0 to 1; proportion = width / height), and whether the
    picture shows anything there."""

    def __init__(self, props: Any) -> None:
        mi.Sensor.__init__(self, props)
        self.m_needs_sample_3 = False
        self._to_world = mi.Transform4f(props["to_world"].matrix) if "to_world" in props else mi.Transform4f()
        self._setup(props)
        self.parameters_changed()

    def traverse(self, callback: Any) -> None:
        mi.Sensor.traverse(self, callback)
        callback.put("to_world", self._to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(self._to_world)

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple[Any, Any]:
        film = self.film()
        size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
        u, v = ((sample2[i] * crop[i] + offset[i]) / size[i] for i in range(2))
        local, seen = self._direction(u, v, size[0] / size[1])
        wavelengths, weight = mi.Sensor.sample_wavelengths(self, dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray = mi.Ray3f(self._to_world @ mi.Point3f(0.0), dr.normalize(self._to_world @ local), time, wavelengths)
        return ray, dr.select(seen, weight, 0.0)

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        crop = self.film().crop_size()
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        right, _ = self.sample_ray(time, sample1, sample2 + mi.Vector2f(1.0 / crop[0], 0.0), sample3, active)
        down, _ = self.sample_ray(time, sample1, sample2 + mi.Vector2f(0.0, 1.0 / crop[1]), sample3, active)
        result = mi.RayDifferential3f(ray)
        result.o_x, result.d_x, result.o_y, result.d_y = right.o, right.d, down.o, down.d
        result.has_differentials = True
        return result, weight

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return f"{type(self).__name__}[to_world = {self._to_world}, film = {self.film()}]"


class Fisheye(_Directions):
    """
    .. _sensor-fisheye:

    Equidistant fisheye (:monosp:`fisheye`)
    ---------------------------------------

    .. pluginparameters::

     * - fov
       - |float|
       - Angle across the image circle in degrees, in (0, 360]. (Default: 180)

     * - to_world
       - |transform|
       - As for :monosp:`perspective`: the camera looks along its local +Z, with +Y up and +X to the left.
       - |exposed|

    The distance of a pixel from the middle of the film is proportional to its angle from the optical axis. The image
    circle touches the shorter sides of the film; outside of it the film is black. Looking at the zenith with the top of
    the picture to the north, east is on the left, as in photographs of the sky.

    .. tabs::
        .. code-tab:: xml
            :name: fisheye

            <sensor type="fisheye">
                <transform name="to_world">
                    <lookat origin="0, 0, 2" target="0, 0, 3" up="0, 1, 0"/>
                </transform>
                <film type="hdrfilm">
                    <integer name="width" value="256"/>
                    <integer name="height" value="256"/>
                </film>
            </sensor>

        .. code-tab:: python

            'type': 'fisheye',
            'to_world': mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 3], up=[0, 1, 0]),
            'film': {'type': 'hdrfilm', 'width': 256, 'height': 256}
    """

    def _setup(self, props: Any) -> None:
        fov = settings.number(props, "fov", 180.0)
        if not 0.0 < fov <= 360.0:
            raise AtmosphereError("fov", shown(fov), "a number of degrees in (0, 360]")
        self._half = fov / 2.0 * (dr.pi / 180.0)

    def _direction(self, u: Any, v: Any, proportion: float) -> tuple[Any, Any]:
        x = (1.0 - 2.0 * u) * max(proportion, 1.0)
        y = (1.0 - 2.0 * v) * max(1.0 / proportion, 1.0)
        radius = dr.sqrt(x * x + y * y)
        sine, cosine = dr.sincos(radius * self._half)
        across = dr.select(radius > 0.0, sine / dr.maximum(radius, 1e-20), 0.0)
        return mi.Vector3f(x * across, y * across, cosine), radius <= 1.0


class LatLong(_Directions):
    """
    .. _sensor-latlong:

    Latitude-longitude panorama (:monosp:`latlong`)
    -----------------------------------------------

    .. pluginparameters::

     * - to_world
       - |transform|
       - The local frame has +Z up; the middle of the picture looks along its +Y, and +X is to the right.
       - |exposed|

    The whole sphere of directions: azimuth runs from left to right, the zenith is the top row and the nadir the bottom
    row, in equal steps of the zenith angle. A film twice as wide as high has square pixels at the horizon.

    .. tabs::
        .. code-tab:: xml
            :name: latlong

            <sensor type="latlong">
                <transform name="to_world">
                    <translate z="2"/>
                </transform>
                <film type="hdrfilm">
                    <integer name="width" value="512"/>
                    <integer name="height" value="256"/>
                </film>
            </sensor>

        .. code-tab:: python

            'type': 'latlong',
            'to_world': mi.ScalarTransform4f().translate([0, 0, 2]),
            'film': {'type': 'hdrfilm', 'width': 512, 'height': 256}
    """

    def _setup(self, props: Any) -> None:
        """There is nothing else to set."""

    def _direction(self, u: Any, v: Any, proportion: float) -> tuple[Any, Any]:
        sine, cosine = dr.sincos(v * dr.pi)
        s, c = dr.sincos((u - 0.5) * (2.0 * dr.pi))
        return mi.Vector3f(sine * s, sine * c, cosine), u == u
