"""Settings, filters and the instrument: text round trips, and one clear line for what cannot be."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import (
    Filter,
    Instrument,
    Setting,
    filter_from_text,
    filters_from_text,
    setting_from_text,
    text_from_filters,
)
from raytwin.errors import InputError

positive = st.floats(min_value=1e-6, max_value=1e6, allow_nan=False, allow_infinity=False)
materials = st.sampled_from(["Cu", "Al", "water_liquid", "Gd2O2S@7.32", "bone_cortical_icru44", "C6H6@0.88"])
filters = st.builds(Filter, material=materials, thickness_mm=st.floats(min_value=0, max_value=1e4))


@st.composite
def settings_of_a_line(draw):
    load = draw(st.sampled_from(["current_mA", "power_W", None]))
    return Setting(
        kV=draw(positive),
        exposure_ms=draw(positive),
        filters=tuple(draw(st.lists(filters, max_size=3))),
        averaged=draw(st.integers(1, 10_000)),
        source_detector_mm=draw(st.none() | positive),
        **({} if load is None else {load: draw(positive)}),
    )


@given(settings_of_a_line())
def test_a_setting_comes_back_from_its_text(setting):
    assert setting_from_text(str(setting)) == setting


@given(st.lists(filters, max_size=4))
def test_filters_come_back_from_their_text_in_order(layers):
    assert filters_from_text(text_from_filters(layers)) == tuple(layers)


def test_the_text_of_a_setting_is_the_grammar_of_the_command_line():
    setting = setting_from_text(
        "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05+Al:1,averaged=10,source_detector_mm=1059"
    )
    assert setting == Setting(
        kV=40,
        power_W=40,
        exposure_ms=20,
        filters=(Filter(material="Cu", thickness_mm=0.05), Filter(material="Al", thickness_mm=1)),
        averaged=10,
        source_detector_mm=1059,
    )
    assert str(setting) == "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05+Al:1,averaged=10,source_detector_mm=1059"
    assert str(replace(setting, averaged=10.0)) == str(setting)


def test_words_of_a_setting_may_come_in_any_order_and_case():
    assert setting_from_text(" exposure_ms = 20 , KV=40,Current_mA=1") == Setting(kV=40, exposure_ms=20, current_mA=1)


def test_load_is_power_over_voltage_times_time():
    setting = Setting(kV=40, power_W=40, exposure_ms=100)
    assert setting.tube_current_mA == pytest.approx(1.0)
    assert setting.tube_load_mAs == pytest.approx(0.1)
    assert Setting(kV=40, exposure_ms=100).tube_load_mAs is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kv=40", "setting: got 'kv=40'; expected exposure_ms=... among its words"),
        ("exposure_ms=20", "expected kv=... among its words"),
        ("kv=40,exposure_ms=20,kv=50", "at most once"),
        ("kv=40,exposure_ms=20,colour=red", "'colour=red'"),
        ("kv=forty,exposure_ms=20", "setting, kv: got 'forty'; expected a number"),
        ("kv=40,exposure_ms=-20", "exposure_ms: got -20.0 ms; expected a finite value above 0 ms"),
        ("kv=nan,exposure_ms=20", "kV: got nan kV"),
        ("kv=40,exposure_ms=1e300", "exposure_ms: got 1e+300 ms; expected a finite value above 0 ms, 1e-12 to 1e+12"),
        (
            "kv=40,exposure_ms=20,source_detector_mm=1e-200",
            "source_detector_mm: got 1e-200 mm; expected a finite value",
        ),
        ("kv=40,exposure_ms=20,filter=Cu", "filter: got 'Cu'; expected MATERIAL:mm"),
        ("kv=40,exposure_ms=20,filter=Cu:-1", "thickness of filter Cu: got -1.0 mm"),
        ("kv=40,exposure_ms=20,averaged=0", "averaged: got 0; expected a whole number of frames"),
        ("kv=40,exposure_ms=20,averaged=1.5", "expected a whole number"),
        ("kv=40,exposure_ms=20,power_w=40,current_ma=2", "expected power = kV x mA = 80 W within 1 %"),
        ("", "setting: got"),
    ],
)
def test_a_setting_that_cannot_be_says_what_was_given_and_expected(text, message):
    with pytest.raises(InputError) as caught:
        setting_from_text(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("filters", ["Cu:0.05", 5, ("Cu:0.05",), None])
def test_the_filters_of_a_setting_are_filters(filters):
    with pytest.raises(InputError, match=r"filters: got .*; expected a tuple of filters, such as"):
        Setting(kV=40, exposure_ms=20, filters=filters)


def test_a_filter_needs_a_name_that_the_grammar_can_hold():
    assert filter_from_text("Gd2O2S@7.32:0.2") == Filter(material="Gd2O2S@7.32", thickness_mm=0.2)
    with pytest.raises(InputError, match="filter material: got 'a,b'"):
        Filter(material="a,b", thickness_mm=1)


@pytest.mark.parametrize(
    ("field", "value"),
    [("pixel_mm", 0.0), ("pixel_mm", math.nan), ("source_detector_mm", -1.0), ("bits", 0), ("readout_ms", -0.1)],
)
def test_an_instrument_refuses_numbers_out_of_range(field, value):
    with pytest.raises(InputError, match=f"instrument {field}: got .*; expected a finite positive number"):
        Instrument(**{field: value})


def test_an_instrument_has_no_more_bits_than_detectors_write():
    assert Instrument(bits=32).bits == 32
    with pytest.raises(InputError, match="instrument bits: got 33; expected a whole number from 1 to 32"):
        Instrument(bits=33)


def test_an_instrument_knows_its_words():
    with pytest.raises(InputError, match="expected one of area, line, tdi"):
        Instrument(detector="plane")
    with pytest.raises(InputError, match="instrument belt_axis: got diagonal"):
        Instrument(belt_axis="diagonal")


def test_magnification_is_the_quotient_of_the_distances():
    assert Instrument(source_object_mm=990, source_detector_mm=1059).magnification == pytest.approx(1059 / 990)
    assert Instrument(source_object_mm=990).magnification is None
