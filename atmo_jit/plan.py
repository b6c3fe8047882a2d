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

from . import plan_items
from .atmosphere import Atmosphere
from .costs import Cost, predict
from .errors import InputError
from .needs import TABLE_NODES, Needs, suns_to_solve
from .plan_items import Item
from .resolution import Resolution

if TYPE_CHECKING:
    from .solved import Sky

# Prediction and measurement may differ by this factor before it is said.
OFF = 2.0
SAMPLE, FINEST = 500, 1e-3  # views at which errors are looked at, least tolerance of what they are compared with


@dataclass(frozen=True)
class Plan:
    """What will be done.

    ``atmosphere``: the one asked for, without what adds nothing to the light; ``resolution`` and ``orders`` of its
    solve; ``method``: "march" every ray, or "tables" (one table of the sky, then look-ups); ``suns_deg``: sun zenith
    angles at which the field is looked up; ``solved_suns_deg``: range of suns at the observers that is solved (None:
    all); ``derivatives``: which parts of the solve carry them; ``predicted`` cost.
    """

    atmosphere: Atmosphere
    needs: Needs
    tolerance: float
    orders: int | None
    resolution: Resolution
    method: str
    suns_deg: tuple[float, float]
    solved_suns_deg: tuple[float, float] | None
    derivatives: tuple[str, ...]
    items: tuple[Item, ...]
    predicted: Cost

    def solve(self, atmosphere: Atmosphere | None = None) -> Sky:
        """The sky as planned; of another ``atmosphere`` with other values, where one is given."""
        from .solved import Sky

        suns = None if self.solved_suns_deg is None else tuple(np.radians(self.solved_suns_deg).tolist())
        return Sky(atmosphere or self.atmosphere, self.orders, self.tolerance, self.resolution, suns)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the atmosphere, as JSON takes it."""
        return {
            "tolerance": self.tolerance,
            "orders": self.orders,
            "method": self.method,
            "suns_deg": list(self.suns_deg),
            "solved_suns_deg": None if self.solved_suns_deg is None else list(self.solved_suns_deg),
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
    derivatives = plan_items.carried_by(needs.free)
    suns, sun_nodes = suns_to_solve(kept, needs, resolution)
    items = (
        *plan_items.matter(air, kept),
        *plan_items.multiple(kept, resolution, sun_nodes, tolerance, orders),
        *plan_items.reflection(kept, needs, orders, ground),
        *plan_items.places(kept, needs, resolution, sun_nodes),
        *plan_items.looks(kept, needs, tables, marched),
        *plan_items.derivatives(needs.free, derivatives),
    )
    cost = predict(kept, replace(resolution, suns=sun_nodes), tolerance, orders, marched)
    method = "tables" if tables else "march"
    looked_up = needs.air_suns_deg
    return Plan(kept, needs, tolerance, orders, resolution, method, looked_up, suns, derivatives, items, cost)


def compared(predicted: float, measured: float, what: str, unit: str) -> str | None:
    """A line where a prediction is off by more than OFF, else None."""
    if predicted <= 0.0 or measured <= 0.0 or 1.0 / OFF <= measured / predicted <= OFF:
        return None
    return f"{what}: predicted {predicted:.3g} {unit}, found {measured:.3g} {unit}, off by more than {OFF:g}x"


def error_found(made: Plan, views: Mapping[str, np.ndarray]) -> float:
    """How far a plan's radiance is from that of a tolerance ten times as small, 95th percentile in per cent, at some of
    its ``views`` (as from check_views).

    Errors that both solves share are not in it: it is no more than the error that ``predicted`` means.
    """
    from .backend import doubles
    from .bake.error import compare
    from .solved import Sky

    count = len(views["altitude_m"])
    sample = np.random.default_rng(0).permutation(count)[:SAMPLE]
    some = {name: values[sample] for name, values in views.items()}
    columns = [doubles(some["altitude_m"])]
    columns += [doubles(np.radians(some[name])) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
    columns += [doubles(some["distance_m"])] if "distance_m" in some else []
    finer = Sky(made.atmosphere, made.orders, max(0.1 * made.tolerance, FINEST))
    found, exact = (sky.rays(*columns).radiance for sky in (made.solve(), finer))
    return 100.0 * compare(found, exact, {}).p95


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


def _pays(needs: Needs) -> bool:
    """Whether one table of the sky costs less than a march for every view."""
    return needs.one_sky and not needs.stops and (needs.table or needs.views > TABLE_NODES)
