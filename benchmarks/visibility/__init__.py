"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer."""
