"""What a scene or a list of views needs, decided before anything is solved: what is built, at what size, what is
skipped and why, and what it will cost.

    needs = Needs.of_views(atmosphere, views, free=["mie.phase.g"])
    made = plan(atmosphere, needs, tolerance=0.01)
    for item in made.items:
        print(item.name, item.size if item.built else "skipped", item.reason)
    sky = made.solve()

A skip never changes the result beyond rounding: what is left out would have added nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .atmosphere import Atmosphere
from .costs import Cost, band_sizes, orders_expected, predict
from .errors import InputError
from .harmonics import pair_count
from .resolution import Resolution

if TYPE_CHECKING:
    from .sky import Sky

# Views of one observer and one sun from which a table of the sky pays: it has this many nodes, each a march.
TABLE_NODES = 14_162
# Prediction and measurement may differ by this factor before it is said.
OFF = 2.0


@dataclass(frozen=True)
class Needs:
    """What is asked. Ranges are (lowest, highest).

    ``views``: number of rays; ``altitudes_m`` of the observers, ``suns_deg``: sun zenith angles there;
    ``air_suns_deg``: sun zenith angles along the rays, inside the air; ``to_space``: some ray leaves for space,
    ``to_ground``: some ray meets the ground, ``stops``: some ray ends before either; ``disc``: the sun's disc is asked
    for and up, or in some view; ``disc_seen``: it is in the picture, not only its light; ``table``: a client asks for
    the table of one observer's sky; ``free``: dotted names whose derivatives are asked.
    """

    views: int
    altitudes_m: tuple[float, float]
    suns_deg: tuple[float, float]
    air_suns_deg: tuple[float, float]
    to_space: bool
    to_ground: bool
    stops: bool
    disc: bool
    disc_seen: bool = False
    table: bool = False
    free: tuple[str, ...] = ()

    @classmethod
    def of_views(
        cls, atmosphere: Any, views: Mapping[str, Any], *, sun_disc: bool = False, free: Sequence[str] = ()
    ) -> Needs:
        """What a list of views (atmo_jit.views) asks; ``sun_disc``: whether discs are wanted where views meet them."""
        from .views import check_views

        air, checked = Atmosphere.load(atmosphere), check_views(views)
        h = checked["altitude_m"]
        s, v, a = (np.radians(checked[name]) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg"))
        mu, mu_s = np.cos(v), np.cos(s)
        nu = mu * mu_s + np.sin(v) * np.sin(s) * np.cos(a)
        enter, leave, ground = _inside(air, h, mu)
        distance = checked.get("distance_m", np.full_like(h, np.inf))
        stops = distance < leave
        end = np.minimum(leave, np.maximum(distance, enter))
        r = air.bottom_radius_m + h
        along = enter + (end - enter) * np.linspace(0.0, 1.0, 33)[:, None]
        there = np.sqrt(np.maximum(r * r + along * (2.0 * r * mu + along), air.bottom_radius_m**2))
        suns = np.degrees(np.arccos(np.clip((r * mu_s + along * nu) / there, -1.0, 1.0)))
        meets = leave > enter
        suns = suns[:, meets] if meets.any() else np.degrees(s)[None]
        # Between two of the points it can go beyond both by less than half of the step between them.
        spare = 0.5 * float(np.abs(np.diff(suns, axis=0)).max()) if suns.shape[0] > 1 else 0.0
        disc = sun_disc and bool(np.any(np.arccos(np.clip(nu, -1.0, 1.0)) <= np.radians(air.sun_angular_radius_deg)))
        return cls(
            views=len(h),
            altitudes_m=_range(h),
            suns_deg=_range(np.degrees(s)),
            air_suns_deg=(max(float(suns.min()) - spare, 0.0), min(float(suns.max()) + spare, 180.0)),
            to_space=bool((~ground & ~stops).any()),
            to_ground=bool((ground & ~stops).any()),
            stops=bool((stops & meets).any()),
            disc=disc,
            disc_seen=disc,
            free=tuple(free),
        )

    @classmethod
    def of_observer(
        cls,
        atmosphere: Any,
        altitude_m: float,
        sun_zenith_deg: float,
        *,
        disc: bool = True,
        seen: bool = True,
        free: Sequence[str] = (),
    ) -> Needs:
        """What the table of one observer's whole sky asks: the emitter's way.

        ``disc``: the sun shines on what is there; ``seen``: its disc may be in the picture.
        """
        air = Atmosphere.load(atmosphere)
        zenith = np.linspace(0.0, 180.0, 181)
        azimuth = np.linspace(0.0, 180.0, 19)
        v, a = (grid.ravel() for grid in np.meshgrid(zenith, azimuth))
        views = {"altitude_m": altitude_m, "sun_zenith_deg": sun_zenith_deg, "view_zenith_deg": v, "azimuth_deg": a}
        needs = cls.of_views(air, views, free=free)
        radius = air.bottom_radius_m
        dip = np.degrees(np.arctan2(np.sqrt(altitude_m * (2.0 * radius + altitude_m)), radius))
        up = bool(sun_zenith_deg - air.sun_angular_radius_deg < 90.0 + dip)
        return replace(needs, views=TABLE_NODES, disc=disc and up, disc_seen=seen and disc and up, table=True)


@dataclass(frozen=True)
class Item:
    """One thing that is built or skipped, its size in words, and the reason."""

    name: str
    built: bool
    size: str
    reason: str


@dataclass(frozen=True)
class Plan:
    """What will be done.

    ``atmosphere``: the one asked for, without what adds nothing to the light; ``resolution`` and ``orders`` of its
    solve; ``method``: "march" every ray, or "tables" (one table of the sky, then look-ups); ``suns_deg``: sun zenith
    angles at which the field is looked up; ``derivatives``: which parts of the solve carry them; ``predicted`` cost.
    """

    atmosphere: Atmosphere
    needs: Needs
    tolerance: float
    orders: int | None
    resolution: Resolution
    method: str
    suns_deg: tuple[float, float]
    derivatives: tuple[str, ...]
    items: tuple[Item, ...]
    predicted: Cost

    def solve(self) -> Sky:
        """The sky as planned."""
        from .sky import Sky

        return Sky(self.atmosphere, self.orders, self.tolerance, self.resolution)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the atmosphere, as JSON takes it."""
        return {
            "tolerance": self.tolerance,
            "orders": self.orders,
            "method": self.method,
            "suns_deg": list(self.suns_deg),
            "derivatives": list(self.derivatives),
            "needs": asdict(self.needs),
            "resolution": asdict(self.resolution),
            "items": [asdict(item) for item in self.items],
            "predicted": asdict(self.predicted) | {"cpu_s": self.predicted.cpu_s},
        }


