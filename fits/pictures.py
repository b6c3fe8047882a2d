"""Pictures of the sky as observations: linear OpenEXR, fisheye, latitude-longitude, or by a Mitsuba camera.

    [picture]
    projection = "fisheye"              # or "latlong", "perspective", "scene"
    fov_deg = 180                       # fisheye: angle across the circle, which touches the picture's shorter sides;
                                        # perspective: across the width, less than 180
    look_at = { origin = [0, 0, 2], target = [-1, 0, 3], up = [0, 0, 1] }     # perspective: as in Mitsuba
    scene = "noon.xml"                  # scene: Mitsuba scene file with an emitter `atmosphere`, whose sun and altitude
                                        # then need not be given; its first sensor took the picture
    altitude_m = 0
    sun_zenith_deg = 50
    sun_azimuth_deg = 180               # clockwise from north
    up_deg = 0                          # azimuth of the picture's top (fisheye) or of its middle column (latlong)
    relative_sigma = 0.01               # of every pixel, or
    sigma_file = "noon.error.exr"       # its standard error, as `atmo-jit render --standard-error` writes it
    colour = "srgb"                     # channels R, G, B are linear sRGB; "wavelengths": the atmosphere's wavelengths
    least_elevation_deg = 2             # of pixels that are used,
    sun_distance_deg = 2                # and how far from the sun they are

Fisheyes look at the zenith, north up and east on the left, distance from the middle in proportion to the zenith angle:
the sensor ``fisheye`` of atmo_jit.plugins. Latitude-longitude pictures have the zenith on top and azimuth growing
to the right: the sensor ``latlong``. A camera's world has Z up, X south and Y west, as the emitter ``atmosphere`` has
it; of a scene, pixels that show shapes, and their neighbours, are left out. A pixel is compared with the sky at its
centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit import scenes
from atmo_jit.errors import InputError, shown
from atmo_jit.files import is_file
from atmo_jit.image import read_planes
from atmo_jit.spectrum import SpectralBasis

from .camera import angles_deg, of_scene, perspective, rotation
from .config import FitConfig
from .observations import Observations, observations

NUMBERS = {
    "fov_deg": 180.0,
    "altitude_m": 0.0,
    "sun_zenith_deg": None,
    "sun_azimuth_deg": 0.0,
    "up_deg": 0.0,
    "relative_sigma": 0.01,
    "least_elevation_deg": 2.0,
    "sun_distance_deg": 2.0,
}
WORDS = {"projection": ("fisheye", "latlong", "perspective", "scene"), "colour": ("srgb", "wavelengths")}


def load_picture(path: str | Path, config: FitConfig) -> Observations:
    """The observations of an EXR, with the table ``picture`` of the configuration. Raises InputError for a file that
    cannot be used, or a table that does not say what the picture shows."""
    name = f"observations {shown(str(path), 200)}"
    if config.picture is None:
        raise InputError(f"{name}: is a picture; the configuration needs a table [picture] with projection and sun")
    folder = Path(path).parent
    _settings(config.picture, folder)  # before anything is read
    pixels, names = _read(Path(path), name)
    error = None
    if "sigma_file" in config.picture:
        error, _ = _read(folder / str(config.picture["sigma_file"]), "picture.sigma_file")
        if error.shape != pixels.shape:
            raise InputError(f"picture.sigma_file: has {error.shape} pixels and channels, the picture {pixels.shape}")
    return picture(pixels, config.picture, config, error=error, names=names, folder=folder, where=name)


def picture(
    pixels: np.ndarray,
    settings: Mapping[str, Any],
    config: FitConfig,
    *,
    error: np.ndarray | None = None,
    names: tuple[str, ...] = (),
    folder: Path = Path(),
    where: str = "picture",
) -> Observations:
    """The observations of a picture [height, width, channels], with its standard error if that is known. ``settings``:
    the entries of the table above; ``names``: of the channels; ``folder``: where a scene is looked for."""
    settings = _settings(settings, folder, pixels.shape[:2])
    nm = config.atmosphere.wavelengths_nm
    mixing = None
    if settings["colour"] == "srgb":
        if pixels.shape[2] != 3:
            raise InputError(f"{where}: has the channels {', '.join(names)}; colour 'srgb' needs R, G, B")
        mixing = SpectralBasis.of(config.atmosphere).srgb_matrix
    elif pixels.shape[2] != len(nm):
        raise InputError(f"{where}: has {pixels.shape[2]} channels; colour 'wavelengths' needs {len(nm)}")
    zenith, azimuth, seen = directions(settings, *pixels.shape[:2])
    sun, round_ = np.radians(settings["sun_zenith_deg"]), np.radians(azimuth - settings["sun_azimuth_deg"])
    view = np.radians(zenith)
    from_sun = np.cos(view) * np.cos(sun) + np.sin(view) * np.sin(sun) * np.cos(round_)
    seen &= (zenith <= 90.0 - settings["least_elevation_deg"]) & (
        from_sun < np.cos(np.radians(settings["sun_distance_deg"]))
    )
    if not seen.any():
        raise InputError(f"{where}: no pixel is above least_elevation_deg and sun_distance_deg away from the sun")
    arrays: dict[str, Any] = {
        "radiance": pixels[seen].astype(float),
        "wavelengths_nm": nm,
        "altitude_m": settings["altitude_m"],
        "sun_zenith_deg": settings["sun_zenith_deg"],
        "view_zenith_deg": zenith[seen],
        "view_azimuth_deg": azimuth[seen],
        "sun_azimuth_deg": settings["sun_azimuth_deg"],
    }
    if error is None:
        arrays["relative_sigma"] = settings["relative_sigma"]
    else:
        # A pixel that no path reached has no error either: such are not known better than the typical one.
        sigma = error[seen].astype(float)
        arrays["sigma"] = np.maximum(sigma, 0.1 * np.median(sigma, axis=0))
    return replace(observations(arrays, where, mixing=mixing), rows=np.flatnonzero(seen.ravel()))


def directions(settings: Mapping[str, Any], height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zenith angle and azimuth (clockwise from north) of the pixels' centres in degrees, and whether the picture shows
    anything there: [height, width]."""
    if settings["projection"] == "scene":
        return *angles_deg(settings["camera"].direction), settings["camera"].free
    if settings["projection"] == "perspective":
        direction = perspective(settings["turn"], settings["fov_deg"], height, width)
        return *angles_deg(direction), np.ones((height, width), bool)
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    if settings["projection"] == "latlong":
        return 180.0 * v, 360.0 * (u - 0.5) + settings["up_deg"], np.ones(u.shape, bool)
    east = (1.0 - 2.0 * u) * max(width / height, 1.0)
    north = (1.0 - 2.0 * v) * max(height / width, 1.0)
    radius = np.hypot(east, north)
    azimuth = np.degrees(np.arctan2(east, north)) + settings["up_deg"]
    return radius * settings["fov_deg"] / 2.0, azimuth, radius <= 1.0


