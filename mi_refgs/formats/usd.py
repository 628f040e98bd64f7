"""USD packages of textured meshes."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.errors import InputError
from mi_refgs.formats.baking import TexturedMesh, bake
from mi_refgs.formats.format import Shot, import_extra
from mi_refgs.io.files import replace_file
from mi_refgs.io.images import srgb_from_linear, write_png
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera

APERTURE = 36.0  # width of the film, in USD's tenths of a scene unit; the focal length is then a ratio to it
TEXTURES = {"diffuseColor": "albedo", "roughness": "roughness", "metallic": "metallic"}
"""Inputs of UsdPreviewSurface, and their names here."""


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int) -> list[Path]:
    """A .usdz of a mesh with a UsdPreviewSurface and its textures, a dome light and the first view's camera.

    USD declares which axis is up: +z here, as in our world. The dome's texture has the layout of Mitsuba's
    `envmap`: the first row at +y, the middle column at +z.
    """
    usd_utils = import_extra("pxr.UsdUtils")
    made = bake(trained, shots, faces, texture)
    with tempfile.TemporaryDirectory(prefix="refgs_usd_") as name:
        folder = Path(name)
        write_png(folder / "albedo.png", srgb_from_linear(made.albedo))
        write_png(folder / "roughness.png", made.roughness)
        write_png(folder / "metallic.png", made.metallic)
        made.light.write(folder / "envmap.exr")
        stage = folder / "scene.usdc"
        _write_stage(stage, made, shots[0].camera)

        def pack(temporary: Path) -> None:
            if not usd_utils.CreateNewUsdzPackage(str(stage), str(temporary)):
                raise InputError(f"{target}: output: USD could not pack it; choose a writable folder")

        replace_file(target, pack)
    return [target]


def _write_stage(path: Path, made: TexturedMesh, camera: Camera) -> None:
    """Write the stage, whose textures are in its folder."""
    names = "Gf", "Sdf", "Usd", "UsdGeom", "UsdLux", "UsdShade", "Vt"
    gf, sdf, usd, geom, lux, shade, vt = (import_extra(f"pxr.{name}") for name in names)
    stage = usd.Stage.CreateNew(str(path))
    geom.SetStageUpAxis(stage, geom.Tokens.z)
    geom.SetStageMetersPerUnit(stage, 1.0)
    root = geom.Xform.Define(stage, "/root")
    stage.SetDefaultPrim(root.GetPrim())

    # The mesh
    mesh = geom.Mesh.Define(stage, "/root/object")
    points = vt.Vec3fArray.FromNumpy(made.vertices)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(made.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(made.faces.ravel().astype(np.int32)))
    mesh.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(made.normals))
    mesh.SetNormalsInterpolation(geom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(geom.Tokens.none)
    mesh.CreateExtentAttr(geom.Mesh.ComputeExtent(points))
    types = sdf.ValueTypeNames
    uv = geom.PrimvarsAPI(mesh).CreatePrimvar("st", types.TexCoord2fArray, geom.Tokens.vertex)
    uv.Set(vt.Vec2fArray.FromNumpy(made.uv))

    # Its material and textures
    material = shade.Material.Define(stage, "/root/material")
    reader = shade.Shader.Define(stage, "/root/material/uv")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    coordinates = reader.CreateOutput("result", types.Float2)
    surface = shade.Shader.Define(stage, "/root/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    for name, file in TEXTURES.items():
        colour = name == "diffuseColor"
        image = shade.Shader.Define(stage, f"/root/material/{file}")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", types.Asset).Set(f"./{file}.png")
        image.CreateInput("st", types.Float2).ConnectToSource(coordinates)
        image.CreateInput("sourceColorSpace", types.Token).Set("sRGB" if colour else "raw")
        output = image.CreateOutput("rgb", types.Float3) if colour else image.CreateOutput("r", types.Float)
        surface.CreateInput(name, types.Color3f if colour else types.Float).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    shade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)

    # Light and camera
    light = lux.DomeLight.Define(stage, "/root/light")
    light.CreateTextureFileAttr("./envmap.exr")
    light.CreateTextureFormatAttr(lux.Tokens.latlong)
    _add_camera(geom.Camera.Define(stage, "/root/camera"), camera, gf)
    stage.GetRootLayer().Save()


def _add_camera(prim: Any, camera: Camera, gf: Any) -> None:
    """Set a camera's lens and pose; USD's looks along its −z, ours along +z with +x to the left."""
    fx, fy = abs(float(camera.fx[0])), abs(float(camera.fy[0]))
    prim.CreateHorizontalApertureAttr(APERTURE)
    prim.CreateFocalLengthAttr(APERTURE * fx / camera.width)
    prim.CreateVerticalApertureAttr(APERTURE * fx / camera.width * camera.height / fy)
    # From the principal point to the middle of the film, to the right and up.
    right, down = camera.width / 2 - float(camera.cx[0]), camera.height / 2 - float(camera.cy[0])
    prim.CreateHorizontalApertureOffsetAttr(APERTURE * right / camera.width)
    prim.CreateVerticalApertureOffsetAttr(-APERTURE * fx / camera.width * down / fy)
    prim.CreateClippingRangeAttr(gf.Vec2f(1e-3, 1e6))
    # USD's matrices multiply rows.
    pose = (camera.pose() @ MITSUBA_FROM_OPENGL).T
    prim.AddTransformOp().Set(gf.Matrix4d(*pose.ravel().tolist()))
