"""What is built and what is skipped for a plan, item by item, with the reasons: see :mod:`atmo_jit.plan`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .atmosphere import Atmosphere
from .costs import band_sizes, orders_expected
from .harmonics import pair_count
from .needs import TABLE_NODES, Needs
from .resolution import Resolution


@dataclass(frozen=True)
class Item:
    """One thing that is built or skipped, its size in words, and the reason."""

    name: str
    built: bool
    size: str
    reason: str


def matter(air: Atmosphere, kept: Atmosphere) -> list[Item]:
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


def multiple(
    kept: Atmosphere, r: Resolution, sun_nodes: int, tolerance: float, orders: int | None
) -> list[Item]:
    later = r.stages[-1]
    suns = f"{r.altitudes} altitudes x {sun_nodes} suns"
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


def reflection(kept: Atmosphere, needs: Needs, orders: int | None, ground: bool) -> list[Item]:
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


def places(kept: Atmosphere, needs: Needs, r: Resolution, sun_nodes: int) -> list[Item]:
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
    size = f"{r.suns} nodes" if sun_nodes == r.suns else f"{sun_nodes} of {r.suns} nodes"
    where = f"{needs.air_suns_deg[0]:.1f} to {needs.air_suns_deg[1]:.1f} deg along the views"
    reason = f"one sun, {a:g} deg; it is looked up at {where}" if a == b else f"suns {a:g} to {b:g} deg; {where}"
    found.append(Item("sun angles", True, size, reason))
    return found


def looks(kept: Atmosphere, needs: Needs, tables: bool, marched: int) -> list[Item]:
    found = []
    if tables:
        found.append(Item("sky-view table", True, f"{TABLE_NODES} directions", "one observer and one sun"))
    elif not needs.one_sky:
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


def carried_by(free: Sequence[str]) -> tuple[str, ...]:
    """The parts of the solve that carry a derivative, in the order in which they run."""
    wanted = {part for name in free for part in _CARRIED.get(name.rpartition(".")[2], GEOMETRY)}
    return tuple(part for part in (*GEOMETRY, "ground") if part in wanted)


def derivatives(free: Sequence[str], carried: tuple[str, ...]) -> list[Item]:
    if not free:
        return [Item("derivatives", False, "", "none is asked for")]
    if not carried:
        return [Item("derivatives", False, "", "radiance is linear in what is asked: no tape is needed")]
    left = [part for part in (*GEOMETRY, "ground") if part not in carried]
    found = [Item("derivatives", True, ", ".join(carried), f"by {', '.join(free)}")]
    if left:
        found.append(Item("derivatives", False, ", ".join(left), "none of the free parameters enters there"))
    return found
