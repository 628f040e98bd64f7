"""Fits behind the tables of docs/accuracy.md, docs/speed.md and docs/photographs_in_detail.md."""
