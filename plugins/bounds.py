"""The sphere around the scene, from which particle tracing starts."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# Dr.Jit numbers live objects from 1; the numbers of deleted ones are free until new objects take them.
LONGEST_GAP = 4096


def sphere(scene: Any) -> tuple[Any, float]:
    """Centre and radius of a sphere around ``scene``, or, without one, around all shapes that are loaded in this
    variant.

    A larger sphere than necessary only costs particles that miss. Raises RuntimeError in scalar variants without a
    scene: there is no list of shapes.
    """
    box = mi.ScalarBoundingBox3f()
    if scene is not None:
        box.expand(scene.bbox())
    elif dr.is_jit_v(mi.Float):
        for shape in _shapes():
            box.expand(shape.bbox())
    else:
        raise RuntimeError("atmosphere: call emitter.set_scene(scene) before particles are traced in a scalar variant")
    if not box.valid():
        return mi.ScalarPoint3f(0.0), mi.math.RayEpsilon
    around = box.bounding_sphere()
    return around.center, max(float(around.radius) * (1.0 + mi.math.RayEpsilon), mi.math.RayEpsilon)


def _shapes() -> Any:
    missing, index = 0, 1
    while missing < LONGEST_GAP:
        batch = np.arange(index, index + 1024, dtype=np.uint32)
        pointers = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(batch))
        for i in range(len(batch)):
            try:
                shape = pointers[i]
            except RuntimeError:  # no shape has had this number
                shape = None
            if shape is None:
                missing += 1
            else:
                missing = 0
                yield shape
        index += len(batch)
