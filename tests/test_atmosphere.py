"""Atmosphere descriptions: what is read from them, and that all that is wrong is refused in a line naming the field."""

from __future__ import annotations

import json

import numpy as np
import pytest
from descriptions import changed
from tolerances import FLOAT64

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import AtmosphereError, InputError
from atmo_jit.profile import Exponential, Tabulated, Tent

NAN, INF = float("nan"), float("inf")


@pytest.fixture
def rich(earth):
    """A description that has every key: two aerosol species, absorption_per_m, a table, g per wavelength."""
    second = {
        "scattering_per_m": 1e-6,
        "absorption_per_m": [1e-7, 2e-7, 0],
        "profile": {"altitude_m": [0, 1000, 1000, 20000], "density": [1, 1, 0.5, 0]},
        "phase": {"type": "henyey_greenstein", "g": [0.6, 0.65, 0.7]},
    }
    third = changed(second, "phase", {"type": "tabulated", "cos_theta": [-1, 0, 1], "values": [1, 1, 3]})
    fourth = changed(second, "phase", {"type": "legendre", "moments": [1, 0.5, 0.2]})
    return changed(earth, "mie", [earth["mie"], second, third, fourth])


def refusal(description):
    with pytest.raises(AtmosphereError) as caught:
        Atmosphere.from_dict(description)
    message = str(caught.value)
    assert "\n" not in message and isinstance(caught.value, InputError)
    assert message.startswith(f"{caught.value.field}: found ") and "; allowed: " in message
    return caught.value


def test_the_numbers_of_a_description(rich):
    air = Atmosphere.from_dict(rich)
    assert [c.name for c in air.constituents] == ["rayleigh", "mie.0", "mie.1", "mie.2", "mie.3", "ozone"]
    assert air.thickness_m == 60000.0
    assert np.array_equal(air.wavelengths_nm, [680.0, 550.0, 440.0]) and air.wavelengths_nm.dtype == np.float64
    assert np.allclose(air.mie[0].absorption_per_m, 0.444e-6, rtol=FLOAT64)
    assert np.allclose(air.mie[0].extinction_per_m, 4.44e-6, rtol=FLOAT64)
    assert np.allclose(air.mie[0].single_scattering_albedo, 0.9, rtol=FLOAT64)
    assert np.array_equal(air.mie[1].scattering_per_m, [1e-6] * 3)
    assert np.array_equal(air.mie[1].absorption_per_m, [1e-7, 2e-7, 0])
    assert isinstance(air.mie[1].profile, Tabulated) and isinstance(air.rayleigh.profile, Exponential)
    assert isinstance(air.ozone.profile, Tent) and air.ozone.phase is None
    assert not air.ozone.scattering_per_m.any() and not air.rayleigh.absorption_per_m.any()
    assert air.mie[1].phase.at(2).g == 0.7


def test_numbers_stand_for_all_wavelengths_and_absent_keys_for_their_defaults():
    air = Atmosphere.from_dict({"wavelengths_nm": [400, 500], "bottom_radius_m": 1e6, "top_radius_m": 1.1e6})
    assert air.constituents == () and air.mie == ()
    assert np.array_equal(air.solar_irradiance, [1, 1]) and np.array_equal(air.ground_albedo, [0, 0])
    assert air.sun_angular_radius_deg == 0.2678
    null = Atmosphere.from_dict(air.to_dict() | {"rayleigh": None, "mie": None, "ozone": None})
    assert null == air and hash(null) == hash(air)


def test_one_species_is_called_mie_and_any_number_of_wavelengths_will_do(earth):
    assert Atmosphere.from_dict(earth).mie[0].name == "mie"
    assert Atmosphere.from_dict(changed(earth, "mie", [earth["mie"]])).mie[0].name == "mie.0"
    for count in (1, 7):
        grey = {"wavelengths_nm": list(range(400, 400 + count)), "bottom_radius_m": 6e6, "top_radius_m": 7e6}
        mie = {
            "scattering_per_m": 1e-6,
            "single_scattering_albedo": 1,
            "scale_height_m": 1e3,
            "phase": {"type": "isotropic"},
        }
        air = Atmosphere.from_dict({**grey, "mie": mie})
        assert air.mie[0].extinction_per_m.shape == (count,)