def plan(
    atmosphere: Any, needs: Needs, *, tolerance: float = 0.01, orders: int | None = None, ground: bool = True
) -> Plan:
    """Decide what is built for ``needs``.

    ``tolerance``, ``orders``, ``ground`` as for ``atmo_jit.sky``. Raises InputError for a free parameter that the
    atmosphere does not have, AtmosphereError for a bad atmosphere.
    """
    air = Atmosphere.load(atmosphere)
    if not 0.0 < tolerance < 1.0:
        raise InputError(f"tolerance: is {tolerance!r}; must be a number between 0 and 1")
    if orders is not None and orders < 1:
        raise InputError(f"orders: is {orders!r}; must be a whole number >= 1, or None for all")
    for name in needs.free:
        try:
            air.get(name)
        except InputError:
            raise InputError(f"--free {name}: no value of that name; names are: {', '.join(air.names())}") from None
    kept = _without_nothing(air, needs.free)
    resolution = Resolution.suited(kept, tolerance)
    tables = _pays(needs)
    marched = min(needs.views, TABLE_NODES) if tables else needs.views
    derivatives = _derivatives(needs.free)
    items = (
        *_matter(air, kept),
        *_multiple(kept, resolution, tolerance, orders),
        *_ground(kept, needs, orders, ground),
        *_where(kept, needs, resolution),
        *_views(kept, needs, tables, marched),
        *_derivative_items(needs.free, derivatives),
    )
    cost = predict(kept, resolution, tolerance, orders, marched)
    method = "tables" if tables else "march"
    return Plan(kept, needs, tolerance, orders, resolution, method, needs.air_suns_deg, derivatives, items, cost)


