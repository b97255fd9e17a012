"""The table's lines with an effect in them: a90 as the twin has it before the effect was found, with it added, and as measured.

Every effect stands in a line of its own. The line is measured with the effect in it, the diagnosis finds it and adds it to the
twin, and networks follow both twins and the measured images of another day to their a90 (`task.run_task`), at every exposure at
which the products were measured. What was planted is compared with what was found, and enters nothing.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..acquisition.acquisition_io import open_acquisition
from ..acquisition.pairs import object_pairs
from ..acquisition.setting import Setting
from ..errors import InputError
from ..generator.effects import EFFECTS
from ..generator.twins.twin_io import read_twin
from ..lab.effects import request_from_text
from ._plain import plain
from .chain import Chain, claim_folder
from .task import run_task
from .task_plan import TaskInput, TaskPlan

SESSION, PRODUCTS, DIAGNOSIS = "session.h5", "products.h5", "diagnosis"
USUAL_EFFECTS = ("object_scatter=20", "motion_blur=4", "veiling_glare=3")  # clear ones, within plausible ranges
_BONES_MM = "1,1.5,2,2.5,3,4"
_TAKEN = ("before", "after", "real")


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectsPlan:
    """Which effects stand in a line, and how large each one's trial is.

    Fields: effects (ID=STRENGTH[@always|@calibration] each, as `raytwin lab` takes them); networks of each kind at each exposure;
    products measured on another day, half of them to try networks on; size (pixels, side of the detector); frames a series of
    the session that is diagnosed; seed.

    Example:
        >>> EffectsPlan(effects=("motion_blur=4", "heel=5@calibration")).names
        ('motion_blur', 'heel')
    """

    effects: tuple[str, ...] = USUAL_EFFECTS
    networks: int = 3
    products: int = 240
    size: int = 128
    frames: int = 50
    seed: int = 1

    def __post_init__(self) -> None:
        for name, least in (("networks", 1), ("products", 16), ("size", 32), ("frames", 2)):
            if getattr(self, name) < least:
                raise InputError(
                    f"{name} of lines with an effect",
                    received=getattr(self, name),
                    expected=f"a whole number, {least} or more",
                )
        asked = [request_from_text(one) for one in self.effects]
        for one in asked:
            if one.id not in EFFECTS or one.strength == 0.0:
                raise InputError(
                    "--effect",
                    received=f"{one.id}={one.strength:g}",
                    expected="an effect that a diagnosis can name, at a strength that is not 0",
                )
        if len(set(self.names)) < len(asked):
            raise InputError("--effect", received=", ".join(self.names), expected="each effect once")

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(request_from_text(one).id for one in self.effects)


def run_effect(plan: EffectsPlan, asked: str, *, chain: Chain, device: str) -> dict[str, Any]:
    """One line with an effect in it, or what an earlier run of it left, gone on with.

    Args:
        plan: sizes.
        asked: one of `plan.effects`.
        chain: of the table; the line lies in its folder `effects/<id>`.
        device: of the networks.

    Returns:
        `effect`, `strength`, `unit` as planted; `found`: verdict, names, and strength of the planted effect with its 95 % interval
        where it was named; `gap` before, after and floor; `rows`, an exposure each, shortest first: `exposure_ms`, `before`, `after`
        and `real` (a90, a90_95), `before_less_real` and `after_less_real` (difference of a90 with its 95 % interval), `objects` that
        networks were tried on, `warnings`.

    Raises:
        InputError: the folder holds a line of another plan; the lab has no such effect.
        RaytwinError: a step failed; what is finished is kept.
    """
    one = replace(plan, effects=(asked,))
    (effect,) = one.names
    folder = chain.directory / "effects" / effect
    claim_folder(folder, plain(asdict(one)), what="a line")
    own = replace(chain, directory=folder)
    at = own.path
    words = ["--effect", asked, *f"--family none --no-unkindness --size {plan.size} --seed {plan.seed}".split()]
    truth = own.step(
        "lab_session",
        ["lab", "-o", at(SESSION), "--protocol", "full", "--frames", str(plan.frames), *words],
        outputs=[SESSION],
    )
    # a tenth of the frames for each product: two
    of_products = (
        f"--protocol products --session 1 --products {plan.products} --frames 20 --bones-mm {_BONES_MM}".split()
    )
    own.step("lab_products", ["lab", "-o", at(PRODUCTS), *of_products, *words], outputs=[PRODUCTS])
    answer = own.step(
        "diagnose",
        ["diagnose", at(SESSION), "-o", at(DIAGNOSIS), "--seed", str(plan.seed)],
        outputs=[f"{DIAGNOSIS}/twin.h5"],
    )
    after = read_twin(folder / DIAGNOSIS / "twin.h5")
    before = replace(after, effects=())
    rows = []
    for low, high in _settings(folder / PRODUCTS):
        name = f"task_{low.exposure_ms:g}ms"
        found = run_task(
            before,
            after,
            TaskInput(measured=folder / PRODUCTS, low=low, high=high),
            folder / name,
            plan=TaskPlan(networks=plan.networks, seed=plan.seed),
            device=device,
            tell=lambda line, name=name: chain.tell(f"{effect}, {name}: {line}"),  # type: ignore[misc]
        )
        rows.append({"exposure_ms": low.exposure_ms, **row_of_task(found)})
    planted = truth["effects"][effect]
    return {
        "effect": effect,
        "strength": planted["strength"],
        "unit": planted["unit"],
        "found": found_of(answer, effect),
        "gap": {key: answer["gap"][key] for key in ("before", "after", "floor")},
        "rows": rows,
    }


def row_of_task(task: Mapping[str, Any]) -> dict[str, Any]:
    """What a row holds of a task's answer: the three a90 and how far the twin's lie from the measured one."""
    compared = task["compare"]
    # with nothing found, or nothing of it in images, both twins are one
    after = compared.get("after_against_real") or compared.get("before_against_real")
    return {
        **{name: {"a90": task[f"a90_{name}"], "a90_95": task[f"a90_{name}_95"]} for name in _TAKEN},
        "before_less_real": (compared.get("before_against_real") or {}).get("difference_a90"),
        "after_less_real": (after or {}).get("difference_a90"),
        "objects": task["curves"]["before_on_before"]["objects"],
        "warnings": list(task["warnings"]),
    }


def found_of(answer: Mapping[str, Any], effect: str) -> dict[str, Any]:
    """What the diagnosis says: verdict, the effects it names, and the strength of the planted one (None: not named)."""
    named = answer["causes"] if answer["verdict"] in ("explained", "explained_in_part") else []
    own = next((cause for cause in named if cause["effect"] == effect), None)
    return {
        "verdict": answer["verdict"],
        "named": [cause["effect"] for cause in named],
        "strength": None if own is None else own["parameters"]["strength"],
        "probability": None if own is None else own["probability"],
    }


def _settings(products: Path) -> list[tuple[Setting, Setting]]:
    """Low and high setting at every exposure at which all products were measured, shortest first."""
    with open_acquisition(products) as acquisition:
        pairs = {pair.settings for pair in object_pairs(acquisition)}
    return sorted(pairs, key=lambda pair: pair[0].exposure_ms)
