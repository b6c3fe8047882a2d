"""Which of an atmosphere's wavelengths a path of light has, in each kind of Mitsuba variant.

Three rules, all of which leave a path with the atmosphere's own wavelengths only, so that nothing is invented in between:

- ``channels`` (rgb, mono): every channel of the variant is one wavelength. Channels share a path.
- ``time`` (rgb, mono): every path has one wavelength, chosen by its time: i = floor(time * W) with the shutter open from 0 to 1. The light's
  source has to be W times the colour of its wavelength, and the picture then is the sum over all wavelengths.
- ``spectral``: a wavelength of the variant stands for one of its two neighbours in the atmosphere, in turns that are much shorter than any
  spectrum's structure. Their shares are the package's interpolation (linear in lambda^-4, see :mod:`atmo_jit.spectrum`), so the mean over
  wavelengths is that of the interpolated radiance; with interpolated coefficients it would not be.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import AtmosphereError, shown

MODES = ("channels", "time")
TURNS_PER_NM = 64.0  # a float32 wavelength of 500 nm still resolves 500 steps in a turn


class Wavelengths:
    """The rule of the current variant for ``wavelengths_nm`` [W].

    ``channels``: index of the wavelength of every channel, None for the default: one for all channels if W is 1, the three of
    W = 3 in rgb, that nearest to 555 nm in mono. ``mode``: "channels" or "time"; spectral variants have their own rule.
    ``rows``: for every choice that :meth:`row` can give, the wavelengths that are in use together.
    """

    def __init__(self, wavelengths_nm: np.ndarray, mode: str = "channels", channels: list[int] | None = None) -> None:
        if mode not in MODES:
            raise AtmosphereError("wavelength_mode", shown(mode), f"one of {', '.join(MODES)}")
        self.count = len(wavelengths_nm)
        self.mode = "spectral" if mi.is_spectral else mode
        self.channels: list[int] = []
        if self.mode == "channels":
            self.channels = self._channels(wavelengths_nm, channels)
            self.rows = [tuple(set(self.channels))]
        elif self.mode == "time":
            self.rows = [(w,) for w in range(self.count)]
        else:
            self.rows = [tuple(range(self.count))]
            knots = np.asarray(wavelengths_nm, dtype=np.float64) ** -4.0 * 1e11
            order = np.argsort(knots, kind="stable")
            self.knots = [float(v) for v in knots[order]]
            self.order = mi.UInt32(order.tolist()) if dr.is_jit_v(mi.Float) else order.tolist()

    def _channels(self, wavelengths_nm: np.ndarray, given: list[int] | None) -> list[int]:
        size = len(mi.UnpolarizedSpectrum(0.0))
        if given is None:
            if self.count == 1:
                return [0] * size
            if size == 1:
                return [int(np.argmin(np.abs(wavelengths_nm - 555.0)))]
            if self.count == size:
                return list(range(size))
            allowed = f"{size} indices of its {self.count} wavelengths (0 to {self.count - 1})"
            raise AtmosphereError("channels", "nothing", allowed)
        if len(given) != size or not all(0 <= i < self.count for i in given):
            raise AtmosphereError("channels", shown(given), f"{size} of the indices 0 to {self.count - 1}")
        return given

    @property
    def achromatic(self) -> bool:
        """Whether all channels of a path have the same coefficients."""
        return all(len(row) == 1 for row in self.rows)

    def fixed(self, value: Any) -> Any:
        """A value [W] or [1] as the spectrum of all paths, None where paths differ."""
        if self.mode != "channels":
            return None
        numbers = np.array(dr.detach(value), dtype=np.float64).ravel()
        picked = [float(numbers[i if len(numbers) > 1 else 0]) for i in self.channels]
        spectrum = mi.UnpolarizedSpectrum(*picked) if len(set(picked)) > 1 else mi.UnpolarizedSpectrum(picked[0])
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(spectrum)
        return spectrum

    def row(self, interaction: Any) -> Any:
        """Index into ``rows`` of the path that an interaction (or ray) belongs to."""
        return self._of_time(interaction) if self.mode == "time" else mi.UInt32(0)

    def _of_time(self, interaction: Any) -> Any:
        return dr.minimum(mi.UInt32(dr.maximum(interaction.time, 0.0) * self.count), self.count - 1)

    def choose(self, interaction: Any) -> Any:
        """The indices of the wavelengths of an interaction: a list with one per channel, or one of length 1 for all."""
        if self.mode == "channels":
            return [mi.UInt32(i) for i in self.channels]
        if self.mode == "time":
            return [self._of_time(interaction)]
        return [self._in_turns(interaction.wavelengths[i]) for i in range(len(interaction.wavelengths))]

    def _in_turns(self, nm: Any) -> Any:
        """The index that stands for ``nm`` (nm): that of the neighbour above where the fraction of the turn is below its share."""
        x = dr.square(dr.square(100.0 / nm)) * 1e3
        place = mi.Float(0.0)
        for low, high in zip(self.knots, self.knots[1:], strict=False):
            place += dr.clip((x - low) * (1.0 / max(high - low, 1e-30)), 0.0, 1.0)
        turn = nm * TURNS_PER_NM
        rank = dr.minimum(mi.UInt32(place + (turn - dr.floor(turn))), self.count - 1)
        return dr.gather(mi.UInt32, self.order, rank) if dr.is_jit_v(mi.Float) else self.order[int(rank)]

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
