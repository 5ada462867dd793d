"""Experiments: sequences with truth, metrics, evaluators."""
