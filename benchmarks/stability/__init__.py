"""Hard cases: pictures and gradients against a float64 oracle, beside the textbook formulas in float32."""