def test_round_trip_is_exact(earth, rich):
    for description in (earth, rich):
        air = Atmosphere.from_dict(description)
        assert air.to_dict() == description
        assert Atmosphere.from_dict(json.loads(json.dumps(air.to_dict()))) == air
    air.to_dict()["mie"][0]["phase"]["g"] = 0.1
    assert air.to_dict() == rich


def test_numpy_values_are_as_good_as_lists(earth):
    arrays = changed(earth, "wavelengths_nm", np.array([680.0, 550.0, 440.0]))
    arrays = changed(arrays, "mie.phase.g", np.float64(0.8))
    arrays = changed(arrays, "ozone.center_m", np.int64(25000))
    air = Atmosphere.from_dict(arrays)
    assert air == Atmosphere.from_dict(earth)
    json.dumps(air.to_dict())


def test_fields_cannot_be_changed(earth):
    air = Atmosphere.from_dict(earth)
    with pytest.raises(AttributeError):
        air.bottom_radius_m = 1.0
    with pytest.raises(ValueError, match="read-only"):
        air.mie[0].scattering_per_m[0] = 1.0


# --- names ---------------------------------------------------------------------------------------------------------


def test_get(rich):
    air = Atmosphere.from_dict(rich)
    assert air.get("bottom_radius_m") == 6360000.0
    assert np.array_equal(air.get("mie.1.scattering_per_m"), [1e-6] * 3)
    assert air.get("mie.0.phase.g") == 0.8 and isinstance(air.get("mie.0.phase.g"), float)
    assert np.array_equal(air.get("mie.1.phase.g"), [0.6, 0.65, 0.7])
    assert np.array_equal(air.get("mie.1.profile.density"), [1, 1, 0.5, 0])
    assert np.allclose(air.get("mie.0.absorption_per_m"), 0.444e-6, rtol=FLOAT64)
    assert np.allclose(
        air.get("mie.1.single_scattering_albedo"), 1e-6 / (1e-6 + np.array([1e-7, 2e-7, 0])), rtol=FLOAT64
    )
    for name in air.names():
        assert np.all(np.isfinite(air.get(name)))


@pytest.mark.parametrize(
    "name",
    ["", "nope", "mie.phase.g", "mie.9.phase.g", "mie.0.phase", "rayleigh", "mie.0.profile.density", "_document"],
)
def test_get_refuses_names_that_are_not_there(rich, name):
    with pytest.raises(AtmosphereError, match="no value of that name; allowed: the names wavelengths_nm, "):
        Atmosphere.from_dict(rich).get(name)


def test_replace(earth, rich):
    air = Atmosphere.from_dict(earth)
    other = air.replace({"mie.phase.g": 0.5, "ground_albedo": 0.3, "ozone": None, "top_radius_m": 6.5e6})
    assert other.get("mie.phase.g") == 0.5 and other.ozone is None and other.thickness_m == 140000.0
    assert np.array_equal(other.ground_albedo, [0.3] * 3)
    assert air.to_dict() == earth
    many = Atmosphere.from_dict(rich).replace({"mie.1.phase.g": [0.1, 0.2, 0.3], "mie.3": earth["mie"]})
    assert many.get("mie.1.phase.g")[1] == 0.2 and many.get("mie.3.phase.g") == 0.8


def test_replace_puts_a_key_in_the_place_of_its_alternative(earth):
    air = Atmosphere.from_dict(earth)
    table = {"altitude_m": [0, 1e4], "density": [1, 0]}
    other = air.replace({"mie.absorption_per_m": 1e-6, "mie.profile": table, "ozone.profile": table})
    assert "single_scattering_albedo" not in other.to_dict()["mie"] and "center_m" not in other.to_dict()["ozone"]
    back = other.replace({"mie.single_scattering_albedo": [0.9] * 3, "mie.scale_height_m": 1200})
    back = back.replace({"ozone.center_m": 25000, "ozone.half_width_m": 15000})
    assert back == air


