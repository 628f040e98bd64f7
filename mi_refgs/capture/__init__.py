"""From a folder of photographs to a data set with cameras: structure from motion by COLMAP (extra
`capture`)."""
