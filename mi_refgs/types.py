"""Names of Mitsuba's and Dr.Jit's types for annotations, `Any` for a type checker.

The types exist only once a variant is set. Shapes are comments on the line of the argument:

    weight: Float,  # (N,)
    radiance: Color3f,  # (H*W,) linear, premultiplied"""

from typing import Any

Bool = Any  # mi.Bool
Float = Any  # mi.Float
Int32 = Any  # mi.Int32
UInt32 = Any  # mi.UInt32
UInt64 = Any  # mi.UInt64
Color3f = Any  # mi.Color3f
Point2f = Any  # mi.Point2f
Point3f = Any  # mi.Point3f
Vector2f = Any  # mi.Vector2f
Vector3f = Any  # mi.Vector3f
Quaternion4f = Any  # mi.Quaternion4f, (x, y, z, w)
TensorXf = Any  # mi.TensorXf
Scene = Any  # mi.Scene
Sensor = Any  # mi.Sensor
Array = Any  # any one of the arrays above
Arrays = Any  # what contains arrays: a list, a dictionary, a dataclass
