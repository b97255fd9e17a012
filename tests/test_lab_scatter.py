"""Scatter photon by photon against the integral of single scatter, and its laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
import xraydb

from raytwin.lab import LabSystem
from raytwin.lab.attenuation import mu_per_mm
from raytwin.lab.response import Incidence
from raytwin.lab.scatter import (
    HALF_SINES,
    LOWEST_KEV,
    STEP_KEV,
    TALLY,
    class_rates,
    scatter_tables,
    scattered_photons,
    smooth_map,
)

KEV = 60.0
SYSTEM = LabSystem(rows=64, columns=64, pixel_mm=0.8, source_object_mm=650.0, source_detector_mm=1000.0)


def one_energy(keV=KEV):
    return Incidence(
        photons_per_mAs=np.array([1000.0]),
        group_keV=np.array([keV]),
        class_share=np.array([[1.0]]),
        deposit_keV=np.array([keV]),
        mu_of={},
    )


def scattered_by(layers_mm, *, system=SYSTEM, seed=1, histories=262_144, **more):
    fine = {name: np.full((192, 192), length, dtype=np.float32) for name, length in layers_mm.items()}
    return scattered_photons(system, one_energy(), fine, rng=np.random.default_rng(seed), histories=histories, **more)


def single_scatter_of_water(thickness_mm, system, *, keV=KEV):
    """Photons scattered once per photon of the open beam and pixel, at the detector's middle: a sum over the slab.

    Everything is written anew: Klein and Nishina, form factors of free oxygen and hydrogen, attenuation of the way in
    and of the way out at the energy left.
    """
    alpha = keV / 510.998950
    r_e_mm = 2.8179403262e-12
    per_mm3 = 0.998 / 18.015 * 6.02214076e23 / 1000.0  # molecules
    rays = 160
    scale = system.pixel_mm / system.magnification
    half = 0.5 * system.rows * scale
    place = (np.arange(rays) + 0.5) / rays * 2.0 * half - half
    y, x = np.meshgrid(place, place, indexing="ij")
    area = (2.0 * half / rays) ** 2
    source, gap = system.source_object_mm, system.source_detector_mm - system.source_object_mm
    mu = float(mu_per_mm("water", np.array([keV]))[0])
    layers = 24
    total = 0.0
    # The cross section that belongs to the tables: scattering is Chantler's total less the photoelectric part.
    fractions = {"H": 2.0 * 1.00794 / 18.015, "O": 15.9994 / 18.015}
    photo = sum(w * float(xraydb.mu_chantler(el, keV * 1000.0, photo=True)) for el, w in fractions.items()) * 0.0998
    cosines = np.linspace(-1.0, 1.0, 4001)

    def law(cosine):
        kept = 1.0 / (1.0 + alpha * (1.0 - cosine))
        q = np.sqrt(np.maximum(0.5 * (1.0 - cosine), 0.0)) * keV / 12.398419843
        klein_nishina = 0.5 * r_e_mm**2 * kept**2 * (kept + 1.0 / kept - 1.0 + cosine**2)
        thomson = 0.5 * r_e_mm**2 * (1.0 + cosine**2)
        found = 0.0
        for element, number in (("H", 2), ("O", 1)):
            z = xraydb.atomic_number(element)
            factor = xraydb.f0(element, q.ravel()).reshape(q.shape)
            found = found + number * (thomson * factor**2 + klein_nishina * z * np.maximum(1 - (factor / z) ** 2, 0))
        return found, kept

    integral = np.trapezoid(law(cosines)[0], cosines) * 2.0 * math.pi * per_mm3
    correction = (mu - photo) / integral
    for layer in range(layers):
        depth = (layer + 0.5) / layers * thickness_mm
        z = thickness_mm - depth
        way_in = np.sqrt(x**2 + y**2 + source**2)
        out = np.sqrt(x**2 + y**2 + (gap + z) ** 2)
        cosine = (x * -x + y * -y + source * (gap + z)) / way_in / out
        density, kept = law(cosine)
        mu_out = np.interp(kept * keV, np.linspace(20.0, 80.0, 301), mu_per_mm("water", np.linspace(20.0, 80.0, 301)))
        arriving = density * per_mm3 * correction * (thickness_mm / layers)
        arriving *= np.exp(-mu * depth - mu_out * z * out / (gap + z)) * (gap + z) / out / out**2
        total += arriving.sum() * area
    # One primary photon of the open beam per pixel of the detector is one per pixel's area in the object's plane.
    return total / scale**2 * system.pixel_mm**2


@pytest.mark.parametrize(
    ("thickness_mm", "gap_mm"),
    [
        pytest.param(2.0, 350.0, marks=pytest.mark.slow),
        pytest.param(20.0, 350.0, marks=pytest.mark.slow),
        (20.0, 100.0),
    ],
)
def test_single_scatter_of_a_slab_is_its_integral(thickness_mm, gap_mm):
    system = replace(SYSTEM, source_object_mm=1000.0 - gap_mm)
    found = scattered_by({"water": thickness_mm}, system=system)[0].sum(axis=2)
    middle = smooth_map(found, (17, 17))[8, 8] / 1000.0
    expected = single_scatter_of_water(thickness_mm, system)
    # Statistics of the histories about 1.5 %; energies in steps of 2 keV.
    assert middle == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_scatter_is_proportional_to_a_thin_slab_and_falls_with_the_gap():
    thin, thicker = (scattered_by({"water": length}).sum() for length in (1.0, 2.0))
    assert thicker / thin == pytest.approx(2.0, rel=0.06)
    sums = []
    for source_object_mm in (500.0, 700.0, 900.0):
        sums.append(scattered_by({"water": 20.0}, system=replace(SYSTEM, source_object_mm=source_object_mm)).sum())
    assert sums[0] < sums[1] < sums[2]


@pytest.mark.slow
def test_more_collisions_only_add_and_count_for_more_in_thick_objects():
    thin, thick = (scattered_by({"water": length}) for length in (5.0, 60.0))
    assert thin[1].sum() / thin[0].sum() < thick[1].sum() / thick[0].sum()
    once = scattered_by({"water": 60.0}, orders=1)
    assert not once[1].any() and once[0].sum() == pytest.approx(thick[0].sum(), rel=0.02)


@pytest.mark.slow
def test_compton_scatter_loses_energy_and_none_is_gained():
    energies = LOWEST_KEV + STEP_KEV * np.arange(scattered_by({"water": 20.0}).shape[3])
    spectrum = scattered_by({"water": 20.0}).sum(axis=(0, 1, 2))
    assert np.all(spectrum[energies > KEV + STEP_KEV] == 0)
    # Four collisions straight back leave 60 / (1 + 8 x 60 / 511) = 31 keV.
    assert spectrum[energies < 30.0].sum() == 0
    mean_keV = spectrum @ energies / spectrum.sum()
    assert 52.0 < mean_keV < KEV


def test_nothing_in_the_beam_scatters_nothing():
    assert not scattered_by({"water": 0.0}).any()


def test_a_seed_gives_the_same_numbers_and_another_one_others():
    first, again, other = (scattered_by({"water": 9.0}, seed=seed, histories=8192) for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("material", ["water", "chicken_breast", "Al", "W"])
def test_tables_are_densities_of_their_own_cumulated_laws(material):
    tables = scatter_tables(material, 40)
    for density, cumulated in (
        (tables.coherent_density, tables.coherent_cumulated),
        (tables.incoherent_density, tables.incoherent_cumulated),
    ):
        assert np.trapezoid(density * HALF_SINES, HALF_SINES, axis=1) * 8 * math.pi == pytest.approx(np.ones(40))
        assert np.all(np.diff(cumulated, axis=1) >= 0) and cumulated[:, -1] == pytest.approx(np.ones(40))
    assert np.all((tables.scattered >= 0) & (tables.scattered <= 1))
    # Coherent scattering looks ahead, the more the higher the energy.
    forward = tables.coherent_density[:, 0] / tables.coherent_density[:, -1]
    assert forward[30] > forward[5] > 1


def test_share_of_coherent_scattering_agrees_with_the_tables_of_elam():
    energy_keV = LOWEST_KEV + STEP_KEV * np.arange(40)
    ours = scatter_tables("water", 40).coherent
    coherent, incoherent = (
        sum(w * xraydb.mu_elam(el, energy_keV * 1000.0, kind=kind) for el, w in (("H", 0.1119), ("O", 0.8881)))
        for kind in ("coh", "incoh")
    )
    chosen = energy_keV >= 20.0
    # The incoherent function 1 - (F / Z)^2 is rough: within a few per cent of all that scatters.
    assert np.abs(ours - coherent / (coherent + incoherent))[chosen].max() < 0.06


def test_smooth_map_keeps_a_smooth_map_and_class_rates_keep_photons():
    cells = 1.0 + 0.3 * np.cos(np.pi * (np.arange(TALLY) + 0.5) / TALLY)[:, None] * np.ones((1, TALLY))
    fine = smooth_map(cells, (128, 96))
    assert fine.shape == (128, 96)
    assert fine.reshape(TALLY, 8, TALLY, 6).mean(axis=(1, 3)) == pytest.approx(cells, rel=2e-3)
    spectrum = np.ones(40)
    assert class_rates(one_energy(), spectrum).sum() == pytest.approx(40.0)


def test_a_smooth_map_falls_to_the_borders_as_what_it_was_made_of():
    def dome(length):
        x = (np.arange(length) + 0.5) / length * 2.0 - 1.0
        return 1.0 / (1.0 + 0.5 * (x[:, None] ** 2 + x[None, :] ** 2)) ** 1.5

    fine = dome(128)
    made = smooth_map(fine.reshape(TALLY, 8, TALLY, 8).mean(axis=(1, 3)), (128, 128))
    # means of cells stand for their middles: half a percent at the steepest place
    np.testing.assert_allclose(made, fine, rtol=0.01)
