"""The `refgs` integrator (being written)."""