@pytest.mark.parametrize(
    ("name", "value", "field"),
    [
        ("mie.phase.g", 1.0, "mie.phase.g"),
        ("mie.colour", 1.0, "mie.colour"),
        ("nope", 1.0, "nope"),
        ("nope.deeper", 1.0, "nope.deeper"),
        ("mie.0.phase.g", 0.5, "mie.0.phase.g"),
        ("wavelengths_nm.0", 500, "wavelengths_nm.0"),
        ("top_radius_m", 6360000, "top_radius_m"),
    ],
)
def test_replace_validates(earth, name, value, field):
    with pytest.raises(AtmosphereError) as caught:
        Atmosphere.from_dict(earth).replace({name: value})
    assert caught.value.field == field


# --- every field wrong in turn -------------------------------------------------------------------------------------

NUMBERS = {
    # field: what is out of its range, beside the wrong types and non-finite values that every number refuses
    "bottom_radius_m": [0, -1],
    "top_radius_m": [0, -1, 6360000, 6359999],
    "sun_angular_radius_deg": [-0.1, 90],
    "rayleigh.scale_height_m": [0, -8000],
    "mie.0.scale_height_m": [0, -1200],
    "ozone.center_m": [-1],
    "ozone.half_width_m": [0, -1],
}
PER_WAVELENGTH = {
    "wavelengths_nm": [0, -550],
    "solar_irradiance": [-1],
    "ground_albedo": [-0.01, 1.01],
    "rayleigh.scattering_per_m": [-1e-6],
    "mie.0.scattering_per_m": [-1e-6],
    "mie.0.single_scattering_albedo": [0, -0.1, 1.01],
    "mie.0.phase.g": [1, -1, 1.5],
    "mie.1.absorption_per_m": [-1e-9],
    "mie.1.phase.g": [1, -1],
    "ozone.absorption_per_m": [-1e-9],
}
LISTS = {
    "mie.1.profile.altitude_m": [-1],
    "mie.1.profile.density": [-1],
    "mie.2.phase.cos_theta": [-1.5, 1.5],
    "mie.2.phase.values": [-1],
    "mie.3.phase.moments": [-1.5, 1.5],
}
NOT_NUMBERS = [None, True, "12", {}, {"a": 1}, NAN, INF, -INF, 10**400]


