"""Which of an atmosphere's wavelengths a path of light has.

Three rules, all of which leave a path with the atmosphere's own wavelengths only, so that nothing is invented in
between:

- ``channels`` (rgb, mono): every channel of the variant is one wavelength. The channels share their paths.
- ``turns`` (spectral): a wavelength of the variant stands for one of its two neighbours in the atmosphere, in turns
  that are much shorter than any spectrum's structure. Their shares are the package's interpolation (linear in
  lambda^-4, see :mod:`atmo_jit.spectrum`), so the mean over wavelengths is that of the interpolated radiance; with
  interpolated coefficients it would not be.
- ``time`` (all variants): every path has one wavelength, chosen by its time: number floor(time * U) of U, with a
  shutter that is open from 0 to 1. The source of light has to be U times what that wavelength contributes to the
  picture, which then is the sum over all.

In the first two the coefficients of a path are chromatic. Mitsuba's integrators then weight paths with exp(-majorant *
distance) over its own value, so a path must end at a surface, else the weight is 0/0: such a medium needs a boundary.
With one wavelength for each path there is no such weight.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import AtmosphereError, shown

RULES = ("channels", "time")
TURNS_PER_NM = 64.0  # a float32 wavelength of 500 nm still resolves 500 steps in a turn


class Wavelengths:
    """The rule for an atmosphere's ``wavelengths_nm`` [W] in the current variant.

    rule: "channels" (in spectral variants: turns) or "time". channels: with "channels", index of the wavelength of
        every channel; None: one for all channels if W is 1, the three of W = 3 in rgb, that nearest to 555 nm in
        mono. With "time", the indices of the wavelengths in use; None: all.

    ``used``: the wavelengths in use. ``rows``: for every choice that :meth:`row` can give, the wavelengths of such a
    path."""

    def __init__(self, wavelengths_nm: np.ndarray, rule: str = "channels", channels: list[int] | None = None) -> None:
        if rule not in RULES:
            raise AtmosphereError("wavelength_rule", shown(rule), f"one of {', '.join(RULES)}")
        self.total = len(wavelengths_nm)
        if channels is not None and not all(0 <= i < self.total for i in channels):
            raise AtmosphereError("channels", shown(channels), f"indices from 0 to {self.total - 1}")
        self.rule = "turns" if mi.is_spectral and rule == "channels" else rule
        self.channels: list[int] = []
        if self.rule == "channels":
            self.channels = self._channels(wavelengths_nm, channels)
            self.used = sorted(set(self.channels))
            self.rows = [tuple(self.used)]
        elif self.rule == "time":
            self.used = list(range(self.total)) if channels is None else sorted(set(channels))
            self.rows = [(w,) for w in self.used]
        else:
            knots = np.asarray(wavelengths_nm, dtype=np.float64) ** -4.0 * 1e11
            self.used = [int(w) for w in np.argsort(knots, kind="stable")]
            self.rows = [tuple(self.used)]
            self.knots = [float(knots[w]) for w in self.used]
        self.table = mi.UInt32(self.used) if dr.is_jit_v(mi.Float) else self.used

    def _channels(self, wavelengths_nm: np.ndarray, given: list[int] | None) -> list[int]:
        size = len(mi.UnpolarizedSpectrum(0.0))
        if given is None:
            if self.total == 1:
                return [0] * size
            if size == 1:
                return [int(np.argmin(np.abs(wavelengths_nm - 555.0)))]
            if self.total == size:
                return list(range(size))
            raise AtmosphereError("channels", "nothing", f"{size} of the indices 0 to {self.total - 1}")
        if len(given) != size:
            raise AtmosphereError("channels", shown(given), f"{size} of the indices 0 to {self.total - 1}")
        return given

    @property
    def achromatic(self) -> bool:
        """Whether all channels of a path have the same coefficients."""
        return all(len(row) == 1 for row in self.rows)

    def fixed(self, value: Any) -> Any:
        """A value [W] or [1] as the spectrum of all paths, None where paths differ."""
        if self.rule != "channels":
            return None
        numbers = np.array(dr.detach(value), dtype=np.float64).ravel()
        picked = [float(numbers[i if len(numbers) > 1 else 0]) for i in self.channels]
        spectrum = mi.UnpolarizedSpectrum(*picked) if len(set(picked)) > 1 else mi.UnpolarizedSpectrum(picked[0])
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(spectrum)
        return spectrum

    def row(self, interaction: Any) -> Any:
        """Index into ``rows`` of the path that an interaction (or ray) belongs to."""
        if len(self.rows) == 1:
            return mi.UInt32(0)
        last = len(self.used) - 1
        return dr.minimum(mi.UInt32(dr.maximum(interaction.time, 0.0) * len(self.used)), last)

    def choose(self, interaction: Any) -> Any:
        """The indices of the wavelengths of an interaction: a list with one per channel, or one of length 1 for all."""
        if self.rule == "channels":
            return [mi.UInt32(i) for i in self.channels]
        if self.rule == "time":
            return [self._entry(self.row(interaction))]
        return [self._in_turns(interaction.wavelengths[i]) for i in range(len(interaction.wavelengths))]

    def _entry(self, place: Any) -> Any:
        """``used[place]``."""
        if self.used == list(range(self.total)):
            return place
        return dr.gather(mi.UInt32, self.table, place) if dr.is_jit_v(mi.Float) else self.table[int(place)]

    def _in_turns(self, nm: Any) -> Any:
        """The index that stands for ``nm`` (nm): that of the neighbour above where the fraction of the turn is below
        its share.
        """
        x = dr.square(dr.square(100.0 / nm)) * 1e3
        place = mi.Float(0.0)
        for low, high in zip(self.knots, self.knots[1:], strict=False):
            place += dr.clip((x - low) * (1.0 / max(high - low, 1e-30)), 0.0, 1.0)
        turn = nm * TURNS_PER_NM
        return self._entry(dr.minimum(mi.UInt32(place + (turn - dr.floor(turn))), self.total - 1))

    def read(self, value: Any, fixed: Any, chosen: Any) -> Any:
        """The unpolarised spectrum of a value [W] or [1] at the chosen wavelengths."""
        if fixed is not None:
            return fixed
        if len(value) == 1:
            return mi.UnpolarizedSpectrum(value if dr.is_jit_v(mi.Float) else value[0])
        if dr.is_jit_v(mi.Float):
            found = [dr.gather(mi.Float, value, i) for i in chosen]
        else:
            found = [value[int(i)] for i in chosen]
        return mi.UnpolarizedSpectrum(found[0]) if len(found) == 1 else mi.UnpolarizedSpectrum(*found)

    def uniform(self, name: str, values: dict[str, Any]) -> bool:
        """Whether all channels of a path have the same value of that name."""
        return self.achromatic or len(values[name]) == 1
