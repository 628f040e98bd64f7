"""A Mitsuba scene of one diffuse sphere under a lit studio."""

import numpy as np

from tests.helpers import ROOT

CENTRE, RADIUS = np.array([0.3, -0.2, 0.5]), 0.7


SCENE = f"""<scene version="3.0.0">
    <emitter type="envmap">
        <string name="filename" value="{ROOT / "scenes" / "lights" / "studio.exr"}"/>
        <transform name="to_world"><rotate x="1" angle="90"/><rotate z="1" angle="35"/></transform>
    </emitter>
    <shape type="sphere">
        <point name="center" value="{CENTRE[0]}, {CENTRE[1]}, {CENTRE[2]}"/>
        <float name="radius" value="{RADIUS}"/>
        <bsdf type="diffuse"/>
    </shape>
</scene>"""