def compared(predicted: float, measured: float, what: str, unit: str) -> str | None:
    """A line where a prediction is off by more than OFF, else None."""
    if predicted <= 0.0 or measured <= 0.0 or 1.0 / OFF <= measured / predicted <= OFF:
        return None
    return f"{what}: predicted {predicted:.3g} {unit}, found {measured:.3g} {unit}, off by more than {OFF:g}x"


# --- what the atmosphere has ---


def _without_nothing(air: Atmosphere, free: Sequence[str]) -> Atmosphere:
    """``air`` without constituents that neither scatter nor absorb, unless a derivative by one of theirs is asked."""

    def empty(name: str) -> bool:
        constituent = next((c for c in air.constituents if c.name == name), None)
        if constituent is None or any(f.startswith(f"{name}.") for f in free):
            return False
        return not np.any(constituent.extinction_per_m > 0.0)

    document = air.to_dict()
    for name in ("rayleigh", "ozone"):
        if document[name] is not None and empty(name):
            document[name] = None
    mie = document["mie"]
    if isinstance(mie, list):
        left = [species for i, species in enumerate(mie) if not empty(f"mie.{i}")]
        # Names count the species: with a derivative by one of them all must stay.
        if len(left) < len(mie) and not any(f.startswith("mie.") for f in free):
            document["mie"] = left or None
    elif mie is not None and empty("mie"):
        document["mie"] = None
    return Atmosphere(document)


def _matter(air: Atmosphere, kept: Atmosphere) -> list[Item]:
    items = []
    there = (
        ("rayleigh", air.rayleigh, kept.rayleigh),
        ("aerosol", air.mie, kept.mie),
        ("ozone", air.ozone, kept.ozone),
    )
    for name, given, left in there:
        if left:
            count = f"{len(left)} species" if name == "aerosol" else "column and coefficients per wavelength"
            items.append(Item(name, True, count, "scatters or absorbs"))
        else:
            reason = "its coefficients are all 0" if given else "the atmosphere has none"
            items.append(Item(name, False, "", reason))
    bands = band_sizes(len(kept.wavelengths_nm))
    size = f"{len(kept.wavelengths_nm)} in {len(bands)} bands of at most {max(bands)}"
    reason = "one number a node, no packets" if bands == [1] else "a band shares geometry and look-ups"
    return [*items, Item("wavelengths", True, size, reason)]


def _multiple(kept: Atmosphere, r: Resolution, tolerance: float, orders: int | None) -> list[Item]:
    later = r.stages[-1]
    suns = f"{r.altitudes} altitudes x {r.suns} suns"
    columns = Item("sun columns", True, f"{r.columns[0]} x {r.columns[1]}", "sunlight anywhere in the air")
    if not any(np.any(c.scattering_per_m > 0) for c in kept.constituents):
        return [columns, Item("multiple scattering", False, "", "nothing in the air scatters")]
    if orders == 1:
        return [columns, Item("multiple scattering", False, "", "only one event is asked for")]
    found = [columns]
    single = [Resolution.suited(_at(kept, w), tolerance) for w in range(len(kept.wavelengths_nm))]
    reason = "aerosol needs moments until its phase function's have faded"
    if not kept.mie:
        reason = "no aerosol: four moments (l = 0; l = 2, m = 0, 1, 2) are exact, odd ones vanish in what scatters"
    size = f"{suns} x {r.first_suns}, l <= {r.first_degree} ({pair_count(r.first_degree)} moments)"
    found.append(Item("moments of order 1", True, size, reason))
    size = f"{suns}, l <= {later.degree} ({pair_count(later.degree)} moments)"
    found.append(Item("moments of later orders", True, size, "each order smooths: fewer moments are left"))
    for nm, one, air in zip(kept.wavelengths_nm, single, (_at(kept, w) for w in range(len(single))), strict=True):
        last = one.stages[-1]
        count = orders or orders_expected(air, tolerance, r.orders)
        size = f"l <= {one.first_degree}, then {last.degree}; {count} orders"
        found.append(Item(f"needed at {nm:g} nm", True, size, "the band is solved with the most that one needs"))
    if orders is None:
        count = orders_expected(kept, tolerance, r.orders)
        found.append(Item("orders", True, f"about {count}", "until their extrapolated sum is steady to the tolerance"))
    else:
        found.append(Item("orders", True, str(orders), "as many as are asked for"))
    return found