def _settings(
    given: Mapping[str, Any], folder: Path = Path(), size: tuple[int, int] | None = None
) -> dict[str, Any]:
    """The checked entries; with the ``size`` of the picture also the camera of a scene."""
    known = (*NUMBERS, *WORDS, "sigma_file", "look_at", "scene")
    unknown = next((key for key in given if key not in known), None)
    if unknown is not None:
        raise InputError(f"picture: unknown key {shown(unknown)}; allowed are {', '.join(known)}")
    found: dict[str, Any] = {}
    for key, words in WORDS.items():
        found[key] = given.get(key, words[0])
        if found[key] not in words:
            raise InputError(f"picture.{key}: is {shown(found[key])}; must be one of {', '.join(words)}")
    defaults = dict(NUMBERS)
    if found["projection"] == "scene":
        if not isinstance(given.get("scene"), str):
            raise InputError(f"picture.scene: is {shown(given.get('scene'))}; must be the name of a scene file")
        beside = folder / given["scene"]
        path = scenes.find(str(beside) if is_file(beside) else given["scene"])
        defaults |= {"sun_zenith_deg": 0.0}
        if size is not None:
            found["camera"] = of_scene(path, *size)
            zenith, azimuth = (float(v) for v in angles_deg(found["camera"].sun))
            defaults |= {"sun_zenith_deg": zenith, "sun_azimuth_deg": azimuth}
            defaults |= {"altitude_m": found["camera"].altitude_m}
    for key, default in defaults.items():
        value = given.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
            raise InputError(f"picture.{key}: is {shown(value)}; must be a number")
        found[key] = float(value)
    if found["projection"] == "perspective":
        found["turn"] = rotation(given.get("look_at"))
        if not 0.0 < found["fov_deg"] < 180.0:
            raise InputError(f"picture.fov_deg: is {found['fov_deg']:g}; must be between 0 and 180 for a perspective")
    return found


def _read(path: Path, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Pixels [height, width, channels] and the names of the channels: R, G, B in this order, others by name."""
    try:
        channels = read_planes(path)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{name}: cannot be read as OpenEXR ({shown(str(error), 100)})") from None
    names = [key for key in ("R", "G", "B") if key in channels] or sorted(set(channels) - {"A"})
    if not names:
        raise InputError(f"{name}: has no channels but A; must have R, G, B or one for each wavelength")
    return np.stack([channels[key] for key in names], axis=-1), tuple(names)
