"""Pictures: linear OpenEXR out, and the display transform that turns one into an ordinary PNG.

Display transform, from linear sRGB radiance to the picture on a screen, in this order:

1. exposure: the picture is multiplied by an automatic factor (``automatic_exposure``) and by 2**stops;
2. highlights: luminance Y becomes y = 1 - exp(-Y), so that nothing clips and the sun stays a disc;
3. gamut: where a channel leaves [0, 1] at that luminance, the colour is drawn towards grey just far enough, so that
   brightness and hue survive and only saturation gives way (an orange sun turns white at its centre, as on film);
4. the sRGB transfer curve and 8 bits.

Luminance is that of the sRGB primaries (Rec. 709 weights).
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# Rec. ITU-R BT.709: luminance of the sRGB primaries, and the CIE xy of red, green, blue and of white (D65).
LUMINANCE = np.array([0.2126390, 0.7151687, 0.0721923])
SRGB_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# Automatic exposure brings the log-mean luminance to KEY, shown as 1 - exp(-KEY) = 0.36 of white (0.63 after the sRGB
# curve), unless that lifts the brightest twentieth of the picture above HIGHLIGHT, shown as 0.59 of white
# (0.79): dark silhouettes do not wash out the sky behind them.
KEY = 0.45
HIGHLIGHT = 0.9
# Pixels that are NaN or infinite are painted so that nobody mistakes them for the picture.
INVALID_COLOUR = (1.0, 0.0, 1.0)
# Larger pictures are more likely a mistake or an attack (this holds 178 million pixels of three channels).
EXR_LIMIT = 2**31


@dataclass(frozen=True)
class Picture:
    """A rendered picture: ``pixels`` float32 [height, width, channels], ``channels`` names such as ("R", "G", "B")."""

    pixels: np.ndarray
    channels: tuple[str, ...]

    @property
    def rgb(self) -> np.ndarray:
        """Linear sRGB float32 [height, width, 3]; a luminance picture is repeated into the three channels."""
        names = ("R", "G", "B") if "R" in self.channels else ("Y", "Y", "Y")
        return self.pixels[..., [self.channels.index(name) for name in names]]

    @property
    def invalid(self) -> np.ndarray:
        """Where any channel is NaN or infinite: bool [height, width]."""
        return ~np.isfinite(self.pixels).all(axis=-1)


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Relative luminance [...] of linear sRGB [..., 3]."""
    return rgb @ LUMINANCE


def automatic_exposure(rgb: np.ndarray) -> float:
    """The factor for linear sRGB [..., 3] that ``KEY`` and ``HIGHLIGHT`` ask for; 1 for a picture without light.

    Pixels that are black, NaN or infinite count for nothing, nor do the brightest and darkest 1 % count for the mean:
    the sun's disc and a handful of stray pixels do not set the exposure.
    """
    values = luminance(rgb[np.isfinite(rgb).all(axis=-1)])
    values = np.sort(values[values > 0.0])
    if not len(values):
        return 1.0
    cut = len(values) // 100
    mean = np.exp(np.log(values[cut : len(values) - cut]).mean())
    return float(min(KEY / mean, HIGHLIGHT / np.percentile(values, 95)))


def display(rgb: np.ndarray, stops: float = 0.0) -> np.ndarray:
    """Steps 1-3 above: linear sRGB [..., 3] of any range to linear sRGB in [0, 1]; invalid pixels get INVALID_COLOUR.

    stops: exposure around the automatic one, +1 doubles the light.
    """
    rgb = np.asarray(rgb)
    factor = automatic_exposure(rgb) * 2.0**stops
    # A few rows at a time: in float64 a large picture takes many times its own memory.
    pixels = rgb.reshape(-1, 3)
    parts = np.array_split(pixels, len(pixels) // 2**18 + 1)
    return np.concatenate([_compressed(part.astype(np.float64), factor) for part in parts]).reshape(rgb.shape)


def _compressed(rgb: np.ndarray, factor: float) -> np.ndarray:
    """:func:`display` at a given exposure, float32."""
    invalid = ~np.isfinite(rgb).all(axis=-1, keepdims=True)
    exposed = np.where(invalid, 0.0, rgb) * factor
    before = luminance(exposed)[..., None]
    after = -np.expm1(-np.maximum(before, 0.0))
    scale = np.divide(after, before, out=np.ones_like(before), where=before > 0.0)
    # From the grey of the same luminance, go in the colour's direction until the first channel meets 0 or 1.
    away = np.where(before > 0.0, exposed * scale - after, 0.0)
    room = np.where(away > 0.0, 1.0 - after, after)
    reach = np.divide(room, np.abs(away), out=np.full_like(away, np.inf), where=np.abs(away) > room)
    shown = after + away * np.minimum(reach.min(axis=-1, keepdims=True), 1.0)
    return np.where(invalid, INVALID_COLOUR, np.clip(shown, 0.0, 1.0)).astype(np.float32)


def write_png(path: str | Path, rgb: np.ndarray) -> None:
    """Write linear sRGB in [0, 1], [height, width, 3], with the sRGB curve as an 8-bit PNG."""
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(rgb, dtype=np.float32), mi.Bitmap.PixelFormat.RGB)
    bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True).write(
        str(path), mi.Bitmap.FileFormat.PNG
    )


def write_exr(path: str | Path, picture: Picture, metadata: dict[str, str | float | int]) -> None:
    """Write a picture as float32 OpenEXR (ZIP), its colours linear with sRGB primaries.

    metadata: further header attributes, text and numbers. Raises OSError where the file cannot be written.
    """
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": SRGB_CHROMATICITIES,
        **metadata,
    }
    pixels = np.moveaxis(picture.pixels.astype(np.float32), -1, 0)
    channels = {name: np.ascontiguousarray(plane) for name, plane in zip(picture.channels, pixels, strict=True)}
    write_planes(path, header, channels)


def write_planes(path: str | Path, header: dict[str, Any], planes: dict[str, np.ndarray]) -> None:
    """Write channels as OpenEXR. Raises OSError where the file cannot be written, of which OpenEXR has another idea."""
    import OpenEXR

    with OpenEXR.File(header, dict(planes)) as file:  # which puts channels in the place of the arrays
        try:
            file.write(str(path))
        except RuntimeError as error:
            raise OSError(str(error).rpartition('". ')[2].rstrip(".")) from None


def read_planes(path: str | Path) -> dict[str, np.ndarray]:
    """The channels of an OpenEXR by name, [rows, columns]. Raises OSError, RuntimeError or ValueError for a file that
    cannot be read, or whose pixels would take more than EXR_LIMIT bytes (which is seen before memory is taken)."""
    import OpenEXR

    with _hushed():
        with OpenEXR.File(str(path), header_only=True) as file:
            size = 0
            for part in file.parts:
                (left, top), (right, bottom) = (np.asarray(end).tolist() for end in part.header["dataWindow"])
                size += 4 * (right - left + 1) * (bottom - top + 1) * len(part.header["channels"])
        if size > EXR_LIMIT:
            raise ValueError(f"its pixels would take more than {EXR_LIMIT} bytes")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    if len({plane.shape for plane in planes.values()}) != 1 or next(iter(planes.values())).ndim != 2:
        raise ValueError("it has no channels, or some of other sizes")
    return planes


@contextmanager
def _hushed() -> Iterator[None]:
    """OpenEXR raises an exception for a damaged file and explains it on the terminal, in lines of its own."""
    sys.stderr.flush()
    former, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(former, 2)
        os.close(former)
        os.close(nowhere)
