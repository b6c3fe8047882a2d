"""Light at the nodes of a table of the sky, from the solution.

All of it is geometry and kernels: what a ray scatters, sunlight on the way, later orders, the ground, and how they are
packed into cells. So for one observer they are recorded and played back for the next sun or the next atmosphere with
the same profiles (:mod:`atmo_jit.recording`); tracing them takes several times as long as running them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..backend import floats, one_at_a_time, parameter, types, uints
from ..field import Field
from ..kept import Remembered
from ..phase import Isotropic, RayleighPhase
from ..recording import Recordings
from .cells import Cells
from .mean_source import MeanSourceHere
from .sightlines import Sightlines, padded_channels
from .sunlight import Sunlight

# Quadrature of single scattering per piece of a ray: more where the planet's shadow crosses it, below this sun cosine.
DAY_NODES, TWILIGHT_NODES, TWILIGHT = 3, 10, 0.05
SUNLIGHT = (96, 320)  # size of the table of sunlight: altitudes, sun cosines
REMEMBERED = 3  # observers, of two sets of rays each: as many as ray_pieces remembers


@dataclass
class Nodes:
    """The table's nodes: altitude of the observer (m); unit latitude and cosine of the rows, and which of them look
    above the horizon; cosines of the columns' azimuths and of the sun."""

    h: float
    x: np.ndarray
    mu: np.ndarray
    up: np.ndarray
    cos_phi: np.ndarray
    mu_s: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return len(self.mu), len(self.cos_phi)

    @property
    def sun_row(self) -> int:
        """The row above the horizon that is nearest to the sun's elevation."""
        above = np.flatnonzero(self.up)
        return int(above[np.argmin(np.abs(self.mu[above] - self.mu_s))])

    @property
    def nu(self) -> np.ndarray:
        """Cosine of the angle to the sun, [rows, columns]."""
        sines = np.sqrt((1.0 - self.mu) * (1.0 + self.mu)) * np.sqrt((1.0 - self.mu_s) * (1.0 + self.mu_s))
        return np.clip(self.mu[:, None] * self.mu_s + sines[:, None] * self.cos_phi, -1.0, 1.0)


@dataclass
class NodeLight:
    """Light at the nodes of a table, a Float [rows x columns] per channel: ``smooth`` without the single scattering of
    peaked scatterers; ``peaks``: that, without phase functions, by index of the constituent; ``transmittance``: a
    table [rows, padded channel]."""

    smooth: list[Any]
    peaks: dict[int, list[Any]]
    transmittance: list[Any]


@dataclass
class Baked:
    """What a table holds: ``words`` of its Cells, smooth light per channel and then one mean per peak; ``peaks``:
    indices of their scatterers; ``colours`` of those in the sun's direction, a Float per channel; ``transmittance`` as
    in :class:`NodeLight`."""

    words: Any
    peaks: list[int]
    colours: list[list[Any]]
    transmittance: Any

    @classmethod
    def of(cls, optics: Any, nodes: Nodes, light: NodeLight) -> Baked:
        """What :class:`NodeLight` is packed to."""
        toward_sun = uints([nodes.sun_row * nodes.shape[1]])
        words, colours = packed(optics, nodes, floats(nodes.nu), toward_sun, light)
        return cls(words, list(light.peaks), colours, light.transmittance)


def packed(optics: Any, nodes: Nodes, nu: Any, toward_sun: Any, light: NodeLight) -> tuple[Any, list[list[Any]]]:
    """Words and colours, peaks taken apart as :mod:`.sky_view` says. ``nu``: the angle to the sun's cosine at the
    nodes; ``toward_sun``: number of the node that is nearest to the sun."""
    values, colours, greys = light.smooth, [], []
    for k, single in light.peaks.items():
        grey = sum(single) / optics.channel_count
        in_sun = [dr.gather(types().Float, v, toward_sun) for v in single]
        mean = dr.maximum(sum(in_sun) / optics.channel_count, 1e-30)
        colour = [v / mean for v in in_sun]
        parts = zip(values, single, colour, optics.phase_values(k, nu), strict=True)
        values = [dr.fma(s - grey * shade, phase, v) for v, s, shade, phase in parts]
        colours.append(colour)
        greys.append(grey)
    up = int(np.count_nonzero(nodes.up))
    cells = Cells([*values, *greys], nodes.shape[1], (up, nodes.shape[0] - up))
    dr.eval(colours)
    return cells.words, colours


_known = Remembered(REMEMBERED)


