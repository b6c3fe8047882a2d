"""Where the sun stands: the PSA algorithm, in the frame and with the conventions of Mitsuba's ``sunsky``.

Source: M. Blanco-Muriel, D. C. Alarcon-Padilla, T. Lopez-Moratalla, M. Lara-Coira, "Computing the solar vector",
Solar Energy 70(5), 2001; valid 1999-2015, where it is within 0.5 arc minutes, and drifting by less than 0.01 degrees
up to 2050. Double precision: ``sunsky`` computes the same in single precision, whose Julian day has steps of a
quarter of a day, and is off by up to 0.05 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

EARTH_RADIUS_KM = 6371.01
ASTRONOMICAL_UNIT_KM = 149597890.0


@dataclass(frozen=True)
class Moment:
    """A place (degrees north and east) and a local time (hours from UTC, civil date).

    The defaults are those of sunsky: Tokyo, 10 July 2010, 15:00.
    """

    latitude: float = 35.6894
    longitude: float = 139.6917
    timezone: float = 9.0
    year: int = 2010
    month: int = 7
    day: int = 10
    hour: float = 15.0
    minute: float = 0.0
    second: float = 0.0

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of all values, which are those of the plugin's parameters."""
        return tuple(f.name for f in fields(cls))

    def hours_utc(self) -> float:
        """Decimal hours since midnight UTC; may be outside of 0-24."""
        return self.hour - self.timezone + (self.minute + self.second / 60.0) / 60.0

    def days_since_2000(self) -> float:
        """Days since noon UTC on 1 January 2000 (Julian day 2451545.0), Gregorian calendar."""
        late = int((self.month - 14) / 12)  # -1 in January and February; divisions truncate towards zero here
        day = int(1461 * (self.year + 4800 + late) / 4) + int(367 * (self.month - 2 - 12 * late) / 12)
        day += -int(3 * int((self.year + 4900 + late) / 100) / 4) + self.day - 32075
        return day - 0.5 + self.hours_utc() / 24.0 - 2451545.0


def sun_angles(moment: Moment) -> tuple[float, float]:
    """Zenith angle and azimuth (rad) of the sun; azimuth clockwise from north. Parallax included, refraction not."""
    days = moment.days_since_2000()
    omega = 2.1429 - 0.0010394594 * days
    mean_longitude = 4.8950630 + 0.017202791698 * days
    anomaly = 6.2400600 + 0.0172019699 * days
    longitude = mean_longitude + 0.03341607 * math.sin(anomaly) + 0.00034894 * math.sin(2.0 * anomaly)
    longitude += -0.0001134 - 0.0000203 * math.sin(omega)
    obliquity = 0.4090928 - 6.2140e-9 * days + 0.0000396 * math.cos(omega)

    right_ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    sidereal_hours = 6.6974243242 + 0.0657098283 * days + moment.hours_utc()
    hour_angle = math.radians(15.0 * sidereal_hours + moment.longitude) - right_ascension

    latitude = math.radians(moment.latitude)
    cosine = math.cos(latitude) * math.cos(hour_angle) * math.cos(declination)
    cosine += math.sin(declination) * math.sin(latitude)
    zenith = math.acos(min(max(cosine, -1.0), 1.0))
    south_north = math.tan(declination) * math.cos(latitude) - math.sin(latitude) * math.cos(hour_angle)
    azimuth = math.atan2(-math.sin(hour_angle), south_north)
    return zenith + EARTH_RADIUS_KM / ASTRONOMICAL_UNIT_KM * math.sin(zenith), azimuth


def sun_direction(moment: Moment) -> tuple[float, float, float]:
    """Unit vector towards the sun in sunsky's local frame: Z up.

    ``sunsky`` documents X as north but computes azimuth - 180 degrees, so that X points south and Y west; scenes rely
    on what it computes.
    """
    zenith, azimuth = sun_angles(moment)
    angle = azimuth - math.pi
    return math.sin(zenith) * math.cos(angle), math.sin(zenith) * math.sin(angle), math.cos(zenith)
