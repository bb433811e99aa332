"""The five papers: one module each, found by its number; each gives a Reproduction (outcome.py)."""
