"""Files: images, EXR, HDR, PLY, JSON, and which files are ours."""
