"""Families of real tubes and detectors: how a drawn system departs from the plain one, each to be switched by itself.

Sizes come from what makers and measurements state; where only an order of magnitude is known, the family reaches beyond it.
"""

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from ..acquisition.setting import Filter
from ..errors import InputError
from .system import LabSystem
from .tube import MODELS
from .unkindness import sample_unkindness

Draw = Callable[[LabSystem, np.random.Generator], LabSystem]


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """One family: id; title (in words); source (of its sizes); draw (the system, random numbers) -> the departed system."""

    id: str
    title: str
    source: str
    draw: Draw


def _k_escape(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    way = rng.random()
    return replace(system, k_escape_share=0.0 if way < 0.3 else 1.0 if way > 0.8 else rng.uniform(0.0, 1.0))


def _light_yield(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, light_curve=rng.uniform(0.0, 1.5))


def _cover(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    housing = Filter(material="C@1.6", thickness_mm=round(rng.uniform(0.3, 2.0), 3))
    layers = [housing] if rng.random() < 0.5 else [Filter(material="Al", thickness_mm=round(rng.uniform(0.1, 0.8), 3))]
    if rng.random() < 0.5:  # glue or foil
        layers.append(Filter(material="C10H8O4@1.38", thickness_mm=round(rng.uniform(0.05, 0.5), 3)))
    if rng.random() < 0.5:  # scintillator whose light is lost
        lost_mm = round(rng.uniform(0.0, 0.02), 4)
        layers.append(Filter(material=_with_density(system.scintillator), thickness_mm=max(lost_mm, 1e-4)))
    return replace(system, cover=tuple(layers))


def _with_density(scintillator: str) -> str:
    return scintillator if "@" in scintillator else f"{scintillator}@4.51"


def _depth_light(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, depth_light=rng.uniform(-0.2, 0.6))


def _thin_screen(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, scintillator_mm=system.scintillator_mm * rng.uniform(0.6, 1.0))


def _gadox(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    label_mm = rng.uniform(0.08, 0.25)
    drawn, departs = rng.random(), rng.uniform(0.8, 1.2)
    if drawn > 0.3:
        return system
    # what made a caesium iodide screen thinner than its label makes this one so as well
    thinner = system.scintillator_mm / LabSystem().scintillator_mm
    return replace(
        system,
        scintillator="Gd2O2S@7.32",
        scintillator_mm=label_mm * min(thinner, 1.0) * departs,
        labelled_scintillator_mm=round(label_mm, 3),
    )


def _spectrum(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, tube_model=str(rng.choice(MODELS)))


def _ripple(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    share, size = rng.random(), rng.uniform(0.5, 12.0)
    return replace(system, kV_ripple_percent=round(size, 2)) if share < 0.5 else system


def _anode(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    angle_deg = float(np.clip(round(2.0 * (system.anode_angle_deg + rng.uniform(-2.0, 2.0))) / 2.0, 6.0, 30.0))
    rough_um = rng.uniform(0.0, 4.0)
    return replace(system, anode_rough_um=rough_um, anode_angle_deg=angle_deg)


def _window(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    windows = (
        Filter(material="Be@1.848", thickness_mm=round(rng.uniform(0.1, 1.0), 3)),
        Filter(material="SiO2@2.23", thickness_mm=round(rng.uniform(0.5, 1.5), 3)),
        Filter(material="Al", thickness_mm=round(rng.uniform(0.2, 2.5), 3)),
    )
    return replace(system, inherent_filtration=(*system.inherent_filtration, windows[int(rng.integers(3))]))


def _output(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, output_exponent=0.08 * float(np.clip(rng.standard_normal(), -2.0, 2.0)))


def _spread(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    aspect = math.exp(rng.uniform(-0.12, 0.12))
    share, law, length_px = rng.uniform(0.0, 0.2), str(rng.choice(["exponential", "lorentzian"])), rng.uniform(0.6, 2.5)
    return replace(system, psf_aspect=aspect, tail_share=share, tail_law=law, tail_length_px=length_px)


def _defects(system: LabSystem, rng: np.random.Generator) -> LabSystem:
    return replace(system, bad_clusters=int(rng.integers(0, 3)), dead_lines=int(rng.integers(0, 2)))


FAMILIES: Mapping[str, Family] = {
    family.id: family
    for family in (
        Family(
            id="thin_screen",
            title="a scintillator thinner or less dense than its label",
            source="columnar CsI fills 70 to 90 % of its layer, powder screens 50 to 60 %",
            draw=_thin_screen,
        ),
        Family(
            id="gadox",
            title="a gadolinium oxysulphide screen in three of ten systems",
            source="screens of 60 to 180 mg/cm2 as makers sell them",
            draw=_gadox,
        ),
        Family(
            id="k_escape",
            title="K photons that leave the screen: none, some, or as from a bare slab",
            source="columns, substrate and cover catch some of what a slab lets go",
            draw=_k_escape,
        ),
        Family(
            id="light_yield",
            title="light that is not proportional to the deposit",
            source="lab/light.py: published curves, taken 0 to 1.5 times",
            draw=_light_yield,
        ),
        Family(
            id="depth_light",
            title="a Swank factor that depends on the energy, through light that depends on the depth",
            source="R. M. Nishikawa and M. J. Yaffe, Med. Phys. 17 (1990) 894: light falls by tens of per cent with the depth",
            draw=_depth_light,
        ),
        Family(
            id="cover",
            title="housing, glue and a dead layer in front of the scintillator",
            source="makers' sheets: carbon fibre or aluminium of 0.3 to 2 mm, foils of 0.05 to 0.5 mm",
            draw=_cover,
        ),
        Family(
            id="spectrum",
            title="bremsstrahlung of another model",
            source="the models that SpekPy offers for a reflection target",
            draw=_spectrum,
        ),
        Family(
            id="ripple",
            title="a voltage that dips between its peaks, in half of the systems",
            source="high-frequency generators 1 to 10 %, IEC 60601-2-7",
            draw=_ripple,
        ),
        Family(
            id="anode",
            title="a rough anode, and an angle that is not quite the label's",
            source="roughness of up to 10 um adds a few um of tungsten: R. Nowotny and A. Meghzifene, Phys. Med. Biol. 47 (2002)",
            draw=_anode,
        ),
        Family(
            id="window",
            title="a window of beryllium, glass or aluminium that nobody declared",
            source="tube makers' sheets",
            draw=_window,
        ),
        Family(
            id="output",
            title="output against voltage other than the model's",
            source="dose tables of tubes differ from SpekPy by some 5 % over 60 to 120 kV",
            draw=_output,
        ),
        Family(
            id="spread",
            title="light spread with tails and two widths",
            source="noise correlations of a CMOS panel: 0.12 two pixels away where a Gaussian leaves 0.06",
            draw=_spread,
        ),
        Family(
            id="defects",
            title="clusters of bad pixels and a dead line",
            source="ASTM E2597 classes of bad pixels",
            draw=_defects,
        ),
    )
}


def with_families(system: LabSystem, names: Sequence[str] | None, *, seed: int) -> LabSystem:
    """A system with departures drawn from families, each with random numbers of its own.

    Args:
        system: the plain one.
        names: of the families; None: all of them.
        seed: of the system.

    The label of the sheet stays as it was: anode angle and covers are not on it.

    Raises:
        InputError: an unknown family.
    """
    for name in names or ():
        if name not in FAMILIES:
            near = difflib.get_close_matches(name, FAMILIES, n=3, cutoff=0.4) or list(FAMILIES)
            raise InputError("family", received=repr(name), expected="a family such as " + ", ".join(near))
    for family in FAMILIES.values():
        if names is None or family.id in names:
            system = family.draw(system, np.random.default_rng([seed, crc32(family.id.encode())]))
    return system


def sample_system(rng: np.random.Generator, *, families: Sequence[str] | None = None) -> LabSystem:
    """A hidden system: tube, scintillator, light, electronics, maps and unkindness drawn around the paper's line.

    Args:
        rng: draws it. Every family has random numbers of its own, so that leaving one out changes nothing else.
        families: of departures to draw from, of `FAMILIES`; None: all of them.

    Ranges: voltage +-1 % (standard deviation, cut at 2.5 %), inherent filtration 0.4-1.4 mm Al, tube output +-10 %,
    scintillator 0.40-0.60 mm, light Swank factor 0.88-0.98, light spread 0.35-1.0 px, 10-25 electrons per keV,
    conversion +-15 %, read noise +-15 %, dark level 1100-1400 DN, 0-6 dead and hot pixels.
    """
    base = LabSystem()
    electrons_per_keV = rng.uniform(10.0, 25.0)
    DN_per_keV = base.electrons_per_keV * base.DN_per_electron * math.exp(0.15 * rng.standard_normal())
    usual = replace(
        base,
        # In steps of a quarter per cent: spectra take a second each and are kept by voltage.
        kV_offset_percent=round(4.0 * float(np.clip(rng.standard_normal(), -2.5, 2.5))) / 4.0,
        tube_output=math.exp(0.10 * rng.standard_normal()),
        inherent_filtration=(Filter(material="Al", thickness_mm=round(rng.uniform(0.4, 1.4), 3)),),
        scintillator_mm=rng.uniform(0.40, 0.60),
        light_swank=rng.uniform(0.88, 0.98),
        electrons_per_keV=electrons_per_keV,
        DN_per_electron=DN_per_keV / electrons_per_keV,
        gain_spread_percent=rng.uniform(0.8, 2.0),
        psf_sigma_px=rng.uniform(0.35, 1.0),
        read_noise_DN=base.read_noise_DN * math.exp(0.15 * rng.standard_normal()),
        dark_DN=rng.uniform(1100.0, 1400.0),
        dark_current_DN_per_ms=rng.uniform(0.01, 0.1),
        dead_pixels=int(rng.integers(0, 7)),
        hot_pixels=int(rng.integers(0, 7)),
        maps_seed=int(rng.integers(2**62)),
    )
    seeds = rng.integers(2**62, size=2)
    kind = replace(usual, unkindness=sample_unkindness(np.random.default_rng(int(seeds[0]))))
    return with_families(kind, families, seed=int(seeds[1]))
