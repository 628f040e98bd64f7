"""The recipe of a loss in CONTRIBUTING.md, followed line by line: it can be copied."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs import methods
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import LOSSES
from mi_refgs.types import Float
from tests.helpers import refused
from tests.scenes.highlight import step_to, without

SETTINGS = ["iterations=30", "surfels.count=80", "surfels.max_count=100", "stage.initial.until=1"]


def rough(inputs: mi_refgs.LossInputs) -> Float | None:
    """Mean over all pixels of A (1 - r): 0 where every surface is rough."""
    roughness = inputs.frame.maps.get("roughness")
    if roughness is None:  # forward stages blend no materials
        return None
    return dr.mean(dr.detach(inputs.frame.object_alpha) * (1 - roughness))


@contextmanager
def registered(name: str, *value: Any, **reads: Any) -> Iterator[None]:
    mi_refgs.register_loss(mi_refgs.Loss(name, *value, **reads))
    try:
        yield
    finally:
        LOSSES.unregister(name)


def trainer_of(data: Path, method: Path, *settings: str) -> Trainer:
    chosen = methods.load(str(method), "quick", [*SETTINGS, *settings])
    return Trainer(without(chosen), read_dataset(data, "train", truth=False))


def roughness_after(data: Path, method: Path, *settings: str) -> float:
    """Mean raw roughness after some steps of the deferred stage."""
    return float(np.mean(step_to(trainer_of(data, method, *settings), 12).surfels.to_numpy()["roughness"]))


def test_registered_loss_is_weighed_by_method_file(data: Path, method: Path) -> None:
    weights = "1.0", "{weight=1.0, start=12}", "{weight=1.0, until=6}"
    with registered("rough", rough, maps=True, attributes=("roughness",)):
        without = roughness_after(data, method)
        weighed, late, early = (roughness_after(data, method, f"loss.rough={weight}") for weight in weights)
    assert weighed > without + 0.02 and late == pytest.approx(without, abs=1e-4)
    assert without < early < weighed


def test_loss_sees_attributes_that_the_model_does_not_shade(data: Path, method: Path) -> None:
    seen = list[bool]()

    def sure(inputs: mi_refgs.LossInputs) -> None:
        seen.append("confidence" in inputs.frame.maps)

    with registered("sure", sure, maps=True, attributes=("confidence",)):
        names = ["radiance_sh", "albedo", "metallic", "roughness", "indirect_sh", "confidence"]
        step_to(trainer_of(data, method, "loss.sure=1.0", f"surfels.attributes={names}"), 3)
    assert seen == [False, True, True]  # forward, then deferred shading


def test_photometric_loss_is_replaced_or_required(data: Path, method: Path) -> None:
    """L1 and SSIM are losses like others: without them a step lowers what is left."""

    def squared(inputs: mi_refgs.LossInputs) -> Float:
        pairs = zip(inputs.image, inputs.target.image, strict=True)
        return sum((dr.mean(dr.square(a - b)) for a, b in pairs), mi.Float(0)) / 3

    with registered("squared", squared):
        none = ["loss.l1=0", "loss.ssim=0", "loss.normal=0"]
        trainer = step_to(trainer_of(data, method, *none, "loss.squared=1"), 1)
        assert float(trainer.loss[0]) == pytest.approx(float(trainer.error[0]), rel=1e-5)
        refused(trainer_of(data, method, *none).step, "loss: none in iteration 1; give one a weight")


def test_loss_per_pixel_or_of_no_name_is_refused(data: Path, method: Path) -> None:
    wrong: Any = (lambda of: of.frame.alpha, "type Float, from"), (lambda of: 0.5, "1 of type float")
    for value, words in wrong:
        with registered("wrong", value):
            refused(lambda: roughness_after(data, method, "loss.wrong=1.0"), "loss.wrong: ", words)
    refused(lambda: roughness_after(data, method, "loss.rough=1.0"), "loss.rough: 'rough' is unknown; use l1")


@pytest.mark.parametrize("name", ["l1", "normal", "a.b", "a b", ""])
def test_loss_that_a_method_file_cannot_name_is_refused(name: str) -> None:
    with pytest.raises(mi_refgs.InputError, match="choose another name"):
        mi_refgs.register_loss(mi_refgs.Loss(name, rough))
    assert name in ("l1", "normal") or name not in LOSSES