def wrong_values():
    for field, outside in NUMBERS.items():
        for value in [*outside, *NOT_NUMBERS, [], [1.0]]:
            yield field, value, field
    for field, outside in PER_WAVELENGTH.items():
        numbers = [*outside, *NOT_NUMBERS]
        scalar = field != "wavelengths_nm"
        for value in numbers if scalar else [*numbers, 550]:
            yield field, value, field
        for value in numbers:
            yield field, [0.5, value, 0.5], f"{field}[1]"
        for value in [[], [0.5], [0.5] * 4] if scalar else [[]]:
            yield field, value, field
        yield field, [[0.5], [0.5], [0.5]], f"{field}[0]"
    for field, outside in LISTS.items():
        for value in [*NOT_NUMBERS, 1.0, [], [[1]]]:
            found_inside = value == [[1]] and not field.startswith("mie.2")  # mie.2's lists need two numbers
            yield field, value, f"{field}[0]" if found_inside else field
        for value in [*outside, *NOT_NUMBERS]:
            yield field, [1, value], f"{field}[1]"
    for field in ("rayleigh", "mie", "ozone", "mie.0", "mie.0.phase", "mie.1.profile", "mie.2.phase"):
        for value in [True, 1, "earth", NAN] + ([[], None] if "." in field else [] if field == "mie" else [[]]):
            yield field, value, field
    yield "mie", [], "mie"
    yield "mie", [None], "mie.0"
    for kind in (None, 3, "", "mie", ["rayleigh"], "Rayleigh"):
        yield "mie.0.phase.type", kind, "mie.0.phase.type"
    yield "mie.1.profile.altitude_m", [0, 1000, 999, 20000], "mie.1.profile.altitude_m[2]"
    yield "mie.1.profile.altitude_m", [0, 1000, 20000], "mie.1.profile.density"
    yield "mie.1.profile.density", [1, 1, 1], "mie.1.profile.density"
    yield "mie.2.phase.cos_theta", [1, 0, -1], "mie.2.phase.cos_theta[1]"
    yield "mie.2.phase.cos_theta", [-1, 1], "mie.2.phase.values"
    yield "mie.2.phase.values", [0, 0, 0], "mie.2.phase.values"
    yield "mie.3.phase.moments", [0.9, 0.5], "mie.3.phase.moments[0]"
    # What single precision cannot hold: these made NaN, warnings, or a solve without end.
    for field in ("rayleigh.scale_height_m", "ozone.half_width_m"):
        yield from ((field, value, field) for value in (1e-300, 1e300))
    yield "ozone.center_m", 1e300, "ozone.center_m"
    yield "mie.1.profile.altitude_m", [0, 1000, 1e4, 1e300], "mie.1.profile.altitude_m[3]"
    yield "mie.1.profile.density", [1, 1, 1, 1e300], "mie.1.profile.density[3]"
    yield "mie.1.profile.density", [1, 1, 1, 1e20], "mie.1.scattering_per_m"
    yield "rayleigh.scattering_per_m", 1e300, "rayleigh.scattering_per_m"
    yield "mie.0.single_scattering_albedo", 1e-320, "mie.0.single_scattering_albedo"
    yield "solar_irradiance", 1e300, "solar_irradiance"


WRONG = list(wrong_values())


def test_the_table_of_wrong_values_leaves_no_field_out(rich):
    tested = {*NUMBERS, *PER_WAVELENGTH, *LISTS}
    repeated = ("mie.1.", "mie.2.", "mie.3.")  # the same kinds of fields as in the first species or one another
    left = [name for name in Atmosphere.from_dict(rich).names() if name not in tested]
    assert [name for name in left if not name.startswith(repeated)] == []


@pytest.mark.parametrize(("field", "value", "named"), WRONG, ids=[f"{f}={str(v)[:20]}" for f, v, _ in WRONG])
def test_every_field_wrong_in_turn(rich, field, value, named):
    assert refusal(changed(rich, field, value)).field == named


@pytest.mark.parametrize(
    "field",
    [
        "wavelengths_nm",
        "bottom_radius_m",
        "top_radius_m",
        "rayleigh.scattering_per_m",
        "rayleigh.scale_height_m",
        "mie.0.scattering_per_m",
        "mie.0.single_scattering_albedo",
        "mie.0.scale_height_m",
        "mie.0.phase",
        "mie.0.phase.type",
        "mie.0.phase.g",
        "mie.1.profile.altitude_m",
        "mie.1.profile.density",
        "mie.2.phase.cos_theta",
        "mie.2.phase.values",
        "mie.3.phase.moments",
        "ozone.absorption_per_m",
        "ozone.center_m",
        "ozone.half_width_m",
    ],
)
def test_every_required_key_missing_in_turn(rich, field):
    error = refusal(changed(rich, field))
    assert error.field == field and "missing" in str(error)


@pytest.mark.parametrize("place", ["", "rayleigh.", "mie.0.", "mie.0.phase.", "mie.1.profile.", "ozone."])
def test_unknown_keys(rich, place):
    error = refusal(changed(rich, f"{place}colour", 1))
    assert error.field == f"{place}colour" and "an unknown key" in str(error)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("mie.0.absorption_per_m", 1e-6),
        ("mie.1.single_scattering_albedo", 0.9),
        ("mie.0.profile", {"altitude_m": [0], "density": [1]}),
        ("mie.1.scale_height_m", 1000),
        ("rayleigh.profile", {"altitude_m": [0], "density": [1]}),
        ("ozone.profile", {"altitude_m": [0], "density": [1]}),
    ],
)
def test_two_keys_that_exclude_each_other(rich, field, value):
    assert "together; allowed: exactly one of" in str(refusal(changed(rich, field, value)))


