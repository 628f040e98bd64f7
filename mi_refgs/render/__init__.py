"""From surfels to an image: the two orders of shading, depth normals, and the scene file of a run."""
