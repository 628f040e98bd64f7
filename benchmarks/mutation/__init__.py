"""Planted mistakes, each with the test that must catch it."""