def _at(air: Atmosphere, index: int) -> Atmosphere:
    """``air`` at one of its wavelengths."""
    count = len(air.wavelengths_nm)

    def one(node: Any, name: str = "") -> Any:
        if isinstance(node, dict):
            return {k: v if k == "profile" else one(v, k) for k, v in node.items()}
        if isinstance(node, list) and node and isinstance(node[0], dict):
            return [one(v) for v in node]
        if isinstance(node, list) and len(node) == count and name not in ("cos_theta", "values", "moments"):
            return [node[index]] if name == "wavelengths_nm" else node[index]
        return node

    return Atmosphere(one(air.to_dict()))


def _ground(kept: Atmosphere, needs: Needs, orders: int | None, ground: bool) -> list[Item]:
    white = bool(np.any(kept.ground_albedo > 0.0))
    found = []
    if not white:
        found.append(Item("light from the ground", False, "", "the ground is black: it reflects nothing"))
    elif orders == 1:
        found.append(Item("light from the ground", False, "", "what it reflects into the air is a second event"))
    else:
        found.append(Item("light from the ground", True, "in every order", "the ground reflects"))
    if not ground:
        found.append(Item("ground's own radiance", False, "", "not asked for"))
    elif not needs.to_ground:
        found.append(Item("ground's own radiance", False, "", "no view meets the ground"))
    elif not white:
        found.append(Item("ground's own radiance", False, "", "the ground is black"))
    else:
        found.append(Item("ground's own radiance", True, "sun and sky on it", "views meet the ground"))
    return found


# --- where it is looked at ---


def _where(kept: Atmosphere, needs: Needs, r: Resolution) -> list[Item]:
    low, high = needs.altitudes_m
    found = []
    if high <= kept.thickness_m:
        found.append(Item("entry from space", False, "", "every observer is inside the air"))
    else:
        found.append(Item("entry from space", True, "double precision", "observers are above the air"))
    fixed = f"{low:g} m only" if low == high else f"{low:g} to {high:g} m"
    size = f"{r.altitudes} nodes, all altitudes"
    found.append(Item("altitudes", True, size, f"observers: {fixed}; light reaches them from everywhere"))
    a, b = needs.suns_deg
    size = f"{r.suns} nodes"
    where = f"{needs.air_suns_deg[0]:.1f} to {needs.air_suns_deg[1]:.1f} deg along the views"
    reason = f"one sun, {a:g} deg; it is looked up at {where}" if a == b else f"suns {a:g} to {b:g} deg; {where}"
    found.append(Item("sun angles", True, size, reason))
    return found


