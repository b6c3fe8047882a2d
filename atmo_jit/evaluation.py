"""The outputs of a sky as one function that derivatives pass through, recorded where it is asked for again."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import drjit as dr
import numpy as np

from ._trees import flat
from .backend import doubles, evaluated, traversing, types
from .parameters import VIEWS
from .recording import Recordings, copied
from .sky import Sky

OUTPUTS = ("radiance", "transmittance", "sun_irradiance", "sky_irradiance")


class Evaluation:
    """The outputs of a sky as a function of values, views, pieces of their rays, and what the solve left: shares of the
    orders, and tables that are known.

    It and its derivatives are recorded (dr.freeze) where they are asked for more than once: tracing costs several
    times what running does.
    """

    def __init__(self, sky: Sky, options: dict[str, Any]) -> None:
        self._sky, self._options = sky, options
        self._recordings = Recordings(sky.grid)
        self._recorded = all(optics.phase_kinds is not None for optics in (band.optics for band in sky.solutions))

    def __call__(self, *arguments: Any) -> list[Any]:
        """All outputs, one Float [N] each, in the order of OUTPUTS and wavelengths."""
        return self._run("value", self._outputs, *arguments)

    def forward(self, *arguments: Any) -> tuple[list[Any], list[Any]]:
        """Outputs, and how they change along ``values`` and ``views``, the last two arguments (None: not at all)."""
        *_, values, views = arguments
        return self._run(("forward", values and tuple(values[0]), views is None), self._forward, *arguments)

    def reverse(self, *arguments: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
        """Derivatives of the sum of weighted outputs, by the values and views named in the last two arguments; before
        them the weights, W Floats [N] by output."""
        *arrays, of_values, of_views = arguments
        weighted = tuple(arrays[-1])

        def function(values: Any, views: Any, pieces: Any, solved: Any, weights: Any) -> tuple[Any, Any]:
            values, views = copied(values), copied(views)
            wanted = [{name: part[name] for name in of_values} for part in values], {n: views[n] for n in of_views}
            dr.enable_grad(wanted)
            outputs = self._outputs(values, views, pieces, solved, weighted)
            pairs = [(v, w) for v, w in zip(outputs, flat(weights), strict=True) if dr.grad_enabled(v)]
            for output, weight in pairs:
                dr.set_grad(output, weight)
            dr.enqueue(dr.ADMode.Backward, *(output for output, _ in pairs))
            dr.traverse(dr.ADMode.Backward)
            adjoints = dr.grad(wanted)
            dr.eval(adjoints)
            return adjoints

        return self._run(("reverse", weighted, *of_values, *of_views), function, *arrays)

    def _run(self, key: Any, function: Callable[..., Any], *arguments: Any) -> Any:
        with traversing():
            return self._recordings.run(key, function, *arguments) if self._recorded else function(*arguments)

    def _outputs(
        self,
        values: list[Any],
        views: dict[str, Any],
        pieces: list[Any],
        solved: list[Any],
        wanted: Collection[str] = OUTPUTS,
    ) -> list[Any]:
        sky = self._again(values, solved)
        place = where(views)
        light = sky.rays(*place, **self._options, pieces=pieces)
        horizontal = sky.irradiance(*place[:2]) if set(wanted) & set(OUTPUTS[2:]) else ([], [])
        zero = dr.zeros(types().Float, dr.width(place[0]))
        return _wanted(wanted, light.radiance, light.transmittance, *horizontal, zero)

    def _again(self, values: list[Any], solved: list[Any]) -> Sky:
        return self._sky.again(values, *([band[name] for band in solved] for name in ("shares", "known")))

    def _forward(
        self, values: Any, views: Any, pieces: Any, solved: Any, along_values: Any, along_views: Any
    ) -> tuple[list[Any], list[Any]]:
        values, views = copied(values), copied(views)
        pairs = [pair for name in along_views or () for pair in [(views[name], along_views[name])]]
        for made, steps in zip(values, along_values or (), strict=False):
            pairs += [pair for name in steps for pair in zip(flat(made[name]), flat(steps[name]), strict=True)]
        for leaf, _ in pairs:
            dr.enable_grad(leaf)
        outputs = self._outputs(values, views, pieces, solved)
        for leaf, step in pairs:
            dr.set_grad(leaf, step)
        dr.enqueue(dr.ADMode.Forward, *(leaf for leaf, _ in pairs))
        dr.traverse(dr.ADMode.Forward)
        changes = dr.grad(outputs)
        dr.eval(changes)
        return dr.detach(outputs), changes


class TableEvaluation(Evaluation):
    """The same for all combinations of view zenith angles and azimuths (radians) from one place under one sun, far
    faster than ray by ray (bundle.py); not recorded."""

    def __init__(
        self,
        sky: Sky,
        options: dict[str, Any],
        altitude_m: float,
        sun_zenith: float,
        view_zenith: np.ndarray,
        azimuth: np.ndarray,
    ) -> None:
        super().__init__(sky, options)
        self._recorded = False
        self._place, self._view_zenith, self._azimuth = (altitude_m, sun_zenith), view_zenith, azimuth

    def _outputs(
        self,
        values: list[Any],
        views: dict[str, Any],
        pieces: None,
        solved: list[Any],
        wanted: Collection[str] = OUTPUTS,
    ) -> list[Any]:
        t, sky = types(), self._again(values, solved)
        altitude, sun_zenith = self._place
        ground = self._options["ground"]
        light = sky.table(altitude, self._view_zenith, sun_zenith, self._azimuth, ground=ground)
        lane = dr.arange(t.UInt, len(self._view_zenith) * len(self._azimuth))
        rows = lane // len(self._azimuth)
        transmittance = [dr.gather(t.Float, evaluated(v), rows) for v in light.transmittance]
        sun, scattered = sky.irradiance(*(doubles([v]) for v in self._place))
        zero = dr.zeros(t.Float, dr.width(lane))
        return _wanted(wanted, light.radiance, transmittance, sun, scattered, zero)


def _wanted(wanted: Collection[str], *parts: Any) -> list[Any]:
    """The outputs wanted, evaluated together, all as wide as the last of the ``parts``."""
    *groups, zero = parts
    outputs = [v + zero for name, group in zip(OUTPUTS, groups, strict=True) if name in wanted for v in group]
    dr.eval(outputs)
    return outputs


def where(views: dict[str, Any]) -> list[Any]:
    """Arguments of Sky.rays."""
    degree = np.pi / 180.0
    return [views["altitude_m"], *(views[name] * degree for name in VIEWS[1:4]), views.get("distance_m")]
