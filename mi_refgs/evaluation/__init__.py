"""The quality of a finished fit: metrics and contact sheets."""