@pytest.mark.parametrize("description", [None, [], "earth", 3, [{"wavelengths_nm": [1]}], {1: 2}])
def test_a_description_that_is_no_object(description):
    refusal(description)


def test_a_message_names_field_value_and_what_is_allowed(earth):
    text = str(refusal(changed(earth, "mie.phase.g", 1.5)))
    assert text == "mie.phase.g: found 1.5; allowed: a finite number in (-1, 1)"
    text = str(refusal(changed(earth, "ground_albedo", 1.5)))
    assert (
        text == "ground_albedo: found 1.5; allowed: a finite number in [0, 1], or a list of 3 (one for each wavelength)"
    )
    text = str(refusal(changed(earth, "mie.scattering_per_m", [1, 2])))
    assert text == (
        "mie.scattering_per_m: found a list of 2; allowed: a list of 3 (one for each wavelength) or one number for all"
    )
    text = str(refusal(changed(earth, "bottom_radius_m", 6420000)))
    assert text == "top_radius_m: found 6420000; allowed: a number above bottom_radius_m (6.42e+06)"


@pytest.mark.parametrize("name", ["bottom_radius_m", "top_radius_m"])
def test_radii_have_an_end(earth, name):
    assert Atmosphere(changed(earth, "top_radius_m", 1e10)).top_radius_m == 1e10
    assert str(refusal(changed(earth, name, 1e308))) == f"{name}: found 1e+308; allowed: a finite number in (0, 1e+10]"


def test_peaks_that_single_precision_cannot_tell_from_a_line(earth):
    """Their value straight on is 0 / 0 there."""
    phase = {"type": "cornette_shanks", "g": 1.0 - 1e-6}
    assert Atmosphere(changed(earth, "mie.phase", phase)).mie[0].phase.g == 1.0 - 1e-6
    for g in (1.0 - 1e-9, [0.5, 0.5, -1.0 + 1e-16]):
        text = str(refusal(changed(earth, "mie.phase", phase | {"g": g})))
        assert text.startswith("mie.phase.g: found ") and "in single precision too" in text


def test_altitudes_are_0_or_more_than_nothing(earth):
    """The slope of a density between them would be infinite."""
    profile = {"altitude_m": [0.0, 1e-300, 2000.0], "density": [1.0, 0.0, 1.0]}
    text = str(refusal(changed(earth, "rayleigh", {"scattering_per_m": 1e-5, "profile": profile})))
    assert text == "rayleigh.profile.altitude_m[1]: found 1e-300; allowed: 0 or a number from 1e-09 on"


def test_species_are_counted(earth):
    assert len(Atmosphere(changed(earth, "mie", [earth["mie"]] * 64)).mie) == 64
    text = str(refusal(changed(earth, "mie", [earth["mie"]] * 65)))
    assert text == "mie: found a list of 65; allowed: null, an object, or a list of 1 to 64 objects"


def test_altitudes_are_counted(earth):
    """Of all profiles together: a solve with 200,000 took hours, and no signal ended it."""
    def table(first, count):
        return {"altitude_m": [float(first + i) for i in range(count)], "density": [1.0] * count}

    rayleigh = {"scattering_per_m": 1e-5, "profile": table(0, 1000)}
    aerosol = {key: value for key, value in earth["mie"].items() if key != "scale_height_m"}
    fits = earth | {"rayleigh": rayleigh, "mie": aerosol | {"profile": table(500, 1500)}}
    assert len(Atmosphere(fits).constituents) == 3
    text = str(refusal(fits | {"mie": [aerosol | {"profile": table(501, 1500)}]}))
    assert text == (
        "mie.0.profile.altitude_m: found a list of 1500; allowed: at most 2000 altitudes in all profiles together"
    )
    many = [aerosol | {"profile": table(0, count)} for count in (*[10] * 39, 501)]
    assert "allowed: at most 500 altitudes" in str(refusal(earth | {"mie": many}))


