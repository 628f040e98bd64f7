"""The split-sum approximation measured against Mitsuba's path tracer: speed against error."""
