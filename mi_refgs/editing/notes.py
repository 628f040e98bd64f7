"""What of a fit was found under its own light and place, and so stays as it was when the rest is edited."""

from __future__ import annotations

from mi_refgs.editing.change import Change
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.reflectance.split_sum import MATERIALS

CONVERT, TRACE = "; --materials makes an albedo of it", "; --materials traces it instead"


def notes(scene: TrainedScene, change: Change, joined: bool = False) -> list[str]:
    """Sentences for people about a change of a scene; none where all of it follows."""
    shading, surfels = scene.shading, scene.surfels
    indirect = shading.occlusion and surfels.has("indirect_sh") and not shading.accuracy.traced_bounces
    read = {*shading.model.channels(shading.diffuse), *surfels.primitive.widths}
    read |= {"indirect_sh"} if indirect else set()
    names = [assignment.name.partition(".")[0] for assignment in change.set]
    placed = (
        joined
        or any(given is not None for given in (change.move, change.rotate, change.duplicate))
        or change.scale != 1
    )
    channels = ["radiance_sh" if name == "colour" else name for name in names]
    found = [
        f"{name}: no picture of this run depends on it (its shading is {shading.reflectance}, "
        f"{shading.diffuse})"
        for name, channel in zip(names, channels, strict=True)
        if channel not in read
    ]
    lit = shading.model.light != "none" and "radiance_sh" in read
    able = scene.light is not None and all(surfels.has(name) for name in MATERIALS)
    convert = CONVERT if able and lit else ""
    traced = TRACE if able else ""
    if lit and {*names} & {"albedo", "metallic"}:
        found.append(
            "the diffuse colour was fitted to the light as radiance_sh and stays so: albedo and metallic "
            f"change what is reflected, colour= changes it{convert}"
        )
    if placed and "radiance_sh" in read:
        found.append(f"the colour radiance_sh keeps the light of the place where it was fitted{convert}")
    if indirect and (placed or change.cut or change.keep or {*names} - {"roughness"}):
        found.append(f"what the object reflects of itself, indirect_sh, stays as it was fitted{traced}")
    return found
