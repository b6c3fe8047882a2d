"""Derivatives of the sky with respect to everything it depends on.

>>> import atmo_jit
>>> views = {"altitude_m": 0.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0], "azimuth_deg": 90.0}
>>> at_earth = atmo_jit.linearize("earth", views)
>>> at_earth.jacobian(["mie.scattering_per_m", "mie.phase.g"])["mie.phase.g"].shape  # views, wavelengths
(2, 3)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from ._trees import flat, like
from .atmosphere import Atmosphere
from .backend import doubles, floats, one_at_a_time
from .errors import InputError
from .evaluation import OUTPUTS, Evaluation, TableEvaluation, where
from .grid import Grid
from .needs import Needs, suns_to_solve
from .optics import Optics, on_device
from .parameters import (
    RADII,
    VIEWS,
    check_names,
    described,
    directions,
    per_wavelength,
    replaced,
    tangent,
)
from .pieces import Pieces
from .resolution import Resolution
from .solved import Sky
from .views import check_views

GEOMETRY = ("radius", "thickness")  # of Optics.values, and
SHAPE = ("profiles", "sun_radius")  # with these, nothing that is kept with a grid serves
PROFILE = ("scale_height_m", "center_m", "half_width_m")
MANY = 1024  # views from which on it is worth to see whether they make a table
RADIUS_STEP = 5e-3  # of the planet's radius, and
THICKNESS_STEP = 2e-2  # of its atmosphere's thickness: the light is nearly linear over them


class Linearization:
    """The sky of an atmosphere for a list of views, and its derivatives there.

    ``value``: what sky returns, by name: radiance, transmittance, sun_irradiance, sky_irradiance, float32 [N, W].
    ``fine``: solved so finely that derivatives are as exact as the light is without it, at several times the cost
    (docs/method.md has figures); without it those by an aerosol, near the horizon or where they are small, are some per
    cent off, which is enough for a fit. ``resolution`` goes before it.
    """

    def __init__(
        self,
        atmosphere: Any,
        views: Mapping[str, Any],
        *,
        tolerance: float = 0.01,
        orders: int | None = None,
        ground: bool = True,
        sun_disc: bool = False,
        resolution: Resolution | None = None,
        layout: Atmosphere | None = None,
        fine: bool = False,
    ) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)
        self._fine = fine
        self.views = check_views(views)
        self._options = {"ground": ground, "sun_disc": sun_disc}
        self._solving = {"orders": orders, "tolerance": tolerance}
        too = [c.name for c in self.atmosphere.constituents]
        finer = {"sure": True, "fine": fine, "scattering_too": too}
        resolution = resolution or Resolution.suited(self.atmosphere, tolerance, fine=fine)
        suns = self._suns(resolution) if fine else None
        self.sky = Sky(self.atmosphere, orders, tolerance, resolution, suns, layout, **finer)
        r = self.sky.resolution
        self._degrees, self._phase_degree = r.degrees, r.phase_degree

    def _suns(self, resolution: Resolution) -> tuple[float, float] | None:
        """The range of suns (radians) that are solved: fine solves have many, and views seldom many suns."""
        needs = Needs.of_views(self.atmosphere, self.views)
        suns, _ = suns_to_solve(self.atmosphere, needs, resolution)
        return suns and (float(np.radians(suns[0])), float(np.radians(suns[1])))

    def moved(self, parameters: Mapping[str, Any]) -> Linearization:
        """The linearization where parameters, arrays by name, have other values.

        On the same nodes as long as they suit, so that it changes smoothly with the parameters, as a fit wants it.
        Raises what Linearization raises, and InputError for an unknown name.
        """
        options: dict[str, Any] = {**self._solving, **self._options, "fine": self._fine}
        there, views = replaced(self.atmosphere, self.views, parameters)
        needed = Resolution.suited(there, options["tolerance"], fine=self._fine)
        if needed.first_degree <= self.sky.resolution.first_degree and Grid.suits(self.sky.layout, there):
            options |= {"resolution": self.sky.resolution, "layout": self.sky.layout}
        return Linearization(there, views, **options)

    @property
    def rays(self) -> int:
        """N, the number of views."""
        return len(self.views["altitude_m"])

    @cached_property
    def value(self) -> dict[str, np.ndarray]:
        """See the class."""
        evaluation, arguments = self._evaluating(by_views=False)
        return self._arrays(evaluation(self._made, *arguments))

    @one_at_a_time
    def jacobian(self, names: Sequence[str], output: str = "radiance") -> dict[str, np.ndarray]:
        """Derivatives of one output by name: [N, W]; [N, W, n] for the n nodes of a profile.

        Where the description has one number per wavelength, entry [i, w] is by the number of wavelength w: no other
        matters there. Angles of views are in degrees, as their names say. Raises InputError for an unknown name.
        """
        names = check_names(self.atmosphere, names, self.views)
        seeds = [
            (name, direction)
            for name in names
            if name not in RADII
            for direction in ([1.0] if name in VIEWS else directions(self.atmosphere, name))
        ]
        columns: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for (name, _), column in zip(seeds, self._forward(seeds), strict=True):
            columns[name].append(column[output])
        for name in set(names) & set(RADII):
            columns[name].append(self._by_radius(name)[output])
        return {
            name: np.stack(parts, axis=-1) if ".profile." in name else parts[0] for name, parts in columns.items()
        }

    @one_at_a_time
    def jvp(self, changes: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Changes of all outputs, [N, W] by name, along changes of parameters (each of the shape of its parameter, or
        one number for all of it). Raises InputError for an unknown name."""
        names = check_names(self.atmosphere, tuple(changes), self.views)
        total = {output: np.zeros(values.shape) for output, values in self.value.items()}
        for name in set(names) & set(RADII):
            total = {o: total[o] + float(changes[name]) * v for o, v in self._by_radius(name).items()}
        seeds = [(name, changes[name]) for name in names if name not in RADII and np.any(changes[name])]
        if seeds:
            total = {o: total[o] + v for o, v in self._along(seeds).items()}
        return total

    @one_at_a_time
    def vjp(self, cotangents: Mapping[str, Any], names: Sequence[str]) -> dict[str, np.ndarray]:
        """Derivatives of sum(cotangents[output] * output) over the named outputs, by name, in reverse: one pass for
        all, each of the shape of its parameter.

        ``cotangents``: arrays [N, W] by output. Raises InputError for an unknown name.
        """
        names = check_names(self.atmosphere, names, self.views)
        unknown = [name for name in cotangents if name not in OUTPUTS]
        if unknown:
            raise InputError(f"cotangents: {unknown[0]!r} is no output; allowed are {', '.join(OUTPUTS)}")
        shape = self.rays, len(self.atmosphere.wavelengths_nm)
        given = {name: np.broadcast_to(np.asarray(c, np.float32), shape) for name, c in cotangents.items() if np.any(c)}
        # An output without weight is not followed back.
        weights = {name: given[name] for name in OUTPUTS if name in given} or {OUTPUTS[0]: np.zeros(shape, np.float32)}
        of_values = sorted({group for name in names for group in self._groups(name)})
        of_views = sorted(set(names) & set(VIEWS))
        adjoints: tuple[Any, Any] = [], {}
        if of_values or of_views:
            columns = {name: [floats(column) for column in of_output.T] for name, of_output in weights.items()}
            evaluation, arguments = self._evaluating(by_views=bool(of_views))
            adjoints = evaluation.reverse(self._made, *arguments, columns, of_values, of_views)
        # While the kernels run.
        steps = {name: self._steps(name) for name in names if name not in RADII and name not in VIEWS}
        by_views = {name: [part.numpy() for part in adjoints[1][name]] for name in of_views}
        found = {name: np.concatenate(parts)[: self.rays] for name, parts in by_views.items()}
        host = [_leaves(*both) for both in zip(self._numbers, adjoints[0], strict=False)]
        for name in names:
            if name in RADII:
                change = self._by_radius(name)
                found[name] = np.sum([np.vdot(w, change[o]) for o, w in weights.items()])
            elif name not in VIEWS:
                found[name] = self._pulled_back(name, steps[name], host)
        return found

    def _steps(self, name: str) -> list[dict[int, Any]]:
        """How the numbers of every band change with a parameter: those leaves that do, by their places.

        Channels do not mix between a parameter and the numbers, nor do nodes of a profile: one step of all of them
        serves each.
        """
        along = np.ones_like(described(self.atmosphere, name))
        bands = [tangent(optics, name, along, self._degrees, self._phase_degree) for optics in self._optics]
        return [{place: step for place, step in enumerate(steps) if _any(step)} for steps in bands]

    def _pulled_back(self, name: str, of_bands: list[dict[int, Any]], adjoints: list[list[Any]]) -> np.ndarray:
        """Derivative by a parameter, from how the numbers of every band change with it and the derivatives by those."""
        value = described(self.atmosphere, name)
        nodes, each = ".profile." in name, per_wavelength(self.atmosphere, name)
        found = np.zeros(np.shape(value))
        for optics, channels, steps, adjoint in zip(self._optics, self._channels, of_bands, adjoints, strict=True):
            for place, step in steps.items():
                channel, grad = channels[place], adjoint[place]
                if grad is None:
                    continue
                grad = grad.numpy()
                # Rows of a table may be longer on the device.
                product = step * (grad.reshape(len(step), -1)[:, : step.shape[1]] if np.ndim(step) == 2 else grad)
                if nodes:
                    found += product
                elif not each:
                    found += np.sum(product)
                elif channel is not None:
                    found[optics.indices[channel]] += product[0]
                elif product.ndim == 2:
                    found[optics.indices] += product.sum(axis=0).reshape(-1, optics.channel_count).sum(axis=0)
        return found

    def _groups(self, name: str) -> tuple[str, ...]:
        """The values, by name, that carry derivatives when those by a parameter are asked for.

        All values of a kind together, also those that the parameter does not move: parameters then share kernels.
        """
        if name in VIEWS or name in RADII:
            return ()
        if name == "sun_angular_radius_deg" or name.rpartition(".")[2] in PROFILE or ".profile." in name:
            return SHAPE
        return tuple(n for n in self._numbers[0] if n not in (*SHAPE, *GEOMETRY))

    def gradients(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Derivatives of the radiance, [N, W] each, under the names that files have for them.

        ``d_radiance/NAME``: by a number; ``dlog_radiance/NAME``: by the logarithm of a common factor of all numbers of
        a list. Raises InputError for an unknown name.
        """
        found = {}
        for name, values in self.jacobian(names).items():
            value = 1.0 if name in VIEWS else described(self.atmosphere, name)
            if np.ndim(value):
                values = values @ value if ".profile." in name else values * value
            found[f"{'dlog' if np.ndim(value) else 'd'}_radiance/{name}"] = values.astype(np.float32)
        return found

    # ---- how

    def _by_radius(self, name: str) -> dict[str, np.ndarray]:
        """Central differences of solves: all geometry of a solve is made for one planet, in double precision.

        Two things change with a radius: the curvature and, the other radius being fixed, the thickness of the air.
        """
        air = self.atmosphere
        by_thickness = self._difference(air.thickness_m * THICKNESS_STEP, lambda step: {"top_radius_m": step})
        if name == "top_radius_m":
            return by_thickness
        by_curvature = self._difference(air.bottom_radius_m * RADIUS_STEP, lambda step: dict.fromkeys(RADII, step))
        return {output: by_curvature[output] - by_thickness[output] for output in OUTPUTS}

    def _elsewhere(self, atmosphere: Atmosphere) -> Linearization:
        """The same for another atmosphere."""
        return Linearization(
            atmosphere, self.views, resolution=self.sky.resolution, **self._solving, **self._options
        )

    def _difference(self, step: float, changes: Callable[[float], dict[str, float]]) -> dict[str, np.ndarray]:
        ends = []
        for sign in (1.0, -1.0):
            moved = {name: getattr(self.atmosphere, name) + s for name, s in changes(sign * step).items()}
            ends.append(self._elsewhere(self.atmosphere.replace(moved)).value)
        return {output: (ends[0][output] - ends[1][output]) / (2.0 * step) for output in OUTPUTS}

    @cached_property
    def _numbers(self) -> list[dict[str, Any]]:
        return [optics.numbers(optics.atmosphere, self._degrees, self._phase_degree) for optics in self._optics]

    @cached_property
    def _channels(self) -> list[list[int | None]]:
        return [optics.channels(numbers) for optics, numbers in zip(self._optics, self._numbers, strict=True)]

    @cached_property
    def _made(self) -> list[dict[str, Any]]:
        return [on_device(part) for part in self._numbers]

    @property
    def _optics(self) -> list[Optics]:
        return [band.optics for band in self.sky.solutions]

    @property
    def _solved(self) -> list[dict[str, Any]]:
        """What is taken over from the solve, per band."""
        bands = self.sky.solutions
        return [{"shares": b.field.shares, "columns": b.columns.table, "known": b.field.known} for b in bands]

    @cached_property
    def _arguments(self) -> tuple[Any, ...]:
        """What Evaluation takes beside values: views, pieces of their rays, what is taken over from the solve."""
        views = {name: doubles(values) for name, values in self.views.items()}
        rays, _, _ = self.sky.enter(*where(views))
        pieces = [Pieces.of(optics, rays, fine=self.sky.resolution.twice) for optics in self._optics]
        return views, pieces, self._solved

    @cached_property
    def _product(self) -> tuple[np.ndarray, np.ndarray] | None:
        """View zenith angles and azimuths (degrees) of many views that are all combinations of the two, row by row,
        seen from one place under one sun; None: they are not."""
        views = self.views
        single = all(np.ptp(views[name]) == 0.0 for name in VIEWS[:2])
        inside = views["altitude_m"][0] <= self.atmosphere.thickness_m
        if self.rays < MANY or "distance_m" in views or self._options["sun_disc"] or not (single and inside):
            return None
        zenith, azimuth = views["view_zenith_deg"], views["azimuth_deg"]
        count = int(np.argmax(zenith != zenith[0])) or self.rays
        rows = zenith[::count]
        if self.rays % count or not np.array_equal(zenith, np.repeat(rows, count)):
            return None
        return (rows, azimuth[:count]) if np.array_equal(azimuth, np.tile(azimuth[:count], len(rows))) else None

    def _evaluating(self, *, by_views: bool) -> tuple[Any, tuple[Any, ...]]:
        """What evaluates the sky, and its arguments beside values."""
        if by_views or self._product is None:
            return self._evaluation, self._arguments
        views = {name: doubles(values[:1]) for name, values in self.views.items()}
        place = (self.views["altitude_m"][0], np.radians(self.views["sun_zenith_deg"][0]))
        table = TableEvaluation(self.sky, self._options, *place, *map(np.radians, self._product))
        return table, (views, None, self._solved)

    @cached_property
    def _evaluation(self) -> Evaluation:
        views, pieces, solved = self._arguments
        sizes = [dr.width(views["altitude_m"]), *(part and part.count for part in pieces)]
        sizes += [len(band["shares"]) for band in solved]
        key = [tuple(views), *sizes, *self._options.values(), *self._solving.values()]
        key += [(optics.make_up, optics.phase_kinds) for optics in self._optics]
        return self.sky.grid.kept(("evaluation", *key), lambda: Evaluation(self.sky, self._options))

    def _arrays(self, outputs: list[Any]) -> dict[str, np.ndarray]:
        stacked = np.stack([v.numpy() for v in outputs], axis=-1)
        return dict(zip(OUTPUTS, np.split(stacked, len(OUTPUTS), axis=-1), strict=True))

    def _forward(self, seeds: list[tuple[str, Any]]) -> list[dict[str, np.ndarray]]:
        """The derivative of all outputs along every seed, a name and a direction."""
        return [self._along([seed]) for seed in seeds]

    def _along(self, seeds: list[tuple[str, Any]]) -> dict[str, np.ndarray]:
        """The derivative of all outputs along the sum of the seeds, names and directions."""
        views, groups = None, sorted({group for name, _ in seeds for group in self._groups(name)})
        if any(name in VIEWS for name, _ in seeds):
            given = dict(seeds)
            views = {n: doubles(np.broadcast_to(given.get(n, 0.0), v.shape)) for n, v in self.views.items()}
        values = [] if groups else None
        for optics, numbers in zip(self._optics, self._numbers, strict=True) if groups else ():
            own = [(name, direction) for name, direction in seeds if name not in VIEWS]
            parts = [tangent(optics, *seed, self._degrees, self._phase_degree) for seed in own]
            steps = like(numbers, [sum(leaves) for leaves in zip(*parts, strict=True)])
            values.append(on_device({group: steps[group] for group in groups}))
        evaluation, arguments = self._evaluating(by_views=views is not None)
        outputs, changes = evaluation.forward(self._made, *arguments, values, views)
        self.__dict__.setdefault("value", self._arrays(outputs))
        return self._arrays(changes)


def _any(step: Any) -> bool:
    """Whether a number, or any of an array, is not 0."""
    return step != 0.0 if isinstance(step, float) else bool(step.any())


def _leaves(numbers: dict[str, Any], adjoint: dict[str, Any]) -> list[Any]:
    """Derivatives by all ``numbers`` of a band, given those by some groups of them; None: there is none."""
    found: list[Any] = []
    for group, part in numbers.items():
        found += flat(adjoint[group]) if group in adjoint else [None] * len(flat(part))
    return found


def linearize(atmosphere: Any, views: Mapping[str, Any], **options: Any) -> Linearization:
    """The sky and its derivatives at an atmosphere, for a list of views: see Linearization, which takes the same."""
    return Linearization(atmosphere, views, **options)


def jacobian(
    atmosphere: Any, views: Mapping[str, Any], names: Sequence[str], **options: Any
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Radiance [N, W] and its derivatives by name (Linearization.jacobian)."""
    at = Linearization(atmosphere, views, **options)
    return at.value["radiance"], at.jacobian(names)
