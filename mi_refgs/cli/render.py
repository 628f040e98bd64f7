"""`refgs render`: scenes that Mitsuba's own command line, which has no Python, cannot render."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Cameras, Flag, Output, Rendering, Result, optional, separated
from mi_refgs.errors import InputError, counted, require_between


@dataclass(frozen=True, kw_only=True)
class Render:
    """A run is rendered from the camera of its scene.xml.

    example:
      refgs render runs/glossy -o glossy.exr --aov albedo normal"""

    scene: Annotated[Positional[Path], arg(metavar="RUN|SCENE.xml")]  # run folder, or Mitsuba scene
    output: Output  # image: .exr (linear, premultiplied alpha) or .png (sRGB, straight alpha)
    sensor: Annotated[int, arg(metavar="I")] = 0
    """number of the sensor of the scene, or of the camera in --camera"""
    camera: Cameras = None  # cameras in the form of transforms.json, such as the page of `refgs view` saves
    object: Flag = False  # render the object without its background, on transparency
    samples: Annotated[int | None, optional("N")] = None
    """samples per pixel (default: those of the scene's sampler)"""
    aov: Annotated[tuple[str, ...], optional("NAME …")] = ()
    """more channels of the EXR: albedo, metallic, confidence, roughness, normal, depth, alpha, visibility,
    diffuse, specular, indirect"""
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.data.dataset import require_no_data
        from mi_refgs.formats.cameras import read_cameras
        from mi_refgs.io.ownership import require_no_run
        from mi_refgs.io.progress import warn
        from mi_refgs.render.scene_xml import has_square_pixels, sensors_of
        from mi_refgs.runs.run import Run

        out = self.output  # refused before the scene is read
        if out.suffix.lower() not in (".exr", ".png"):
            raise InputError(f"'{out.suffix}': no known image format", out, "suffix", "use .exr or .png")
        if self.aov and out.suffix.lower() == ".png":
            raise InputError("a PNG file has room for colour and alpha only", out, "--aov", "use .exr")
        if not out.parent.is_dir():
            remedy = "create it or choose a writable folder"
            raise InputError("its folder does not exist", out, "output", remedy)
        require_no_run(out)
        require_no_data(out)
        require_between(1 if self.samples is None else self.samples, "--samples", 1)
        run = Run(self.scene if self.scene.is_dir() else self.scene.parent)
        cameras = None if self.camera is None else read_cameras(self.camera, run.offset() or (0, 0, 0))
        scene = read(self.scene, separated(self.aov), self.object)
        own = scene.sensors()
        sensors = own if cameras is None else sensors_of(cameras)
        if not sensors:
            remedy = "add one, or give a file with --camera"
            raise InputError("the scene has none", self.scene, "sensor", remedy)
        if not 0 <= self.sensor < len(sensors):
            found = counted(len(sensors), "sensor" if cameras is None else "frame")
            what = f"{self.sensor}: the {'scene' if cameras is None else 'file'} has {found}"
            remedy = f"give 0 to {len(sensors) - 1}"
            raise InputError(what, self.camera or self.scene, "--sensor", remedy)
        sensor, samples = sensors[self.sensor], self.samples or 0
        if not samples and cameras is not None and own:
            samples = own[0].sampler().sample_count()
        names = write(scene, sensor, samples, out)
        width, height = (int(x) for x in sensor.film().crop_size())
        camera = cameras[self.sensor] if cameras else None
        if camera and not has_square_pixels(camera):
            what = f"fx and fy differ, but Mitsuba's pixels are square: {width} × {height} of them"
            given = f"for {camera.width} × {camera.height}; `Reconstruction.render` has the camera's"
            warn(f"{what} {given}")
        data = {"output": str(out), "width": width, "height": height, "channels": names}
        return Result(data, f"{out}: {width} × {height}, {', '.join(names)}")


def read(path: Path, aovs: list[str], object_only: bool) -> Any:
    """Load the scene of a Mitsuba XML, or of a run: its scene.xml, first written if a checkpoint is newer,
    or while another process trains it the newest checkpoint."""
    from mi_refgs.reconstruction.reconstruction import load
    from mi_refgs.render.load_scene import load_scene
    from mi_refgs.runs.export import fresh
    from mi_refgs.runs.run import Run

    run, scene = Run(path), path / "scene.xml" if path.is_dir() else path
    if run.exists() and (run.checkpoints() or not scene.is_file()):
        found = load(path)
        if fresh(run, found.method) is not None:
            return found.scene(aovs=aovs, object_only=object_only)
    if not scene.is_file():
        raise InputError("no such file", scene, "scene", "give a Mitsuba XML or a run folder")
    return load_scene(scene, aovs, object_only)


def write(scene: Any, sensor: Any, spp: int, path: Path) -> list[str]:
    """Render into a file, atomically; returns the names of its channels. `spp` 0: the sampler's."""
    import mitsuba as mi
    import numpy as np

    from mi_refgs.io.exr import write_exr_layers
    from mi_refgs.io.images import srgb_from_linear, straight_srgb, write_png
    from mi_refgs.render.load_scene import reason

    try:
        image = mi.render(scene, sensor=sensor, spp=spp)
    except RuntimeError as error:
        raise InputError(reason(error), path, "render") from error
    bitmap = sensor.film().bitmap()
    names = [channel.name for channel in bitmap.struct_()]
    if path.suffix.lower() == ".exr":
        pixels = np.array(bitmap).reshape(*bitmap.size()[::-1], -1)
        write_exr_layers(path, {name: pixels[..., index] for index, name in enumerate(names)})
        return names
    if not {*"RGB"} <= {*names}:
        what = f"the film has {', '.join(names)}, no red, green and blue"
        raise InputError(what, path, "output", "write an EXR file, or give the film pixel_format rgb")
    count = 4 if "A" in names else 3
    pixels = np.array(image, dtype=np.float32)[..., :count]
    write_png(path, straight_srgb(pixels) if count == 4 else srgb_from_linear(pixels))
    return names[:count]
