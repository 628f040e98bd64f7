"""Comparison of methods: many fits, each a run, and tables, plots and a page."""
