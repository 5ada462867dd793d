"""Rendered sequences with exact truth."""
