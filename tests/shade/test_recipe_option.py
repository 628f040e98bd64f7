"""The recipe "A shading option" of CONTRIBUTING.md, followed in a copy of the package."""

import shutil
from pathlib import Path

from tests.helpers import ROOT, run_python

OPTION, MODEL = Path("mi_refgs/shade/options.py"), Path("mi_refgs/shade/reflectance/mirror.py")

CHECK = """
import sys, mi_refgs, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from mi_refgs.methods.read import dump, load, load_resolved
from mi_refgs.errors import InputError
from mi_refgs.shade.shading import Shading
from pathlib import Path
stage = load("method.toml").stage["all"]
assert stage.shading.gloss == 3 and "gloss = 3" in dump(load("method.toml"))
shading = Shading.resolve(stage.shading, mesh=False)
points = mi_refgs.shade.points.ShadingPoints(
    mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, 1), radiance=mi.Color3f(1), metallic=mi.Float(1)
)
light = mi_refgs.shade.light.constant.ConstantLight(mi.Color3f(0.5))
print(mi_refgs.shade.shading.shade(points, light, shading).total().x[0], shading.chosen())
for wrong in ({"gloss": 9}, {"gloss": 3, "reflectance": "radiance"}):
    try:
        Shading(**wrong)
    except InputError as error:
        print(error)
"""


def test_recipe_of_a_shading_option(tmp_path: Path) -> None:
    """One field and one model that honours it: method files, defaults and refusals follow."""
    for name in ("mi_refgs", "variants", "scenes", "pyproject.toml"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    for path, before, after in (
        (OPTION, "    antialias: bool", "    gloss: int = number(1, 1, 5)\n    antialias: bool"),
        (MODEL, '    light = "radiance"', '    light = "radiance"\n    honoured = ("gloss",)'),
        (MODEL, "share * light.radiance(mirror)", "options.gloss * share * light.radiance(mirror)"),
    ):
        text = (tmp_path / path).read_text()
        assert text.count(before) == 1
        (tmp_path / path).write_text(text.replace(before, after))
    (tmp_path / "method.toml").write_text(
        "iterations = 9\n[light]\nheight = 8\n[stage.all]\nuntil = 9\nreflectance = 'mirror'\ngloss = 3\n"
    )
    shaded, too_large, other_model = run_python(CHECK, folder=tmp_path, package=tmp_path).splitlines()
    assert shaded == "1.5 ['gloss']"
    assert too_large == "shading: gloss: 9 is not allowed; use a whole number 1 … 5"
    assert other_model == "shading: gloss: needs reflectance = mirror; set it"
