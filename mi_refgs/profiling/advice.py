"""Advice from a profile: sentences that follow from a measurement, and state it."""

from __future__ import annotations

from collections.abc import Iterator

from mi_refgs.methods.method import Method
from mi_refgs.profiling.profile import FAINT, Profile, StageProfile
from mi_refgs.shade.light.learnt import Learnt

# Limits beyond which there is advice.
LOW_SHARE = 0.25  # contributing part of the evaluations
THIN = 5.0  # length over width of a surfel
MANY = 0.3  # part of the surfels
HEAVY = 0.25  # part of a step
CROWDED = 0.5  # part of the machine's memory
SMALLEST_LIGHT = 32  # rows


def advice(found: Profile, method: Method) -> list[str]:
    """Sentences without repetitions."""
    lines = [*_of_work(found), *(line for stage in found.stages for line in _of_stage(stage, found, method))]
    if found.allocated > CROWDED * found.physical:
        lines.append(
            f"A step held {found.allocated / 2**30:.1f} of the machine's {found.physical / 2**30:.1f} GiB: "
            "use smaller images (--set data.downscale=2) or fewer surfels (surfels.max_count)."
        )
    return list(dict.fromkeys(lines))


def _of_work(found: Profile) -> Iterator[str]:
    work = found.work
    if work.unseen_share > MANY:
        yield (
            f"{work.unseen_share:.0%} of the surfels contribute in none of {work.views} views, and are "
            "projected and optimised all the same: start with fewer (--set surfels.count), or prune more "
            "(event.densify.prune_weight)."
        )
    if work.single_share > MANY:
        yield (
            f"{work.single_share:.0%} of the surfels that are seen never cover more than one pixel: they are "
            "smaller than the images can resolve; train with fewer (--set surfels.max_count)."
        )
    if work.share >= LOW_SHARE:
        return
    low = f"Only {work.share:.0%} of the evaluated surfel-pixel pairs contribute"
    if work.faint_share > MANY:
        yield (
            f"{low}, and {work.faint_share:.0%} of the surfels have an opacity below {FAINT:g}: prune them "
            "earlier (--set event.densify.prune_opacity=0.1)."
        )
    if work.aspect > THIN:
        yield (
            f"{low}, and the median surfel is {work.aspect:.0f} times as long as wide: it crosses many "
            f"tiles of {work.tile_pixels:.0f} pixels and fills none; a lower rate of scales "
            "(--set rates.attribute.scale) keeps surfels rounder."
        )
    if work.footprint < work.tile_pixels:
        yield (
            f"{low}, and a surfel covers {work.footprint:.1f} pixels on average, less than a tile's "
            f"{work.tile_pixels:.0f}: fewer surfels would do (--set surfels.max_count)."
        )


def _of_stage(stage: StageProfile, found: Profile, method: Method) -> Iterator[str]:
    ms = stage.phases_ms
    whole = sum(ms.values())

    def of(*names: str) -> float:
        return sum(ms.get(name, 0.0) for name in names)

    light, splat = of("prefilter forward", "prefilter backward"), of("splat forward", "splat backward")
    if light > splat and isinstance(method.light, Learnt) and method.light.height > SMALLEST_LIGHT:
        yield (
            f"Stage {stage.name}: filtering the light takes {light:.1f} ms, more than splatting "
            f"({splat:.1f} ms): halve its rows (--set light.height={method.light.height // 2})."
        )
    lists = of("tile lists", "sort")
    if lists > splat:
        yield (
            f"Stage {stage.name}: listing and sorting take {lists:.1f} ms, more than splatting "
            f"({splat:.1f} ms), for {found.work.pairs / max(found.work.surfels, 1):.0f} tiles per surfel: "
            "large, faint surfels do that (--set event.densify.prune_opacity, …prune_extent)."
        )
    if of("ssim forward", "loss backward") > HEAVY * whole and method.loss["ssim"].weight:
        yield (
            f"Stage {stage.name}: the losses take {of('ssim forward', 'loss backward') / whole:.0%} of a "
            "step: without SSIM (--set loss.ssim=0) they are cheaper, at some cost in quality."
        )
    if of("optimiser") > HEAVY * whole:
        yield (
            f"Stage {stage.name}: the optimiser takes {of('optimiser') / whole:.0%} of a step: lower the "
            "degree of the spherical harmonics (--set surfels.degree.radiance_sh)."
        )
    if stage.misses:
        yield (
            f"Stage {stage.name}: {stage.misses} kernels were compiled in steps that should be warm: run "
            "the command again, and if it stays so, report it."
        )