def _views(kept: Atmosphere, needs: Needs, tables: bool, marched: int) -> list[Item]:
    found = []
    one = needs.altitudes_m[0] == needs.altitudes_m[1] and needs.suns_deg[0] == needs.suns_deg[1]
    if tables:
        found.append(Item("sky-view table", True, f"{TABLE_NODES} directions", "one observer and one sun"))
    elif not one:
        found.append(Item("sky-view table", False, "", "observers or suns differ from view to view"))
    elif needs.stops:
        found.append(Item("sky-view table", False, "", "views stop at their own distances"))
    else:
        reason = f"{needs.views} views are fewer than the {TABLE_NODES} of a table"
        found.append(Item("sky-view table", False, "", reason))
    found.append(Item("march", True, f"{marched} rays", "exact single scattering along each"))
    if needs.stops:
        found.append(Item("aerial perspective", True, "each ray to its distance", "views stop before ground or space"))
    else:
        found.append(Item("aerial perspective", False, "", "no view stops before ground or space"))
    if needs.disc and needs.table:
        seen = "in the picture" if needs.disc_seen else "not in the picture: only its light on things"
        found.append(Item("sun's disc", True, "a table over the disc", seen))
    elif needs.table:
        found.append(Item("sun's disc", False, "", "it has set, or its scale is 0"))
    elif needs.disc and needs.to_space:
        found.append(Item("sun's disc", True, "added to views that meet it", "asked for, and some view meets it"))
    elif not needs.to_space:
        found.append(Item("sun's disc", False, "", "every view ends on something opaque"))
    else:
        found.append(Item("sun's disc", False, "", "not in any view, or not asked for"))
    return found


def _pays(needs: Needs) -> bool:
    """Whether one table of the sky costs less than a march for every view."""
    one = needs.altitudes_m[0] == needs.altitudes_m[1] and needs.suns_deg[0] == needs.suns_deg[1]
    return one and not needs.stops and (needs.table or needs.views > TABLE_NODES)


# --- derivatives ---

# What a parameter enters: the last part of its dotted name -> parts of the solve that carry its derivative.
GEOMETRY = ("columns", "path weights", "order 1", "later orders", "march")
OPTICS = ("path weights", "order 1", "later orders", "march")
_CARRIED = {
    "scattering_per_m": OPTICS,
    "absorption_per_m": OPTICS,
    "single_scattering_albedo": OPTICS,
    "scale_height_m": GEOMETRY,
    "center_m": GEOMETRY,
    "half_width_m": GEOMETRY,
    "density": GEOMETRY,
    "altitude_m": GEOMETRY,
    "bottom_radius_m": GEOMETRY,
    "top_radius_m": GEOMETRY,
    "g": ("order 1", "later orders", "march"),
    "values": ("order 1", "later orders", "march"),
    "moments": ("order 1", "later orders", "march"),
    "ground_albedo": ("order 1", "later orders", "ground"),
    "solar_irradiance": (),
    "sun_angular_radius_deg": ("order 1", "march"),
}


def _derivatives(free: Sequence[str]) -> tuple[str, ...]:
    """The parts of the solve that carry a derivative, in the order in which they run."""
    wanted = {part for name in free for part in _CARRIED.get(name.rpartition(".")[2], GEOMETRY)}
    return tuple(part for part in (*GEOMETRY, "ground") if part in wanted)


def _derivative_items(free: Sequence[str], carried: tuple[str, ...]) -> list[Item]:
    if not free:
        return [Item("derivatives", False, "", "none is asked for")]
    if not carried:
        return [Item("derivatives", False, "", "radiance is linear in what is asked: no tape is needed")]
    left = [part for part in (*GEOMETRY, "ground") if part not in carried]
    found = [Item("derivatives", True, ", ".join(carried), f"by {', '.join(free)}")]
    if left:
        found.append(Item("derivatives", False, ", ".join(left), "none of the free parameters enters there"))
    return found


# --- geometry ---


def _inside(air: Atmosphere, h: np.ndarray, mu: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (m) at which rays enter and leave the air (equal where they miss it), and whether they meet ground."""
    low, top = air.bottom_radius_m, air.top_radius_m
    r = low + h
    above = (r * mu) ** 2 - (h - air.thickness_m) * (r + top)
    below = (r * mu) ** 2 - h * (2.0 * low + h)
    root = np.sqrt(np.maximum(above, 0.0))
    outside = h > air.thickness_m
    meets = ~outside | ((mu < 0.0) & (above > 0.0))
    enter = np.where(meets & outside, -r * mu - root, 0.0)
    ground = meets & (mu < 0.0) & (below >= 0.0)
    leave = np.where(ground, -r * mu - np.sqrt(np.maximum(below, 0.0)), -r * mu + root)
    return enter, np.where(meets, np.maximum(leave, enter), enter), ground


def _range(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
