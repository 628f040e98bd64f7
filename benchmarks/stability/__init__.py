"""Hard cases: images and gradients against a float64 reference, beside the textbook formulas in float32."""
