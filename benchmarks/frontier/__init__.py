"""Quality of fits against their CPU time, and the Pareto front of settings."""
