"""Derivatives of mi.render by every parameter; `python -m tests.gradients` writes the table of scripting.md.

Errors are those against central differences of images, in both modes, with one and two threads; 5e-3 is what
differences of float32 images resolve."""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.helpers import ROOT, refused
from tests.scenes import integrator as scenes
from tests.scenes.integrator import COUNT, raw_channels, sensor

PAGE = ROOT / "docs/scripting.md"
TABLE = re.compile(r"(?<=<!-- gradients -->\n).*?(?=<!-- / -->)", re.DOTALL)
HEAD = ["| parameter | forward | backward | worst relative error |", "|---|---|---|---|"]


def gaussian_shader(_: Path) -> mi.Scene:
    rng = np.random.default_rng(5)
    more = {name: rng.normal(size=(COUNT, 3)).astype(np.float32) for name in ("tint", "normal_offset")}
    return scenes.scene(raw=raw_channels() | more, reflectance="gaussian_shader")


def surfels(folder: Path) -> mi.Scene:
    rng, raw = np.random.default_rng(6), raw_channels()
    raw |= {x: rng.normal(size=(COUNT, k)).astype("f4") for x, k in (("curvature", 3), ("confidence", 1))}
    return scenes.open_scene(raw=raw, mesh=scenes.plane_mesh(folder), aovs="n:normal,d:depth,c:confidence")


def traced(folder: Path) -> mi.Scene:
    raw = {name.replace("indirect", "residual"): values for name, values in raw_channels().items()}
    return scenes.scene(raw=raw, mesh=scenes.plane_mesh(folder), traced_bounces=1)


def emitters(_: Path) -> mi.Scene:
    turned = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 40)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(scenes.sky()), "to_world": turned}
    sun = {"type": "directional", "direction": [-1, -1, -0.5]}
    return scenes.lit_scene(sky, {"sun": sun}, diffuse="irradiance")


def ignored(folder: Path) -> mi.Scene:
    """Refused: a shape, a lamp, and an environment beside the integrator's."""
    mi.load_dict({"type": "rectangle"}).write_ply(str(folder / "plane.ply"))
    plane = {"type": "ply", "filename": str(folder / "plane.ply")}
    return scenes.scene(more={"unused": {"type": "constant"}, "lamp": {"type": "point"}, "mesh": plane})


def path_traced(_: Path) -> mi.Scene:
    """A ball of `refgs_bsdf`. Its material has no influence on samples of the light: differences agree."""
    texels = np.random.default_rng(2).random((4, 4, 3), np.float32)
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}
    ball = {"type": "sphere", "b": {"type": "refgs_bsdf", "albedo": texture, "metallic": 0.4}}
    direct = {"type": "direct", "bsdf_samples": 0, "emitter_samples": 4}
    made = {"type": "scene", "integrator": direct, "sensor": sensor(), "ball": ball}
    return mi.load_dict(made | {"sky": {"type": "constant"}})


SCENES: dict[str, tuple[Callable[[Path], mi.Scene], str]] = {
    "refgs_bsdf": (path_traced, "ball.bsdf."),
    "surfels": (surfels, ""),
    "traced": (traced, "integrator.r"),
    "Gaussian shader": (gaussian_shader, "integrator."),
    "emitters": (emitters, "s"),
    "constant": (lambda _: scenes.lit_scene({"type": "constant"}), "sky."),
    "ignored": (ignored, ""),
}
"""What makes each scene, and the beginning of the keys that it adds to the table."""


def parameters(folder: Path) -> Iterator[tuple[str, mi.Scene, bool]]:
    """Every parameter that can have gradients, the first scene that has it, and whether it has some."""
    seen: set[str] = set()
    for name, (make, prefix) in SCENES.items():
        of = make(folder)
        new = [key for key in differentiable(of) if key.startswith(prefix) and key not in seen]
        assert new, name
        yield from ((key, of, name != "ignored") for key in new)
        seen |= {*new}


def differentiable(of: mi.Scene) -> list[str]:
    """The parameters whose types can have gradients."""
    values = {key: getattr(value, "matrix", value) for key, value in mi.traverse(of).items()}
    return [key for key, value in values.items() if dr.is_diff_v(value) and dr.is_float_v(value)]


def refusals(of: mi.Scene, key: str) -> set[str]:
    """The sentences with which both modes refuse a parameter, after its name."""
    params, found = mi.traverse(of), set()
    dr.enable_grad(params[key])
    params.update()
    for derive in (dr.forward_to, dr.backward):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of emitters and shapes that are not used
            image = mi.render(of, params)
        message = refused(lambda: derive(image), "has no derivative")  # noqa: B023
        found.add(re.search(rf"mi\.render: {re.escape(key)}: (.*)", message)[1])  # type: ignore[index]
    dr.disable_grad(params[key])
    params.update()
    return found


def table() -> str:
    """Measure every parameter; return what belongs between the marks of PAGE."""
    rows, threads = [*HEAD], dr.thread_count()
    with tempfile.TemporaryDirectory() as folder:
        for key, of, able in parameters(Path(folder)):
            if not able:
                [sentence] = refusals(of, key)
                rows.append(f"| `{key}` | refused | refused | {sentence} |")
                continue
            worst = 0.0
            for count in (1, 2):
                dr.set_thread_count(count)
                worst = max(worst, *scenes.parameter_errors(of, key))
            dr.set_thread_count(threads)
            assert worst < scenes.TANGENT_TOLERANCE, (key, worst)
            rows.append(f"| `{key}` | yes | yes | {worst:.0e} |")
    return "\n".join([*rows, ""]).replace("`integrator.", "`refgs.")


def listed() -> dict[str, str]:
    """The last column of the table in PAGE, by parameter."""
    rows = TABLE.search(PAGE.read_text(encoding="utf-8"))[0].splitlines()[len(HEAD) :]  # type: ignore[index]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return {row[0].strip("`").replace("refgs.", "integrator."): row[-1] for row in cells}


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    PAGE.write_text(TABLE.sub(lambda _: table(), PAGE.read_text(encoding="utf-8")), encoding="utf-8")