def test_hostile_text_stays_on_one_short_line(earth):
    error = refusal(changed(earth, "mie.phase.type", "a\nb\x1b[31m" * 1000))
    assert len(str(error)) < 300 and str(error).isprintable()
    error = refusal({**earth, "a\nb": 1})
    assert str(error).isprintable()


# --- files ---------------------------------------------------------------------------------------------------------


def written(tmp_path, text):
    path = tmp_path / "air.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def file_refusal(path):
    with pytest.raises(AtmosphereError) as caught:
        Atmosphere.load(path)
    assert "\n" not in str(caught.value)
    return caught.value


def test_load_takes_names_files_dicts_and_atmospheres(tmp_path, earth):
    air = Atmosphere.load("earth")
    path = written(tmp_path, "\ufeff" + json.dumps(earth))  # with a byte-order mark, as some editors write
    assert Atmosphere.load(path) == Atmosphere.load(str(path)) == Atmosphere.load(earth) == air
    assert Atmosphere.load(air) is air


def test_a_file_error_names_the_file_and_the_field(tmp_path, earth):
    path = written(tmp_path, json.dumps(changed(earth, "mie.phase.g", 2)))
    assert str(file_refusal(path)).startswith(f"{path}: mie.phase.g: found 2; allowed: ")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "atmosphere"),
        ("{", "atmosphere"),
        ("[" * 100_000, "atmosphere"),
        (b"\xff\xfe\x00", "atmosphere"),
        ("1" * 5000, "atmosphere"),
        ("null", "atmosphere"),
        ("[]", "atmosphere"),
        ('{"wavelengths_nm": [NaN], "bottom_radius_m": 1, "top_radius_m": 2}', "wavelengths_nm[0]"),
        ('{"wavelengths_nm": [1e999], "bottom_radius_m": 1, "top_radius_m": 2}', "wavelengths_nm[0]"),
        ('{"wavelengths_nm": [5], "bottom_radius_m": 1, "bottom_radius_m": 1, "top_radius_m": 2}', "bottom_radius_m"),
        (
            '{"wavelengths_nm": [5], "bottom_radius_m": 1, "top_radius_m": 2, "mie": {"phase": {"g": 0, "g": 0}}}',
            "mie.phase.g",
        ),
    ],
)
def test_files_that_are_no_description(tmp_path, text, field):
    assert file_refusal(written(tmp_path, text)).field == field


def test_a_file_that_is_too_large(tmp_path):
    assert "at most 16 MiB" in str(file_refusal(written(tmp_path, b" " * (16 * 1024**2 + 1))))


def test_files_that_are_not_there(tmp_path):
    for path in (tmp_path / "none.json", tmp_path, "a\0b.json", "x" * 5000, "", "nope", "line\nbreak"):
        error = file_refusal(path)
        assert error.field == "atmosphere" and "earth, bruneton2008, hillaire2020, mars" in str(error)
    assert "No such file" in str(file_refusal(tmp_path / "none.json"))


def test_a_source_of_the_wrong_type():
    for source in (None, 3, ["earth"], b"earth"):
        assert file_refusal(source).field == "atmosphere"


# Rays from the ground took no end: of a metre, and of a radius that single precision has none of.
@pytest.mark.parametrize(("bottom", "top", "name"), [(1.0, 6.4e6, "top_radius_m"), (1e-50, 2e-50, "bottom_radius_m")])
def test_planets_too_small_for_their_air(bottom, top, name):
    error = refusal({"wavelengths_nm": [550], "bottom_radius_m": bottom, "top_radius_m": top})
    assert error.field == name
