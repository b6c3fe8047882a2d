"""What a list of views or an observer asks of the air, found from geometry alone, with nothing solved.

    needs = Needs.of_views("earth", views, free=["mie.phase.g"])
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .atmosphere import Atmosphere
from .grid import Grid
from .resolution import Resolution
from .views import check_views

# Views of one observer and one sun from which a table of the sky pays: it has this many nodes, each a march.
TABLE_NODES = 14_162
SUN_STEP_DEG = 2.0  # suns that are solved begin and end at multiples of it: the next sun then finds the same grid


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

    @property
    def one_sky(self) -> bool:
        """Whether all views are of one observer and one sun."""
        return self.altitudes_m[0] == self.altitudes_m[1] and self.suns_deg[0] == self.suns_deg[1]


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


def suns_to_solve(air: Atmosphere, needs: Needs, resolution: Resolution) -> tuple[tuple[float, float] | None, int]:
    """The range of suns to be solved (degrees, at the observers; None: all), and how many nodes that has."""
    # The grid goes on by one dip of the top's horizon to either side. For observers inside the air that is as far as
    # their rays go and light arrives from; from space rays graze the air at both ends of the range.
    inside = needs.altitudes_m[1] <= air.thickness_m
    dip = np.degrees(np.arccos(air.bottom_radius_m / air.top_radius_m)) if inside else 0.0
    low = min(needs.suns_deg[0], needs.air_suns_deg[0] + dip)
    high = max(needs.suns_deg[1], needs.air_suns_deg[1] - dip)
    low = SUN_STEP_DEG * np.floor(max(low, 0.0) / SUN_STEP_DEG)
    high = SUN_STEP_DEG * np.ceil(min(high, 180.0) / SUN_STEP_DEG)
    nodes = Grid.of(air, resolution, tuple(np.radians([low, high]).tolist())).shape[1]
    return (None, resolution.suns) if nodes >= resolution.suns else ((float(low), float(high)), nodes)
