"""What an atmosphere and a tolerance need: how many nodes, directions, moments and orders a solve is given.

The rules are measured, not derived: `python -m bench.accuracy` prints what they reach.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from .atmosphere import Atmosphere, Constituent
from .profile import Tabulated

CLOUD = 3.0  # optical depth
DEEP = 8.0  # of what scatters nearly all light: there are
MOST_ALTITUDES, DEEP_ALTITUDES = 48, 64
THICK_DEGREE, DEEP_DEGREE = 16, 24  # of order 1
MANY = 20  # events; light that has as many is lost by what each order lacks
# Few, so that compiled kernels are shared between atmospheres; to degree 24 haze of g = 0.9 has ripple at the horizon.
FIRST_DEGREES = (2, 4, 6, 8, 12, 16, 20, 24, 32)
AIR_MASS = 20.0  # of rays two degrees above the horizon, where light of high degree is needed first
NEAR_GROUND = 1.0  # see Resolution.near_ground
FINER = (0.02, 0.005, 0.002)  # tolerances from which on there are more nodes
# More for derivatives as exact as the light: at least so many degrees and times as many, altitudes, suns.
FINE_DEGREES, FINE_TIMES, FINE_ALTITUDES, FINE_SUNS = 8, 1.3, 8, 20
FINE_NEAR_GROUND, FINE_TWILIGHT, FINE_ORDERS = 3.0, 8.0, 2  # see Resolution; azimuthal orders more
FINE_DIRECTIONS = 13  # at least, to either side of the horizon, less 2 below it
# Optical depth of aerosols up to which light that meets them twice needs no more, where there are more than a few.
CLEAR, FEW_ORDERS = 0.025, 4
REMEMBERED = 64  # phase functions whose moments are kept
REACH_DEGREE = 40  # of the moments that are kept, unless more are asked for


@dataclass(frozen=True)
class Stage:
    """Directions and azimuths (of the half circle) at a node for an order of scattering, and the moments that result:
    degrees up to ``degree``, azimuthal orders up to ``most``."""

    degree: int
    most: int
    up: int
    down: int
    azimuths: int


@dataclass(frozen=True)
class Resolution:
    """Numbers of nodes, directions and moments of a solve.

    ``altitudes``, ``suns``: nodes solved for; ``first_suns``: times as many suns for order 1; ``refine``,
    ``sun_refine``: parts into which cubic interpolation divides every interval of altitudes and suns for look-ups.
    ``stages``: how orders 2, 3, ... are solved, the last serves all that follow; ``nodes``: Gauss points per piece of
    their paths. ``first_*``: the same for order 1, whose forward peak is sharper; ``phase_degree``: that of the phase
    functions there; ``beam_*``: altitude levels per interval, azimuths and Gauss points at which sunlight is followed,
    phase functions apart.
    ``orders``: most orders solved one by one, before all that follow are at once (remainder.py); fewer where the sum is
    steady to ``converged`` times the tolerance. ``columns``: size of the sun-column table (altitudes, cosines).
    ``near_ground``: so many times as many altitudes as follow a constituent are spread evenly over the logarithm of
    the altitude, but for clouds, whose light passes the top; ``absorbers``: and so many times as many follow each that
    only absorbs, whose light changes where the layer has corners; ``twilight``: so many times closer, plus one, sun
    nodes lie then than by day; ``twice``: derivatives ask for the field at two places of every piece of a ray.
    ``deep``: altitudes are denser at the top than at the bottom: all the light of a white cloud passes there twice.
    """

    altitudes: int = 12
    suns: int = 25
    refine: int = 2
    sun_refine: int = 4
    first_suns: int = 1
    stages: tuple[Stage, ...] = (Stage(4, 4, 6, 4, 6),)
    nodes: int = 2
    first_up: int = 10
    first_down: int = 8
    first_azimuths: int = 14
    first_degree: int = 12
    phase_degree: int = 16
    beam_refine: int = 2
    beam_azimuths: int = 4
    beam_nodes: int = 2
    orders: int = 40
    converged: float = 1.0
    columns: tuple[int, int] = (128, 96)
    deep: bool = False
    near_ground: float = 0.0
    absorbers: float = 0.0
    twilight: float = 4.0
    twice: bool = False

    @property
    def degrees(self) -> tuple[int, ...]:
        """Degrees of phase moments that are asked for: by a solve one more than those of the moments of light."""
        return tuple(sorted({self.first_degree, self.first_degree + 1, *(stage.degree + 1 for stage in self.stages)}))

    @classmethod
    def suited(
        cls, atmosphere: Atmosphere, tolerance: float, *, fine: bool = False, air_mass: float = AIR_MASS
    ) -> Resolution:
        """The resolution for an atmosphere at a relative tolerance (0.01: one per cent).

        Degrees follow from how fast the moments of the phase functions fade, weighed by how much of the light those
        particles scatter. ``fine``: the one whose derivatives are within the tolerance too. That of g^l, l g^(l - 1),
        fades later, and the derivative of an order's moments beyond its degrees is not that of order 1's; so all
        orders have all degrees, and two azimuthal orders more, but for orders above 2 where aerosols are thin.
        Altitudes are denser near the ground and where air only absorbs, suns at twilight, look-ups have twice as many
        levels, and rays ask for the field twice a piece.
        ``air_mass``: of the longest view and of the lowest sun, for a sky of which only that is asked: high views need
        fewer degrees.
        """
        # So many orders that no single one keeps its direction, and that what each lacks is lost once for each.
        thick = float(np.max(_depth(atmosphere))) > CLOUD
        first = _degree(atmosphere, 1, 2, 0.5 * tolerance, air_mass)
        # What later orders lack shows along the horizon; the power is what `python -m bench.fits kider` bears.
        least = (0.01 if thick else 0.1) * tolerance * (AIR_MASS / air_mass) ** 0.5
        later = min(_degree(atmosphere, 2, 3, least, air_mass), first)
        deep = float(np.max(np.multiply(*_scattering(atmosphere)))) > DEEP
        if thick:
            first, later = min(first, DEEP_DEGREE if deep else THICK_DEGREE), min(later, 8)
        first = next(degree for degree in FIRST_DEGREES if degree >= first)
        stages = [_stage(later), _stage((3 * later) // 4)]
        level = int(np.searchsorted(-np.array(FINER), -tolerance))
        altitudes = (8, 10, 12, 16)[level]
        if fine:
            needed = max(first + FINE_DEGREES, FINE_TIMES * first)
            first = next((degree for degree in FIRST_DEGREES if degree >= needed), FIRST_DEGREES[-1])
            up = max(FINE_DIRECTIONS, 2 * first // 3)
            most = stages[0].most + FINE_ORDERS
            stages = [replace(stages[0], degree=first, most=most, azimuths=most + 1, up=up, down=up - 2)]
            if most > FEW_ORDERS and _haze(atmosphere) < CLEAR:
                stages.append(replace(stages[0], most=most - FINE_ORDERS, azimuths=most - FINE_ORDERS + 1))
            altitudes += FINE_ALTITUDES
        return cls(
            altitudes=_altitudes(atmosphere, altitudes, thick, deep),
            deep=deep,
            near_ground=FINE_NEAR_GROUND if fine else 0.0 if thick else NEAR_GROUND,
            absorbers=1.0 if fine else 0.0,
            twice=fine,
            refine=4 if fine else 2,
            twilight=FINE_TWILIGHT if fine else 4.0,
            suns=(21, 25, 29, 33)[level] + (FINE_SUNS if fine else 0),
            first_suns=2 if fine else (1, 2, 2, 2)[level],
            nodes=4 if thick else 2,
            stages=tuple(dict.fromkeys(stages)),
            first_up=max(10, first),
            first_down=max(8, first - 2),
            first_azimuths=first + 4,
            first_degree=first,
            # Two levels leave 3 % of the light that twilight brings to the ground of a small planet.
            beam_refine=(2, 3, 3, 3)[level],
            columns=_columns(atmosphere, fine),
            # As many as the azimuths tell apart when what they see is projected on the first ones.
            phase_degree=max(16, first + 8),
        )


def _haze(atmosphere: Atmosphere) -> float:
    """Vertical optical depth that scatters in aerosols, the largest of all wavelengths."""
    depths = (c.scattering_per_m * column_of(atmosphere, c) for c in atmosphere.mie)
    return float(np.max(sum(depths, start=np.zeros(1))))


def _columns(atmosphere: Atmosphere, fine: bool) -> tuple[int, int]:
    """Size of the table of columns to the sun, which is linear between its rows in the distance to the break above.

    Derivatives by profiles see that it is; and light behind an optical depth of 10 is off by ten times as much as the
    column, which a tabulated density, falling linearly over a shell of any thickness, bends more than others do.
    """
    tabulated = any(isinstance(c.profile, Tabulated) for c in atmosphere.constituents)
    return (512 if tabulated else 384 if fine else 128), (192 if fine else 96)


def _stage(degree: int) -> Stage:
    """Directions for moments up to ``degree``, made even: light varies less with azimuth than with the angle from
    the zenith, which has the horizon in it."""
    degree = max(2, degree + degree % 2)
    most = max(2, (degree + 2) // 4 * 2)
    return Stage(degree, most, max(5, degree + 2), max(3, degree), most + 1 + (most == 2))


def _degree(atmosphere: Atmosphere, events: int, power: int, target: float, air_mass: float) -> int:
    """Smallest degree >= 2 beyond which share^events * |chi_l|^power * sqrt(2 l + 1) stays below ``target`` for every
    scatterer; at most the largest offered."""
    needed = 2
    for constituent in atmosphere.constituents:
        if constituent.phase is None:
            continue
        # How much of the light they meet these particles scatter.
        depth = constituent.scattering_per_m * column_of(atmosphere, constituent)
        share = -np.expm1(-air_mass * depth) * constituent.single_scattering_albedo
        shares: dict[Any, float] = {}
        for wavelength, part in enumerate(share.tolist()):
            phase = constituent.phase.at(wavelength)
            shares[phase] = max(part, shares.get(phase, 0.0))
        for phase, part in shares.items():
            chi = np.abs(moments_of(phase, FIRST_DEGREES[-1]))
            above = np.flatnonzero(part**events * chi**power * np.sqrt(2.0 * np.arange(len(chi)) + 1.0) > target)
            needed = max(needed, int(above[-1]) if len(above) else 0)
    return needed


def moments_of(phase: Any, degree: int) -> np.ndarray:
    """Legendre moments of a phase function at one wavelength, kept."""
    key = (type(phase), float(phase.g)) if hasattr(phase, "g") else phase
    if key not in _moments or len(_moments[key]) <= degree:
        while len(_moments) >= REMEMBERED:
            _moments.pop(next(iter(_moments)))
        _moments[key] = np.asarray(phase.moments(max(REACH_DEGREE, degree)))
    return _moments[key][: degree + 1]


_moments: dict[Any, np.ndarray] = {}


def _altitudes(atmosphere: Atmosphere, clear: int, thick: bool, deep: bool) -> int:
    """Node altitudes: more where the air is thick and scatters, in steps of four so that kernels are shared; up to
    twice as many more in ``thick`` air, where what each order lacks adds up unless light is absorbed first."""
    scattering, white = _scattering(atmosphere)
    per_doubling = 8.0 * (1.0 + thick * white)
    extra = float(np.max(per_doubling * np.log2(1.0 + np.maximum(scattering - 0.3, 0.0) / 2.0)))
    return DEEP_ALTITUDES if deep else min(clear + 4 * int(np.ceil(extra / 4.0)), MOST_ALTITUDES)


def _scattering(atmosphere: Atmosphere) -> tuple[np.ndarray, np.ndarray]:
    """Vertical optical depth of what scatters [W], and the part of the light that is left after MANY events."""
    depths = (c.scattering_per_m * column_of(atmosphere, c) for c in atmosphere.constituents)
    scattering, depth = sum(depths, start=np.zeros(1)), _depth(atmosphere)
    return scattering, np.divide(scattering, depth, out=np.zeros(depth.shape), where=depth > 0.0) ** MANY


def _depth(atmosphere: Atmosphere) -> np.ndarray:
    """Vertical optical depth [W]."""
    return sum((c.extinction_per_m * column_of(atmosphere, c) for c in atmosphere.constituents), start=np.zeros(1))


def column_of(atmosphere: Atmosphere, constituent: Constituent) -> float:
    """Vertical column (m) of a constituent's density."""
    return _column(constituent.profile, atmosphere.thickness_m)


@lru_cache(maxsize=64)
def _column(profile: Any, thickness_m: float) -> float:
    h = thickness_m * np.linspace(0.0, 1.0, 4097) ** 3
    return float(np.trapezoid(np.asarray(profile.density(h)), h))
