"""Hard cases: images and gradients against a float64 reference."""