@one_at_a_time
def light_at_nodes(band: Any, nodes: Nodes, ground: bool) -> Baked:
    """Light at the nodes of a table from the solution itself; with the ``ground``'s or not."""
    optics, field, grid = band.optics, band.field, band.field.grid
    quadrature = DAY_NODES if nodes.mu_s > TWILIGHT else TWILIGHT_NODES
    key = (
        *(nodes.h, nodes.x.tobytes(), nodes.up.tobytes(), nodes.cos_phi.tobytes(), ground, quadrature),
        *(optics.make_up, optics.phase_kinds, grid, field.degree, field.scatters, band.columns),
    )
    if optics.phase_kinds is None:  # kernels would hold numbers of the phase functions: nothing to be played back
        return _Observer(band, nodes, ground, quadrature).baked(band, nodes)
    return _known.of(key, lambda: _Observer(band, nodes, ground, quadrature)).baked(band, nodes)


class _Observer:
    """Where the nodes of a table lie and what follows from that alone; and a recording of the rest.

    Many suns are one here, many azimuths along shared rays take their place.
    """

    def __init__(self, band: Any, nodes: Nodes, ground: bool, quadrature: int) -> None:
        self._optics, self._columns, field = band.optics, band.columns, band.field
        self._grid, self._degree, self._scatters = field.grid, field.degree, field.scatters
        self._nodes, self._ground, self._quadrature = nodes, ground, quadrature
        shape = nodes.shape
        self._ray = uints(np.repeat(np.arange(shape[0]), shape[1]))
        self._cos_phi = floats(np.broadcast_to(nodes.cos_phi, shape))
        self._here = None if band.source is None else MeanSourceHere(band, nodes.h, nodes.x, nodes.up)
        self._at: list[Any] = []

    def baked(self, band: Any, nodes: Nodes) -> Baked:
        """The light under the sun of ``nodes``."""
        optics, count = band.optics, self._nodes.shape[0]
        lines = Sightlines(optics, np.full(count, nodes.h), nodes.mu, ground=~nodes.up, nodes=self._quadrature)
        other = self._here and self._here.lines(optics)
        at = [of.at for of in (lines, other) if of]
        if self._at != at:  # with the nodes of other pieces everything has another size
            self._at, self._lines = at, (lines, other)
            self._recordings = Recordings(self._grid, self)
        values = {**optics.used, "moment_tables": {self._degree: optics.phase_moments(self._degree)}}
        sin_s = np.sqrt((1.0 - nodes.mu_s) * (1.0 + nodes.mu_s))
        sun = [parameter(nodes.mu_s), parameter(sin_s), uints([nodes.sun_row * nodes.shape[1]])]
        arguments = (values, band.field.held, lines.through, sun)
        run = self._made if optics.phase_kinds is None else lambda *a: self._recordings.run("light", self._made, *a)
        words, colours = run(*arguments)
        return Baked(words, self._peaks(), colours, padded_channels(lines.transmittance))

    def _peaks(self) -> list[int]:
        return [k for k in self._optics.scatterers if is_peaked(self._optics.constituents[k])]

    def _made(self, values: Any, held: Any, through: Any, sun: list[Any]) -> tuple[Any, list[list[Any]]]:
        """Words and colours from all that changes."""
        t, (mu_s, sin_s, toward_sun) = types(), sun
        optics, columns = self._optics.with_values(values), self._columns
        field = Field.of(optics, columns, self._grid, self._degree, held, scatters=self._scatters)
        field.prepare()
        lines, other = self._lines
        lines = lines.of(optics, through)
        ray = self._ray
        sun, across = mu_s + dr.zeros(t.Float, dr.width(ray)), sin_s * self._cos_phi
        nu = lines.nu(ray, sun, across)
        dr.eval(sun, across, nu)
        smooth = [dr.zeros(t.Float, dr.width(ray)) for _ in range(optics.channel_count)]
        if self._ground:  # only rows below the horizon meet it; they are the last
            first = int(np.count_nonzero(self._nodes.up)) * self._nodes.shape[1]
            below = dr.arange(t.UInt, first, dr.width(ray))
            parts = (dr.gather(type(v), v, below) for v in (ray, sun, across))
            for v, glow in zip(smooth, lines.ground_light(columns, field, *parts), strict=True):
                dr.scatter(v, glow, below)
            dr.eval(smooth)
        if other is not None:
            series = self._here.along(other.of(optics, None), field, mu_s, sin_s, lines.scattering_table)
            smooth = [v + m for v, m in zip(smooth, series.at(ray, self._cos_phi), strict=True)]
        peaks, singles = {}, []
        if optics.scatterers:
            singles = lines.single(Sunlight(optics, columns, SUNLIGHT), ray, sun, across, nu)
        for k, single in zip(optics.scatterers, singles, strict=True):
            if is_peaked(optics.constituents[k]):
                peaks[k] = single
            else:
                values = zip(single, optics.phase_values(k, nu), smooth, strict=True)
                smooth = [dr.fma(s, p, v) for s, p, v in values]
        return packed(optics, self._nodes, nu, toward_sun, NodeLight(smooth, peaks, None))


def is_peaked(constituent: Any) -> bool:
    """Whether a scatterer's phase function is kept out of what is interpolated."""
    return not isinstance(constituent.phase, RayleighPhase | Isotropic)
